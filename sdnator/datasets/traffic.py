"""What a device sends, before it is a frame; and the source of chance that all devices share.

Times are integer microseconds since the start of the capture.
"""

import itertools
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from sdnator.datasets import frames
from sdnator.datasets.hosts import LanHost, mac_towards

SECOND: Final = 1_000_000
UDP, TCP, ECHO, ARP, RAW = "udp", "tcp", "echo", "arp", "raw"


class SentPacket(NamedTuple):
    """One packet that a device sends by itself; what others answer is made by `network`."""

    time: int
    kind: str
    src: LanHost
    dst: bytes
    """Address the packet goes to; for ARP the address asked for."""
    length: int
    """Bytes on the wire."""
    sport: int = 0
    dport: int = 0
    flags: int = 0
    number: int = 0
    """Sequence number of a segment or an echo."""
    payload: bytes = b""
    """What is known of the payload (or the whole frame, when raw); the rest is zeros."""
    attacker: str = ""
    """MAC of the attacking sender; empty for benign packets."""
    answered: bool = False
    """A name server answers this query."""


class WireFrame(NamedTuple):
    """A frame on the wire."""

    time: int
    length: int
    data: bytes
    """Its first bytes: the payload may be cut."""
    attacker: str


class Chance:
    """Random times and ports, reproducible for a seed and independent for every device."""

    def __init__(self, seed: int, *stream: int) -> None:
        self._random = np.random.default_rng([seed, *stream])

    def around(self, value: float, spread: float) -> int:
        """Microseconds: `value` seconds, normally distributed with `spread` seconds, never below 10 µs."""
        return max(10, int(self._random.normal(value, spread) * SECOND))

    def between(self, low: float, high: float) -> int:
        """Microseconds between two numbers of seconds."""
        return int(self._random.uniform(low, high) * SECOND)

    def number(self, low: int, high: int) -> int:
        """An integer from `low` to `high` (included)."""
        return int(self._random.integers(low, high, endpoint=True))

    def happens(self, probability: float) -> bool:
        return bool(self._random.random() < probability)

    def port(self) -> int:
        """A fresh source port."""
        return self.number(32_768, 60_999)

    def pick(self, low: int, high: int, count: int) -> list[int]:
        """`count` different integers from `low` to `high`, in random order."""
        return [int(value) + low for value in self._random.permutation(high - low + 1)[:count]]

    def every(self, period: float, spread: float, start: int, end: int) -> Iterator[int]:
        """Times from `start` to `end`, about every `period` seconds, at a random phase."""
        time = start + self.between(0, period)
        while time < end:
            yield time
            time += self.around(period, spread)


def burst(times: Iterator[int], end: int) -> Iterator[int]:
    """The times of a burst that fall before `end`."""
    return itertools.takewhile(lambda time: time < end, times)


def query(name: str, ident: int = 1) -> bytes:
    """A DNS question for an address."""
    labels = b"".join(bytes((len(part),)) + part.encode() for part in name.split("."))
    return ident.to_bytes(2, "big") + bytes.fromhex("01000001000000000000") + labels + b"\0\0\1\0\1"


def as_frame(sent: SentPacket, snap: int) -> WireFrame:
    """The frame of a packet, its payload cut so that about `snap` bytes are left."""
    data = sent.payload if sent.kind == RAW else _BUILDERS[sent.kind](sent, snap)
    return WireFrame(sent.time, sent.length, frames.pad(data, min(sent.length, snap))[:snap], sent.attacker)


def _udp(sent: SentPacket, snap: int) -> bytes:
    size = sent.length - 42
    payload = sent.payload[:size].ljust(min(size, max(snap - 42, 0)), b"\0")
    more = size - len(payload)
    datagram = frames.udp(sent.src.ip, sent.dst, sent.sport, sent.dport, payload, more=more)
    return _ipv4(sent, frames.UDP, datagram, more)


def _tcp(sent: SentPacket, snap: int) -> bytes:
    room = sent.length - 34
    syn = bool(sent.flags & frames.SYN)
    options = frames.syn_options(min((room - 20) & ~3, 40)) if syn and room >= 24 else b""
    size = max(room - 20 - len(options), 0) if sent.length > frames.MIN_FRAME else len(sent.payload)
    payload = sent.payload[:size].ljust(min(size, max(snap - 54, 0)), b"\0")
    more = size - len(payload)
    segment = frames.tcp(
        *(sent.src.ip, sent.dst, sent.sport, sent.dport, sent.flags),
        seq=sent.number,
        ack=1 if sent.flags & frames.ACK else 0,
        options=options,
        payload=payload,
        more=more,
    )
    return _ipv4(sent, frames.TCP, segment, more)


def _echo(sent: SentPacket, _: int) -> bytes:
    kind = 8 if sent.flags == 0 else 0
    rest = (1).to_bytes(2, "big") + (sent.number & 0xFFFF).to_bytes(2, "big")
    return _ipv4(sent, frames.ICMP, frames.icmp(kind, 0, rest, bytes(sent.length - 42)))


def _arp(sent: SentPacket, _: int) -> bytes:
    """`flags` 1 = asked of the known owner instead of everybody."""
    to = mac_towards(sent.dst) if sent.flags else frames.BROADCAST
    return frames.arp(1, sent.src.mac, sent.src.ip, bytes(6), sent.dst, to=to)


def _ipv4(sent: SentPacket, proto: int, payload: bytes, more: int = 0) -> bytes:
    packet = frames.ipv4(sent.src.ip, sent.dst, proto, payload, more=more, ident=sent.time & 0xFFFF)
    return frames.ethernet(mac_towards(sent.dst), sent.src.mac, frames.TYPE_IPV4, packet)


_BUILDERS: Final = {UDP: _udp, TCP: _tcp, ECHO: _echo, ARP: _arp}
