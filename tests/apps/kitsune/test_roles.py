"""Roles come from training: gateways, DNS, DHCP and multicast speakers; bindings of MAC and address."""

from apps.kitsune.roles import MOST_ADDRESSES, Roles

ROUTER_MAC, HOST_MAC = 0x02AA, 0x02BB
ROUTER, HOST = (4, 0, 0xC0A80201), (4, 0, 0xC0A80205)
NOTHING = (0, 0, 0)


def outside(number):
    return (4, 0, 0x08080800 + number)


def learn(roles, source, *, sport=-1, to_mac=0xFFFFFFFFFFFF, to=NOTHING, multicast=False):
    roles.learn(source, sport, to_mac, to, multicast)


def behind_a_router():
    """Roles of a training in which a host spoke to three outside addresses."""
    roles = Roles()
    roles.see(ROUTER_MAC, ROUTER)
    roles.see(HOST_MAC, HOST)
    for number in range(3):
        learn(roles, HOST, to_mac=ROUTER_MAC, to=outside(number))
    roles.close_training()
    return roles


def test_a_mac_towards_many_outside_addresses_is_a_gateway():
    roles = behind_a_router()
    assert roles.role(ROUTER_MAC, ROUTER) == "gateway"
    assert roles.role(ROUTER_MAC, NOTHING) == "gateway"
    assert roles.role(HOST_MAC, HOST) == "host"


def test_an_outside_address_behind_the_gateway_is_a_host_and_its_mac_has_many_addresses():
    roles = Roles()
    roles.see(ROUTER_MAC, ROUTER)
    for number in range(5):
        roles.see(ROUTER_MAC, outside(number))
    roles.close_training()
    assert roles.role(ROUTER_MAC, outside(1)) == "host"
    assert roles.role(ROUTER_MAC, ROUTER) == "gateway"
    assert roles.addresses(ROUTER_MAC) == 6


def test_who_is_behind_a_gateway_shares_its_way_in():
    """Anybody there can send under such an address; the gateway itself, and a host of the LAN, sit on their own ports."""
    roles = behind_a_router()
    restored = Roles.from_state(roles.to_state())
    for each in (roles, restored):
        assert each.is_routed(ROUTER_MAC, outside(77))
        assert not each.is_routed(ROUTER_MAC, ROUTER)
        assert not each.is_routed(ROUTER_MAC, NOTHING)
        assert not each.is_routed(HOST_MAC, HOST)


def test_servers_and_multicast_speakers():
    roles = Roles()
    learn(roles, ROUTER, sport=53)
    learn(roles, HOST, sport=67)
    speaker = (4, 0, 0xC0A80209)
    for _ in range(4):
        learn(roles, speaker, sport=1900, multicast=True)
    mostly_not = (4, 0, 0xC0A80210)
    for number in range(9):
        learn(roles, mostly_not, multicast=number < 4)
    roles.close_training()
    found = [roles.role(HOST_MAC, address) for address in (ROUTER, HOST, speaker, mostly_not)]
    assert found == ["dns", "dhcp", "multicast", "host"]


def test_roles_are_not_earned_after_training():
    roles = Roles()
    roles.close_training()
    roles.see(HOST_MAC, HOST)
    assert roles.role(HOST_MAC, HOST) == "host"


def test_link_local_and_unspecified_addresses_do_not_count():
    roles = Roles()
    for address in (HOST, NOTHING, (4, 0, 0), (6, 0xFE80 << 48, 1), (6, 0, 0), (6, 0x20010DB8 << 32, 1)):
        roles.see(HOST_MAC, address)
    assert roles.addresses(HOST_MAC) == 1
    assert roles.addresses(0x02CC) == 0


def test_memory_is_bounded():
    roles = Roles()
    for number in range(MOST_ADDRESSES + 50):
        roles.see(ROUTER_MAC, outside(number))
    assert roles.addresses(ROUTER_MAC) == MOST_ADDRESSES


def test_state_goes_through_plain_values():
    roles = Roles()
    roles.see(ROUTER_MAC, ROUTER)
    for number in range(3):
        learn(roles, HOST, to_mac=ROUTER_MAC, to=outside(number))
    roles.close_training()
    again = Roles.from_state(roles.to_state())
    assert again.role(ROUTER_MAC, ROUTER) == "gateway"
    assert again.addresses(ROUTER_MAC) == 1


def test_addresses_are_counted_again_when_there_are_more():
    roles = Roles()
    assert roles.addresses(HOST_MAC) == 0
    for number in range(3):
        roles.see(HOST_MAC, outside(number))
        roles.see(HOST_MAC, (6, 0x20010DB8 << 32, number + 1))
        assert roles.addresses(HOST_MAC) == number + 1
    roles.see(HOST_MAC, HOST)
    assert roles.addresses(HOST_MAC) == 4
