"""The machine's own addresses, gateways and name servers are read from the kernel's and resolver's texts."""

from pathlib import Path

from apps.firewall.policy.auto_allowlist import (
    SOURCES,
    gateways,
    gateways_v6,
    management_peers,
    name_servers,
    own_addresses,
    own_addresses_v6,
    worth_allowing,
)

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


def test_ipv6():
    """Own addresses of all scopes, and the next hop of the default route."""
    table = "20010db8000000000000000000000007 02 40 00 80     eth0\n"
    assert list(own_addresses_v6(table)) == ["2001:db8::7"]
    to = "fe80000000000000000000000000000"
    routes = f"{'0' * 32} 00 {'0' * 32} 00 {to}1 00000400 00000001 00000000 00000003     eth0\n"
    routes += f"{'0' * 32} 00 {'0' * 32} 00 {'0' * 32} ffffffff 00000001 00000000 00200200       lo\n"
    assert list(gateways_v6(routes)) == ["fe80::1"]


def test_management_peers():
    """Established connections of SSH, P4Runtime, Redis and MongoDB, either way; nobody else's."""
    table = """  sl  local_address rem_address   st
   0: 0702A8C0:0016 0902A8C0:C001 01 00000000:00000000
   1: 0702A8C0:C002 0A02A8C0:18EB 01 00000000:00000000
   2: 0702A8C0:0050 0B02A8C0:C003 01 00000000:00000000
   3: 00000000:0016 00000000:0000 0A 00000000:00000000
"""
    assert list(management_peers(table)) == ["192.168.2.9", "192.168.2.10"]
    mapped = "0000000000000000FFFF00000C02A8C0"
    six = f"head\n 0: {'0' * 32}:0016 {mapped}:C001 01\n 1: {'0' * 32}:0016 B80D0120000000000000000009000000:1 01\n"
    assert list(management_peers(six)) == ["192.168.2.12", "2001:db8::9"]


def test_files_of_this_machine_can_be_read():
    """Whatever is in them."""
    for path, addresses_in in SOURCES:
        if Path(path).exists():
            worth_allowing(addresses_in(Path(path).read_text(encoding="ascii", errors="replace")))
