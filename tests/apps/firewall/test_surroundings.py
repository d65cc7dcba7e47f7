"""The machine's own addresses, gateways and name servers are read from the kernel's and resolver's texts."""

from apps.firewall.surroundings import gateways, name_servers, own_addresses, worth_allowing

ROUTES = """Iface\tDestination\tGateway\tFlags
eth0\t00000000\t0102A8C0\t0003
eth0\t0002A8C0\t00000000\t0001
tun0\t00000000\t00000000\t0001
"""
TRIE = """Main:
  +-- 0.0.0.0/0 3 0 5
     |-- 192.168.2.0
        /24 link UNICAST
     |-- 192.168.2.7
        /32 host LOCAL
     |-- 127.0.0.1
        /32 host LOCAL
"""


def test_gateways():
    """Default routes with a next hop."""
    assert list(gateways(ROUTES)) == ["192.168.2.1"]
    assert list(gateways("")) == []


def test_name_servers():
    """Comments and other lines are left out, zones cut off."""
    text = "# nameserver 1.1.1.1\nsearch lan\nnameserver 192.168.2.1\nnameserver fe80::1%eth0\nnameserver\n"
    assert list(name_servers(text)) == ["192.168.2.1", "fe80::1"]


def test_own_addresses_are_local_leaves():
    """Networks are not addresses of ours."""
    assert list(own_addresses(TRIE)) == ["192.168.2.7", "127.0.0.1"]


def test_loopback_and_nonsense_need_no_permission():
    """And each address is named once."""
    assert worth_allowing(["127.0.0.1", "192.168.2.7", "localhost", "192.168.2.7", "::"]) == ("192.168.2.7",)
