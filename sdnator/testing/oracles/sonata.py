"""The queries of the catalogue, one packet at a time over a whole capture: slow and obvious.

Nothing of the product is used: frames are taken apart here, addresses are compared as text.  A result
is a `Found`.

Reference:
    Gupta et al., Sonata, SIGCOMM 2018, table 3.
"""

import struct
from collections import defaultdict
from collections.abc import Callable, Iterable
from ipaddress import ip_address, ip_network
from typing import Any, NamedTuple

COPIED = 256
"""Bytes of a frame that anyone gets to see."""


class NaivePacket(NamedTuple):
    """A frame taken apart: what the queries look at; -1 and empty where a frame has none."""

    time_us: int
    """µs since the first window's start."""
    length: int
    """Bytes on the wire."""
    src: str = ""
    dst: str = ""
    protocol: int = -1
    sport: int = -1
    dport: int = -1
    flags: int = 0
    payload: bytes = b""
    mac: str = ""
    """Source MAC of an ARP request; `asked` is the address that it asks for."""
    asked: str = ""


class Found(NamedTuple):
    """One result of a query."""

    window: int
    """Number of the window."""
    fields: tuple[tuple[str, Any], ...]
    """Name and value, sorted by name."""
    at_us: int
    """When the threshold was reached, or the window's end."""


def read(time_us: int, length: int, frame: bytes) -> NaivePacket:
    """A frame taken apart; what is not IP has an empty address.

    Args:
        time_us: since the first window's start.
        length: bytes on the wire.
        frame: of which the first 256 bytes count.
    """
    frame = frame[:COPIED]
    bare = NaivePacket(time_us, length)
    at, kind = 12, frame[12:14]
    for _ in range(2):
        if kind in (b"\x81\x00", b"\x88\xa8", b"\x91\x00"):
            at += 4
            kind = frame[at : at + 2]
    body = frame[at + 2 :]
    if kind == b"\x08\x00":
        return _ipv4(bare, body)
    if kind == b"\x86\xdd":
        return _ipv6(bare, body)
    if kind == b"\x08\x06" and len(body) >= 28 and body[:8] == b"\0\1\x08\0\6\4\0\1":
        return bare._replace(mac=frame[6:12].hex(":"), asked=str(ip_address(body[24:28])))
    return bare


def _ipv4(packet: NaivePacket, body: bytes) -> NaivePacket:
    if len(body) < 20 or body[0] >> 4 != 4 or body[0] & 15 < 5:
        return packet
    header, total = (body[0] & 15) * 4, int.from_bytes(body[2:4], "big")
    if total and total < header:
        return packet
    packet = packet._replace(
        src=str(ip_address(body[12:16])), dst=str(ip_address(body[16:20])), protocol=body[9]
    )
    if int.from_bytes(body[6:8], "big") & 0x1FFF:
        return packet
    return _transport(packet, body[header : total or len(body)])


def _ipv6(packet: NaivePacket, body: bytes) -> NaivePacket:
    if len(body) < 40 or body[0] >> 4 != 6:
        return packet
    size = int.from_bytes(body[4:6], "big")
    packet = packet._replace(
        src=str(ip_address(body[8:24])), dst=str(ip_address(body[24:40])), protocol=body[6]
    )
    return _transport(packet, body[40 : 40 + size] if size else body[40:])


def _transport(packet: NaivePacket, data: bytes) -> NaivePacket:
    if packet.protocol not in (6, 17) or len(data) < 4:
        return packet
    sport, dport = struct.unpack("!HH", data[:4])
    packet = packet._replace(sport=sport, dport=dport)
    if packet.protocol == 17:
        return packet._replace(payload=data[8:])
    if len(data) < 14:
        return packet
    return packet._replace(flags=data[13], payload=data[(data[12] >> 4) * 4 :])


def question(payload: bytes) -> tuple[int, int, bytes]:
    """(response bit, type, name in lower case) of a DNS message's first question; -1 where absent."""
    if len(payload) < 12:
        return -1, -1, b""
    response = payload[2] >> 7
    if payload[4:6] == b"\0\0":
        return response, -1, b""
    at = 12
    while at < len(payload) and payload[at]:
        at += payload[at] + 1
    at += 1
    qtype = int.from_bytes(payload[at : at + 2], "big") if at + 2 <= len(payload) else -1
    return response, qtype, payload[12:at].lower()


def is_syn(packet: NaivePacket) -> bool:
    """SYN alone, whatever ECN bits say."""
    return packet.protocol == 6 and packet.flags & 0x17 == 0x02


def is_syn_ack(packet: NaivePacket) -> bool:
    """SYN and ACK."""
    return packet.protocol == 6 and packet.flags & 0x17 == 0x12


def is_ack(packet: NaivePacket) -> bool:
    """ACK alone, PSH or not."""
    return packet.protocol == 6 and packet.flags & 0x17 == 0x10


def is_fin(packet: NaivePacket) -> bool:
    """FIN, with ACK or without."""
    return packet.protocol == 6 and packet.flags & 0x07 == 0x01


def inside(address: str, prefix: str) -> bool:
    """Whether an address is in a prefix; `any` has all."""
    if prefix == "any":
        return True
    network = ip_network(prefix)
    found = ip_address(address)
    return found.version == network.version and found in network


Parameters = dict[str, Any]
"""All parameters of a query by name; `window` in ms."""
Window = list[NaivePacket]


def evaluate(name: str, packets: Iterable[NaivePacket], parameters: Parameters) -> list[Found]:
    """All results of a query.

    Args:
        name: of the query in the catalogue.
        packets: as `read` makes them, in any order of windows.
        parameters: every one of the query.
    """
    windows: dict[int, Window] = defaultdict(list)
    length = parameters["window"] * 1000
    for packet in packets:
        windows[packet.time_us // length].append(packet)
    found = []
    for number, window in sorted(windows.items()):
        end = (number + 1) * length
        for fields, at in _QUERIES[name](window, parameters):
            found.append(Found(number, tuple(sorted(fields.items())), end if at is None else at))
    return found


Reported = list[tuple[dict[str, Any], int | None]]


def _growing(pairs: Iterable[tuple[dict[str, Any], int]], threshold: int) -> Reported:
    """Count each key, and report it once, when the count reaches the threshold."""
    counts: dict[tuple[Any, ...], int] = defaultdict(int)
    found: Reported = []
    for key, at in pairs:
        name = tuple(sorted(key.items()))
        counts[name] += 1
        if counts[name] == threshold:
            found.append(({**key, "count": threshold}, at))
    return found


def _new_tcp(window: Window, p: Parameters) -> Reported:
    syns = (({"dst": k.dst}, k.time_us) for k in window if is_syn(k) and inside(k.dst, p["dst"]))
    return _growing(syns, p["threshold"])


def _distinct(window: Window, key: Callable[[NaivePacket], tuple[Any, ...]]) -> list[NaivePacket]:
    seen = set()
    first = []
    for packet in window:
        if key(packet) not in seen:
            seen.add(key(packet))
            first.append(packet)
    return first


def _ssh_brute_force(window: Window, p: Parameters) -> Reported:
    ssh = [k for k in window if k.protocol == 6 and k.dport == 22 and inside(k.dst, p["dst"])]
    tries = _distinct(ssh, lambda k: (k.dst, k.length, k.src))
    return _growing((({"dst": k.dst, "length": k.length}, k.time_us) for k in tries), p["threshold"])


def _superspreader(window: Window, p: Parameters) -> Reported:
    ip = [k for k in window if k.src and inside(k.src, p["src"])]
    return _growing(
        (({"src": k.src}, k.time_us) for k in _distinct(ip, lambda k: (k.src, k.dst))), p["threshold"]
    )


def _port_scan(window: Window, p: Parameters) -> Reported:
    tcp = [k for k in window if k.protocol == 6 and k.dport >= 0 and inside(k.src, p["src"])]
    return _growing(
        (({"src": k.src}, k.time_us) for k in _distinct(tcp, lambda k: (k.src, k.dport))), p["threshold"]
    )


def _ddos(window: Window, p: Parameters) -> Reported:
    ip = [k for k in window if k.src and inside(k.dst, p["dst"])]
    return _growing(
        (({"dst": k.dst}, k.time_us) for k in _distinct(ip, lambda k: (k.dst, k.src))), p["threshold"]
    )


def _syn_flood(window: Window, p: Parameters) -> Reported:
    open_: dict[str, int] = defaultdict(int)
    attempted = set()
    for packet in window:
        if is_syn(packet):
            open_[packet.dst] += 1
            attempted.add(packet.dst)
        elif is_syn_ack(packet):
            open_[packet.src] += 1
            attempted.add(packet.src)
        elif is_ack(packet):
            open_[packet.dst] -= 1
    return [
        ({"dst": host, "count": open_[host]}, None)
        for host in attempted
        if open_[host] >= p["threshold"] and inside(host, p["dst"])
    ]


def _incomplete_flows(window: Window, p: Parameters) -> Reported:
    open_: dict[str, int] = defaultdict(int)
    for packet in window:
        if is_syn(packet):
            open_[packet.dst] += 1
        elif is_fin(packet):
            open_[packet.src] -= 1
    return [
        ({"dst": host, "count": count}, None)
        for host, count in open_.items()
        if count >= p["threshold"] and inside(host, p["dst"])
    ]


def _slowloris(window: Window, p: Parameters) -> Reported:
    connections: dict[str, set[Any]] = defaultdict(set)
    volume: dict[str, int] = defaultdict(int)
    for packet in window:
        if packet.protocol == 6 and packet.dport >= 0 and inside(packet.dst, p["dst"]):
            connections[packet.dst].add((packet.src, packet.sport))
            volume[packet.dst] += packet.length
    found: Reported = []
    for host, ends in connections.items():
        number, size = len(ends), volume[host]
        if number >= p["connections"] and size >= p["bytes"] and size <= number * p["threshold"]:
            found.append(({"dst": host, "connections": number, "bytes": size, "count": size // number}, None))
    return found


def _gated(
    window: Window, p: Parameters, counts: Callable[[NaivePacket], bool], host: Callable[[NaivePacket], str]
) -> Window:
    """The packets of hosts (`host` of a packet) to which `gate` packets that count have come, from the last of these on."""
    came: dict[str, int] = defaultdict(int)
    found = []
    for packet in window:
        if counts(packet):
            came[packet.dst] += 1
        if came[host(packet)] >= p["gate"]:
            found.append(packet)
    return found


def _of_dns(packet: NaivePacket) -> bool:
    return packet.protocol == 17 and packet.sport == 53


def _dns_tunnel(window: Window, p: Parameters) -> Reported:
    window = _gated(window, p, _of_dns, lambda packet: packet.src if is_syn(packet) else packet.dst)
    names: dict[str, set[bytes]] = defaultdict(set)
    peers: dict[str, set[str]] = defaultdict(set)
    for packet in window:
        if packet.protocol == 17 and packet.sport == 53:
            response, _, name = question(packet.payload)
            if response == 1:
                names[packet.dst].add(name)
        if is_syn(packet):
            peers[packet.src].add(packet.dst)
    return [
        ({"dst": host, "count": len(asked) - len(peers[host])}, None)
        for host, asked in names.items()
        if len(asked) - len(peers[host]) >= p["threshold"] and inside(host, p["dst"])
    ]


def _zorro(window: Window, p: Parameters) -> Reported:
    window = _gated(
        window, p, lambda packet: packet.protocol == 6 and packet.dport == 23, lambda packet: packet.dst
    )
    similar: dict[tuple[str, int], int] = defaultdict(int)
    commands: dict[str, int] = defaultdict(int)
    for packet in window:
        if packet.protocol == 6 and packet.dport == 23 and inside(packet.dst, p["dst"]):
            similar[packet.dst, packet.length] += 1
            commands[packet.dst] += b"zorro" in packet.payload
    guessed = {host for (host, _), count in similar.items() if count >= p["similar"]}
    return [
        ({"dst": host, "count": commands[host]}, None) for host in guessed if commands[host] >= p["threshold"]
    ]


def _dns_reflection(window: Window, p: Parameters) -> Reported:
    answers: set[tuple[str, str]] = set()
    asked: set[tuple[str, str]] = set()
    for packet in _gated(window, p, _of_dns, lambda packet: packet.src):
        if packet.protocol == 17 and packet.dport == 53 and packet.sport != 53:
            asked.add((packet.src, packet.dst))
    for packet in _gated(window, p, _of_dns, lambda packet: packet.dst):
        if _of_dns(packet):
            response, qtype, _ = question(packet.payload)
            if response == 1 and qtype in (46, 255):
                answers.add((packet.dst, packet.src))
    servers: dict[str, int] = defaultdict(int)
    for host, _ in answers - asked:
        servers[host] += 1
    return [
        ({"dst": host, "count": count}, None)
        for host, count in servers.items()
        if count >= p["threshold"] and inside(host, p["dst"])
    ]


def _arp_scan(window: Window, p: Parameters) -> Reported:
    requests = [k for k in window if k.asked and inside(k.asked, p["dst"])]
    first = _distinct(requests, lambda k: (k.mac, k.asked))
    return _growing((({"port": 1, "mac": k.mac}, k.time_us) for k in first), p["threshold"])


_QUERIES: dict[str, Callable[[Window, Parameters], Reported]] = {
    "new_tcp": _new_tcp,
    "ssh_brute_force": _ssh_brute_force,
    "superspreader": _superspreader,
    "port_scan": _port_scan,
    "ddos": _ddos,
    "syn_flood": _syn_flood,
    "incomplete_flows": _incomplete_flows,
    "slowloris": _slowloris,
    "dns_tunnel": _dns_tunnel,
    "zorro": _zorro,
    "dns_reflection": _dns_reflection,
    "arp_scan": _arp_scan,
}
