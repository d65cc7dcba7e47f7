"""Labelled traffic for tests of queries: a quiet office, and one attack of each kind of the catalogue.

`attack(name, …)` returns frames; `HOSTS[name]` is the address that the query of that name has to report.
"""

import random
import struct
from collections.abc import Callable, Iterable, Iterator
from ipaddress import ip_address
from typing import Final, NamedTuple

import numpy as np

from apps.packets import read_frames
from due import RecordBatch

FIN, SYN, RST, PSH, ACK, ECE = 1, 2, 4, 8, 16, 64
WIDTH: Final = 256
"""Bytes of a frame that the adapter gets."""
BASE_US: Final = 1_699_999_980_000_000
"""When the office opens, absolute time, µs."""


class TimedFrame(NamedTuple):
    """A frame of a capture."""

    time_us: int
    """Absolute time, µs."""
    length: int
    """Bytes on the wire; `data` may be shorter."""
    data: bytes


def ethernet(src: str, dst: str, protocol: int, payload: bytes) -> bytes:
    """An Ethernet frame with an IPv4 or IPv6 packet, without checksums; MACs are made from the addresses.

    Args:
        src: IP address.
        dst: IP address of the same version.
        protocol: number of what `payload` is.
        payload: behind the IP header.
    """
    source, destination = ip_address(src).packed, ip_address(dst).packed
    macs = b"\x02\x00" + destination[-4:] + b"\x02\x00" + source[-4:]
    if len(source) == 4:
        head = struct.pack("!BBHHHBBH", 0x45, 0, 20 + len(payload), 0, 0x4000, 64, protocol, 0)
        return macs + b"\x08\x00" + head + source + destination + payload
    head = struct.pack("!IHBB", 6 << 28, len(payload), protocol, 64)
    return macs + b"\x86\xdd" + head + source + destination + payload


def tcp(
    src: str,
    dst: str,
    sport: int,
    dport: int,
    flags: int,
    payload: bytes = b"",
    *,
    seq: int = 1,
    ack: int = 0,
) -> bytes:
    """A frame with a TCP segment; `flags` is the sum of FIN, SYN, RST, PSH, ACK, ECE."""
    head = struct.pack("!HHIIBBHHH", sport, dport, seq, ack, 0x50, flags, 8192, 0, 0)
    return ethernet(src, dst, 6, head + payload)


def udp(src: str, dst: str, sport: int, dport: int, payload: bytes = b"") -> bytes:
    """A frame with a UDP datagram."""
    return ethernet(src, dst, 17, struct.pack("!HHHH", sport, dport, 8 + len(payload), 0) + payload)


def dns(name: str, qtype: int = 1, *, response: bool, extra: int = 0) -> bytes:
    """A DNS message with one question, and `extra` zero bytes in the place of answers."""
    labels = b"".join(bytes([len(label)]) + label.encode() for label in name.split("."))
    flags = 0x8180 if response else 0x0100
    return (
        struct.pack("!6H", 7, flags, 1, 0, 0, 0)
        + labels
        + b"\0"
        + struct.pack("!2H", qtype, 1)
        + bytes(extra)
    )


def connection(
    start: int, src: str, dst: str, sport: int, dport: int, sizes: Iterable[int] = (200, 900)
) -> Iterator[TimedFrame]:
    """A whole TCP connection with a handshake that acknowledges, data, and FINs from both sides.

    Args:
        start: absolute time of the SYN, µs; the others follow every 1.5 ms.
        src: address of the client.
        dst: address of the server.
        sport: port of the client.
        dport: port of the server.
        sizes: bytes of payload, of client and server in turn.
    """
    steps = [
        tcp(src, dst, sport, dport, SYN, seq=100),
        tcp(dst, src, dport, sport, SYN | ACK, seq=900, ack=101),
        tcp(src, dst, sport, dport, ACK, seq=101, ack=901),
    ]
    for turn, size in enumerate(sizes):
        there, back = (src, dst), (sport, dport)
        if turn % 2:
            there, back = (dst, src), (dport, sport)
        steps.append(tcp(*there, *back, PSH | ACK, bytes(size), seq=101, ack=901))
    steps += [tcp(src, dst, sport, dport, FIN | ACK), tcp(dst, src, dport, sport, FIN | ACK)]
    for place, data in enumerate(steps):
        yield TimedFrame(start + place * 1500, max(60, len(data)), data)


def office(
    seconds: float, rng: random.Random, start: int = BASE_US, *, long: bool = False
) -> list[TimedFrame]:
    """Ten clients, two servers, DNS, IPv6, ARP and broken frames.

    Args:
        seconds: how long.
        rng: what is drawn from; the same seed makes the same office.
        start: absolute time, µs.
        long: connections as long as real ones.
    """
    frames: list[TimedFrame] = []
    end = start + int(seconds * 1e6)
    now = start
    while now < end:
        now += rng.randrange(1_000, 40_000)
        client, server = f"10.0.0.{rng.randrange(10, 20)}", f"192.0.2.{rng.randrange(1, 3)}"
        kind = rng.random()
        if kind < 0.4:
            turns = int(min(400.0, 4 * rng.paretovariate(0.9))) if long else rng.randrange(2, 6)
            sizes = [rng.randrange(40, 1200) for _ in range(turns)]
            service = rng.choices((443, 80, 22), (70, 28, 2))[0] if long else rng.choice((80, 443, 22))
            frames += connection(now, client, server, rng.randrange(20_000, 60_000), service, sizes)
        elif kind < 0.6:
            name = f"{rng.choice(('www', 'mail', 'api'))}.example{rng.randrange(4)}.org"
            port = rng.randrange(20_000, 60_000)
            frames.append(_whole(now, udp(client, "10.0.0.1", port, 53, dns(name, response=False))))
            frames.append(
                _whole(now + 900, udp("10.0.0.1", client, 53, port, dns(name, response=True, extra=30)))
            )
        elif kind < 0.7:
            frames.append(
                _whole(now, tcp("2001:db8::10", "2001:db8::1", rng.randrange(9_000), 443, ACK, bytes(300)))
            )
        elif kind < 0.8:
            body = struct.pack("!HHBBH", 1, 0x0800, 6, 4, 1) + bytes(20)
            frames.append(_whole(now, b"\xff" * 6 + b"\x02" * 6 + b"\x08\x06" + body))
        elif kind < 0.9:
            quoted = tcp(client, "198.51.100.9", 999, 22, SYN)[14:42]
            frames.append(_whole(now, ethernet("10.0.0.1", client, 1, b"\x03\x01" + bytes(6) + quoted)))
        else:
            frames.append(_whole(now, rng.randbytes(rng.randrange(14, 80))))
    return frames


def _whole(time_us: int, data: bytes) -> TimedFrame:
    return TimedFrame(time_us, max(60, len(data)), data)


def _spread(start: int, seconds: float, count: int) -> Iterator[int]:
    for place in range(count):
        yield start + int(place * seconds * 1e6 / count)


def _new_tcp(start: int, _rng: random.Random) -> Iterator[TimedFrame]:
    for place, at in enumerate(_spread(start, 2, 60)):
        yield _whole(at, tcp(f"10.7.0.{place % 9}", HOSTS["new_tcp"], 5000 + place, 80, SYN | ECE))


def _ssh(start: int, _rng: random.Random) -> Iterator[TimedFrame]:
    for place, at in enumerate(_spread(start, 2, 150)):
        yield _whole(
            at,
            tcp(f"10.6.0.{place % 50 + 1}", HOSTS["ssh_brute_force"], 6000 + place, 22, PSH | ACK, bytes(88)),
        )


def _superspreader(start: int, _rng: random.Random) -> Iterator[TimedFrame]:
    for place, at in enumerate(_spread(start, 2, 160)):
        yield _whole(at, udp(HOSTS["superspreader"], f"10.5.{place % 80}.1", 4000, 4000))


def _port_scan(start: int, _rng: random.Random) -> Iterator[TimedFrame]:
    for place, at in enumerate(_spread(start, 2, 120)):
        yield _whole(at, tcp(HOSTS["port_scan"], "192.0.2.1", 40_000, 1 + place % 100, SYN))


def _ddos(start: int, _rng: random.Random) -> Iterator[TimedFrame]:
    for place, at in enumerate(_spread(start, 2, 200)):
        yield _whole(at, udp(f"2001:db8:{place % 70:x}::3", HOSTS["ddos"], 123, 4000, bytes(400)))


def _syn_flood(start: int, rng: random.Random) -> Iterator[TimedFrame]:
    for place, at in enumerate(_spread(start, 2, 80)):
        spoofed = f"172.16.{rng.randrange(256)}.{rng.randrange(256)}"
        yield _whole(at, tcp(spoofed, HOSTS["syn_flood"], 1024 + place, 443, SYN | 0xC0))
        yield _whole(at + 100, tcp(HOSTS["syn_flood"], spoofed, 443, 1024 + place, SYN | ACK))


def _incomplete(start: int, _rng: random.Random) -> Iterator[TimedFrame]:
    for place, at in enumerate(_spread(start, 2, 5)):
        yield from list(connection(at, "10.9.9.9", HOSTS["incomplete_flows"], 7000 + place, 8080))[:5]


def _slowloris(start: int, _rng: random.Random) -> Iterator[TimedFrame]:
    for place, at in enumerate(_spread(start, 2, 40)):
        yield _whole(at, tcp("10.8.8.8", HOSTS["slowloris"], 8000 + place, 80, PSH | ACK, b"X-a: b\r\n"))


def _dns_tunnel(start: int, rng: random.Random) -> Iterator[TimedFrame]:
    for place, at in enumerate(_spread(start, 2, 90)):
        name = f"{rng.randbytes(12).hex()}x{place % 60}.{'q' * rng.randrange(10, 60)}.Tunnel.example"
        port = 30_000 + place
        yield _whole(at, udp(HOSTS["dns_tunnel"], "10.0.0.1", port, 53, dns(name, 16, response=False)))
        answer = udp("10.0.0.1", HOSTS["dns_tunnel"], 53, port, dns(name, 16, response=True, extra=120))
        yield _whole(at + 500, answer)
        again = udp("10.0.0.1", HOSTS["dns_tunnel"], 53, port, dns(name.upper(), 16, response=True))
        yield _whole(at + 600, again)


def _zorro(start: int, _rng: random.Random) -> Iterator[TimedFrame]:
    for place, at in enumerate(_spread(start, 2, 30)):
        yield _whole(
            at, tcp("10.4.4.4", HOSTS["zorro"], 9000 + place, 23, PSH | ACK, b"password%02d" % place)
        )
    yield _whole(
        start + 2_000_000, tcp("10.4.4.4", HOSTS["zorro"], 9100, 23, PSH | ACK, b"sh; ZORRO zorro\r\n")
    )


def _dns_reflection(start: int, _rng: random.Random) -> Iterator[TimedFrame]:
    for place, at in enumerate(_spread(start, 2, 120)):
        resolver = f"10.3.{place % 60}.53"
        qtype = 255 if place % 2 else 46
        yield _whole(
            at,
            udp(
                resolver,
                HOSTS["dns_reflection"],
                53,
                4444,
                dns("big.example", qtype, response=True, extra=900),
            ),
        )


def arp_request(mac: bytes, source: str, asked: str) -> bytes:
    """A frame with an ARP request, to all.

    Args:
        mac: of the sender, six bytes.
        source: IPv4 address of the sender.
        asked: IPv4 address that it asks for.
    """
    head = struct.pack("!HHBBH", 1, 0x0800, 6, 4, 1)
    body = head + mac + ip_address(source).packed + bytes(6) + ip_address(asked).packed
    return b"\xff" * 6 + mac + b"\x08\x06" + body


def _arp_scan(start: int, _rng: random.Random) -> Iterator[TimedFrame]:
    mac = bytes.fromhex(HOSTS["arp_scan"].replace(":", ""))
    for place, at in enumerate(_spread(start, 2, 150)):
        yield _whole(at, arp_request(mac, "10.2.0.1", f"10.2.0.{place % 100 + 2}"))


HOSTS: Final = {
    "new_tcp": "198.51.100.1",
    "ssh_brute_force": "198.51.100.2",
    "superspreader": "198.51.100.3",
    "port_scan": "198.51.100.4",
    "ddos": "2001:db8::5",
    "syn_flood": "198.51.100.6",
    "incomplete_flows": "198.51.100.7",
    "slowloris": "198.51.100.8",
    "dns_tunnel": "198.51.100.9",
    "zorro": "198.51.100.10",
    "dns_reflection": "198.51.100.11",
    "arp_scan": "02:00:00:00:00:12",
}
"""Query to the address that it has to report; to the MAC for arp_scan."""
_ATTACKS: Final[dict[str, Callable[[int, random.Random], Iterator[TimedFrame]]]] = {
    "new_tcp": _new_tcp,
    "ssh_brute_force": _ssh,
    "superspreader": _superspreader,
    "port_scan": _port_scan,
    "ddos": _ddos,
    "syn_flood": _syn_flood,
    "incomplete_flows": _incomplete,
    "slowloris": _slowloris,
    "dns_tunnel": _dns_tunnel,
    "zorro": _zorro,
    "dns_reflection": _dns_reflection,
    "arp_scan": _arp_scan,
}


def attack(name: str, start: int, rng: random.Random) -> list[TimedFrame]:
    """Frames of one attack.

    Args:
        name: of the query that has to report it, as in HOSTS.
        start: absolute time, µs.
        rng: what is drawn from.
    """
    return list(_ATTACKS[name](start, rng))


def mixed(names: Iterable[str], *, seconds: float = 20, seed: int = 1) -> list[TimedFrame]:
    """The office with these attacks, one after the other, in the order of time.

    Args:
        names: of queries, as in HOSTS.
        seconds: of the office.
        seed: of all that is drawn.
    """
    rng = random.Random(seed)
    frames = office(seconds, rng)
    for place, name in enumerate(names):
        frames += attack(name, BASE_US + 200_000 + int(place * 1_300_000), rng)
    return sorted(frames, key=lambda frame: frame.time_us)


def batches(frames: list[TimedFrame], size: int = 1024) -> Iterator[RecordBatch]:
    """The frames as the adapter gets them, with their first 256 bytes."""
    for begin in range(0, len(frames), size):
        yield batch_of(frames[begin : begin + size], begin)


def batch_of(frames: list[TimedFrame], first: int = 0) -> RecordBatch:
    """The frames as one batch: the columns of `apps.packets`, `frame` and `captured`; `first` is its first arrival."""
    numbers = np.arange(first, first + len(frames))
    cut = [frame.data[:WIDTH] for frame in frames]
    batch = read_frames(
        cut,
        lengths=np.array([frame.length for frame in frames]),
        times_us=np.array([frame.time_us for frame in frames]),
        ports=np.ones(len(frames), dtype=int),
        sequence=numbers + 1,
        arrival=numbers,
    )
    captured = np.array([len(data) for data in cut], dtype=np.uint16)
    return RecordBatch({**batch, "frame": np.array(cut, dtype=f"V{WIDTH}"), "captured": captured})
