"""Addresses that this machine cannot do without: its own, its gateways, its DNS servers.  Pure parsers."""

import ipaddress
from collections.abc import Iterable, Iterator

_DEFAULT_ROUTE = "00000000"


def gateways(route_table: str) -> Iterator[str]:
    """Default gateways in the text of /proc/net/route (IPv4, bytes in host order of a little-endian machine)."""
    for line in route_table.splitlines()[1:]:
        fields = line.split()
        if len(fields) > 2 and fields[1] == _DEFAULT_ROUTE and fields[2] != _DEFAULT_ROUTE:
            yield str(ipaddress.IPv4Address(int.from_bytes(bytes.fromhex(fields[2]), "little")))


def name_servers(resolver_file: str) -> Iterator[str]:
    """Name servers in the text of /etc/resolv.conf; a zone behind % is left out."""
    for line in resolver_file.splitlines():
        words = line.split()
        if len(words) > 1 and words[0] == "nameserver":
            yield words[1].partition("%")[0]


def own_addresses(address_table: str) -> Iterator[str]:
    """Local IPv4 addresses in the text of /proc/net/fib_trie: those of the leaves marked `host LOCAL`."""
    leaf = ""
    for line in address_table.splitlines():
        words = line.split()
        if words[:1] == ["|--"]:
            leaf = words[1]
        elif "host LOCAL" in line:
            yield leaf


def worth_allowing(addresses: Iterable[str]) -> tuple[str, ...]:
    """Each once, without loopback and what is no address."""
    kept: dict[str, None] = {}
    for text in addresses:
        try:
            address = ipaddress.ip_address(text)
        except ValueError:
            continue
        if not address.is_loopback and not address.is_unspecified:
            kept[str(address)] = None
    return tuple(kept)
