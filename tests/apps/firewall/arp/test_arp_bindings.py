"""Who claims another's address by ARP is found, and nobody gets another one blocked by forging."""

from apps.firewall.arp.arp_bindings import ADDRESSES, CLAIMS, ArpBindings, BoundHost
from tests.apps.firewall.rows import arp, records

OWNER, THIEF, OTHER = 0x02_00_00_00_00_01, 0x02_00_00_00_00_66, 0x02_00_00_00_00_07
HOST = "10.0.0.1"


def bindings(*rows) -> ArpBindings:
    made = ArpBindings(training_s=600, settle_s=3600, contest_s=60)
    made.add(records(rows))
    return made


def trained() -> ArpBindings:
    """The owner is behind port 1, the thief has an address of its own behind port 3."""
    return bindings(arp(0, 1, OWNER, HOST), arp(1, 3, THIEF, "10.0.0.66"), arp(599, 1, OWNER, HOST))


def test_claim_while_the_owner_is_there():
    """The owner speaks after the claim: the claimant is the thief, for sure."""
    made = trained()
    assert made.add(records([arp(700, 3, THIEF, HOST)])) == []
    (theft,) = made.add(records([arp(710, 1, OWNER, HOST)]))
    assert (theft.address, theft.owner, theft.thief) == (HOST, BoundHost(1, OWNER), BoundHost(3, THIEF))
    assert theft.certain
    assert theft.thief.text == "02:00:00:00:00:66"
    assert made.add(records([arp(711, 1, OWNER, HOST)])) == []


def test_takeover_from_a_dead_owner_is_none():
    """A standby router; and an address that another host is given later."""
    made = trained()
    assert made.add(records([arp(700 + each, 3, THIEF, HOST) for each in range(5000)])) == []
    assert made.add(records([arp(5800, 1, OWNER, HOST)])) == []


def test_the_owners_mac_on_another_port_does_not_hide_a_theft():
    """One frame under the owner's MAC and address, before or during the theft, takes the address from nobody."""
    made = trained()
    (told,) = made.add(records([arp(700, 3, OWNER, HOST), arp(701, 1, OWNER, HOST)]))
    assert (told.thief, told.certain) == (BoundHost(3, OWNER), False)
    for at in (710, 720):
        (theft,) = made.add(records([arp(at, 3, THIEF, HOST), arp(at + 1, 1, OWNER, HOST)]))
        assert (theft.thief, theft.certain) == (BoundHost(3, THIEF), True)
    assert made.forged(HOST, BoundHost(3, THIEF))


def test_moved_host_keeps_its_address():
    """The same MAC behind another port, and back: nobody is blocked, and both ports are the owner's."""
    made, there = trained(), BoundHost(2, OWNER)
    assert made.add(records([arp(at, 2, OWNER, HOST) for at in (700, 730, 761)])) == []
    assert made.addresses_of(there) == [HOST]
    assert not made.forged(HOST, there)
    assert made.forged(HOST, BoundHost(3, THIEF))
    (theft,) = made.add(records([arp(800, 3, THIEF, HOST), arp(801, 2, OWNER, HOST)]))
    assert not theft.certain
    assert made.add(records([arp(900, 1, OWNER, HOST)])) == []
    assert made.addresses_of(there) == []
    (theft,) = made.add(records([arp(910, 3, THIEF, HOST), arp(911, 1, OWNER, HOST)]))
    assert theft.certain


def test_who_forges_the_mac_of_a_dead_owner_gets_its_successor_blocked_by_nobody():
    """Only the port of training proves that the owner is there."""
    made = trained()
    assert made.add(records([arp(at, 3, OWNER, HOST) for at in (700, 800)])) == []
    (told,) = made.add(records([arp(810, 4, OTHER, HOST), arp(811, 3, OWNER, HOST)]))
    assert (told.thief, told.certain) == (BoundHost(4, OTHER), False)
    (told,) = made.add(records([arp(820, 1, OWNER, HOST)]))
    assert (told.thief, told.certain) == (BoundHost(3, OWNER), False)


def test_a_frame_of_the_owner_that_says_two_things_does_not_unbind_it():
    """Its own port and MAC in Ethernet, another MAC in ARP, as a virtual router sends."""
    made = trained()
    made.add(records([arp(700, 1, OWNER, HOST, arp_src_mac=OTHER)]))
    assert made.forged(HOST, BoundHost(3, THIEF))


def test_squatter_gets_nobody_blocked():
    """Who comes first to an address after training is not believed against who comes later."""
    made = trained()
    squatted = "10.0.0.77"
    made.add(records([arp(700, 3, THIEF, squatted), arp(4400, 3, THIEF, squatted)]))
    (theft,) = made.add(records([arp(4500, 2, OTHER, squatted), arp(4501, 3, THIEF, squatted)]))
    assert not theft.certain


def test_contested_in_training_is_nobodys():
    """Two network cards of one host answer for both addresses."""
    made = bindings(*[arp(each, 1, (OWNER, OTHER)[each % 2], HOST) for each in range(600)])
    assert (
        made.add(records([arp(700, 1, OTHER, HOST), arp(701, 1, OWNER, HOST), arp(702, 1, OTHER, HOST)]))
        == []
    )


def test_forged_mac_behind_a_shared_port_is_only_told():
    """The thief uses the MAC of a neighbour behind its port: who it was nobody can tell."""
    made = trained()
    made.add(records([arp(650, 3, OTHER, "10.0.0.7")]))
    (theft,) = made.add(records([arp(700, 3, OTHER, HOST), arp(701, 1, OWNER, HOST)]))
    assert not theft.certain
    # a MAC that lives nowhere else harms nobody when it is blocked
    (theft,) = made.add(records([arp(800, 3, 0x02_99_00_00_00_99, HOST), arp(801, 1, OWNER, HOST)]))
    assert theft.certain


def test_frames_that_say_two_things():
    """The frame's own MAC is judged; it binds nothing."""
    made = trained()
    (theft,) = made.add(records([arp(700, 3, THIEF, HOST, arp_src_mac=OWNER), arp(701, 1, OWNER, HOST)]))
    assert theft.thief == BoundHost(3, THIEF)
    made.add(records([arp(702, 3, THIEF, "10.0.0.99", arp_src_mac=OTHER)]))
    assert made.addresses_of(BoundHost(3, THIEF)) == ["10.0.0.66"]


def test_forged_addresses_in_other_packets():
    """Only trained bindings say who has an address."""
    made = trained()
    assert made.forged(HOST, BoundHost(3, THIEF))
    assert not made.forged(HOST, BoundHost(1, OWNER))
    assert not made.forged("10.0.0.200", BoundHost(3, THIEF))
    assert not made.forged("2001:db8::1", BoundHost(3, THIEF))
    assert made.is_alone(BoundHost(3, THIEF))
    made.add(records([arp(650, 3, OTHER, "10.0.0.7")]))
    assert not made.is_alone(BoundHost(3, THIEF))


def test_state_is_bounded():
    """Whatever is claimed, of whichever MAC."""
    made = trained()
    rows = [arp(700, 3, 0x02_11_00_00_00_00 + n, HOST) for n in range(2 * CLAIMS)]
    rows += [
        arp(701, 3, THIEF, f"10.{n // 65536 + 1}.{n // 256 % 256}.{n % 256}") for n in range(ADDRESSES + 500)
    ]
    made.add(records(rows))
    assert len(made) == ADDRESSES
    assert made.claims == CLAIMS


def test_probes_and_nonsense_are_nobodys():
    """No address yet, a group address as sender, no ARP at all."""
    made = bindings(arp(0, 1, OWNER, "0.0.0.0"), arp(0, 1, 0x01_00_5E_00_00_01, HOST), {"time_us": 1})
    assert len(made) == 0
