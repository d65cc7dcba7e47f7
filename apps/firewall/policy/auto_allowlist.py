"""Addresses that this machine cannot do without: its own, its gateways, DNS servers and management peers.

Parsers of Linux's /proc files and resolv.conf.
"""

import ipaddress
import logging
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Final

MANAGEMENT_PORTS = frozenset({22, 6379, 9559, 27_017})
_DEFAULT_ROUTE = "00000000"
_ESTABLISHED = "01"

log = logging.getLogger(__name__)


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
    """Distinct addresses, without loopback and malformed ones."""
    kept: dict[str, None] = {}
    for text in addresses:
        try:
            address = ipaddress.ip_address(text)
        except ValueError:
            continue
        if not (address.is_loopback or address.is_unspecified or address.is_multicast):
            kept[str(address)] = None
    return tuple(kept)


def gateways_v6(route_table: str) -> Iterator[str]:
    """Default gateways in the text of /proc/net/ipv6_route."""
    for line in route_table.splitlines():
        fields = line.split()
        if len(fields) > 4 and set(fields[0]) == {"0"} and fields[1] == "00" and set(fields[4]) != {"0"}:
            yield str(ipaddress.IPv6Address(int(fields[4], 16)))


def own_addresses_v6(address_table: str) -> Iterator[str]:
    """Local IPv6 addresses in the text of /proc/net/if_inet6."""
    for line in address_table.splitlines():
        fields = line.split()
        if fields and len(fields[0]) == 32:
            yield str(ipaddress.IPv6Address(int(fields[0], 16)))


def management_peers(connection_table: str) -> Iterator[str]:
    """Peers of this machine's SSH, P4Runtime, Redis and MongoDB connections, in either direction.

    The text is that of /proc/net/tcp or /proc/net/tcp6; only established connections count.
    """
    for line in connection_table.splitlines()[1:]:
        fields = line.split()
        if len(fields) < 4 or fields[3] != _ESTABLISHED:
            continue
        (_, near), (far, far_port) = (field.split(":") for field in fields[1:3])
        if {int(near, 16), int(far_port, 16)} & MANAGEMENT_PORTS:
            yield _from_kernel(far)


def _from_kernel(text: str) -> str:
    """An address as the kernel prints it: words of 32 bits, each in host order of a little-endian machine."""
    words = [int(text[start : start + 8], 16).to_bytes(4, "little") for start in range(0, len(text), 8)]
    address = ipaddress.ip_address(b"".join(words))
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return str(mapped or address)


SOURCES: Final[tuple[tuple[str, Callable[[str], Iterator[str]]], ...]] = (
    ("/proc/net/fib_trie", own_addresses),
    ("/proc/net/if_inet6", own_addresses_v6),
    ("/proc/net/route", gateways),
    ("/proc/net/ipv6_route", gateways_v6),
    ("/etc/resolv.conf", name_servers),
    ("/proc/net/tcp", management_peers),
    ("/proc/net/tcp6", management_peers),
)
"""Linux files and their parsers."""


def surroundings() -> tuple[str, ...]:
    """Addresses of this machine; a file that cannot be read is logged and left out."""
    found: list[str] = []
    for path, addresses_in in SOURCES:
        try:
            found += addresses_in(Path(path).read_text(encoding="ascii", errors="replace"))
        except OSError as error:
            log.warning("%s: %s; its addresses are not on the allow-list", path, error.strerror)
    log.info("allowed from the start: %s", ", ".join(worth_allowing(found)) or "nothing")
    return worth_allowing(found)
