"""The cast: every device has its own addresses, and every frame finds its way."""

from sdnator.datasets import hosts


def test_addresses_are_unique():
    everybody = (*hosts.LAN_HOSTS, hosts.SWITCH)
    assert len({host.mac for host in everybody}) == len({host.ip for host in everybody}) == 18
    assert all(hosts.is_local(host.ip) for host in everybody)
    assert not any(hosts.is_local(ip) for ip in (*hosts.CLOUD, *hosts.TIME_SERVERS, *hosts.DNS_PUBLIC))


def test_frames_find_their_way():
    """To a neighbour directly, to the world and to absent devices through the gateway, to groups by their MAC."""
    assert hosts.mac_towards(hosts.DOME.ip) == hosts.DOME.mac
    assert hosts.mac_towards(hosts.address("8.8.8.8")) == hosts.GATEWAY.mac
    assert hosts.mac_towards(hosts.address(hosts.ABSENT)) == hosts.GATEWAY.mac
    assert hosts.mac_towards(hosts.SSDP_GROUP).hex(":") == "01:00:5e:7f:ff:fa"
    assert hosts.mac_towards(hosts.IGMP_GROUP).hex(":") == "01:00:5e:00:00:16"
