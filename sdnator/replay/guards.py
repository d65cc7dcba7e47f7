"""What the guards of a replay would have done.

The clients in a capture cannot answer a challenge, so a guard is decided but not set: its SYNs pass the switch and
are counted here.  A guard challenges the SYNs to its service from sources that have not finished a handshake;
those few that its meter lets pass unchallenged are counted, too.
"""

import ipaddress
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.firewall.syn.services import TcpService
from apps.messages import Decision
from apps.packets import read_frames
from due import RecordBatch
from sdnator.capture.captures import Capture
from sdnator.capture.pcap_records import CapturedFrame

_BATCH: Final = 8_192
_FLAGS: Final = 0x17
_SYN: Final = 0x02
_HALF: Final = 64


@dataclass(frozen=True)
class ReplayedGuard:
    """A guard that was decided: in force from `since` until before `until`, capture time in ns."""

    decision: Decision
    since: int
    until: int

    @property
    def service(self) -> TcpService:
        """Whose SYNs it challenges."""
        return TcpService(self.decision.target.address, self.decision.target.port or 0)


@dataclass(eq=False)
class WouldChallenge:
    """The SYNs that the guards of a pass would have challenged."""

    packets: NDArray[np.bool_]
    """One entry for each packet of the capture."""
    by_guard: list[tuple[ReplayedGuard, int]] = field(default_factory=list)
    """Each guard, and how many SYNs it would have challenged."""

    def rows(self, time_ns: NDArray[np.int64]) -> list[dict[str, Any]]:
        """One row for each guard, in the order of deciding; `packet` is the first that it would have met."""
        return [
            {
                "id": guard.decision.id,
                "address": guard.decision.target.address,
                "port": guard.decision.target.port,
                "reason": guard.decision.reason,
                "decided": guard.since / 1e9,
                "packet": int(np.argmax(time_ns >= guard.since))
                if bool((time_ns >= guard.since).any())
                else None,
                "effect": "would challenge",
                "packets_would_be_challenged": count,
            }
            for guard, count in self.by_guard
        ]


def guards_of(decisions: Sequence[Decision]) -> list[ReplayedGuard]:
    """Guards from decisions, in their order; one that is never lifted ends when it expires."""
    ends = {each.id: each.event_time for each in reversed(decisions) if each.action == "unprotect"}
    first = {each.id: each for each in reversed(decisions) if each.action == "protect"}
    return [
        ReplayedGuard(each, each.event_time, ends.get(each.id, each.expires or np.iinfo(np.int64).max))
        for each in sorted(first.values(), key=lambda each: (each.event_time, each.id))
    ]


def would_challenge(
    capture: Path, packets: int, decisions: Sequence[Decision], handshakes: Iterable[tuple[int, str]]
) -> WouldChallenge:
    """Read a capture again, if there were guards, and find the SYNs that they would have challenged.

    Args:
        capture: the file.
        packets: how many of its packets were replayed.
        decisions: of the firewall.
        handshakes: capture time (ns) and source of each finished handshake.
    """
    found = WouldChallenge(np.zeros(packets, np.bool_))
    guards = guards_of(decisions)
    if not guards:
        return found
    known: dict[str, int] = {}
    for at, source in handshakes:
        known[source] = min(at, known.get(source, at))
    masks = [np.zeros(packets, np.bool_) for _ in guards]
    with Capture(capture) as frames:
        for first, syns in batches(islice(iter(frames), packets)):
            for guard, mask in zip(guards, masks, strict=True):
                mask[first + _challenged(guard, syns, known)] = True
    for guard, mask in zip(guards, masks, strict=True):
        found.by_guard.append((guard, int(mask.sum())))
        found.packets |= mask
    return found


def batches(frames: Iterator[CapturedFrame]) -> Iterator[tuple[int, RecordBatch]]:
    """Batches of frames, each with the index of its first."""
    first = 0
    while chunk := list(islice(frames, _BATCH)):
        count = len(chunk)
        yield (
            first,
            read_frames(
                [frame.data for frame in chunk],
                lengths=np.array([frame.length for frame in chunk], np.uint32),
                times_us=np.array([frame.time_ns // 1_000 for frame in chunk], np.int64),
                ports=np.ones(count, np.uint16),
                sequence=np.arange(count, dtype=np.uint64),
                arrival=np.arange(count, dtype=np.uint64),
            ),
        )
        first += count


def _challenged(guard: ReplayedGuard, batch: RecordBatch, known: dict[str, int]) -> NDArray[np.intp]:
    """Rows of the SYNs that a guard would have challenged."""
    address = guard.service.address
    version, number = _number(address)
    rows = (batch["tcp_flags"] & _FLAGS) == _SYN
    rows &= (batch["tcp_dport"] == guard.service.port) & (batch["ip_version"] == version)
    rows &= batch["ip_dst_hi"] == np.uint64(number >> _HALF)
    rows &= batch["ip_dst_lo"] == np.uint64(number & ((1 << _HALF) - 1))
    rows &= (batch["time_us"] >= guard.since // 1_000) & (batch["time_us"] < guard.until // 1_000)
    found = np.flatnonzero(rows)
    if not known or not len(found):
        return found
    times, high, low = (batch[name][found].tolist() for name in ("time_us", "ip_src_hi", "ip_src_lo"))
    strangers = [
        known.get(_text(version, hi << _HALF | lo), np.iinfo(np.int64).max) > at * 1_000
        for at, hi, lo in zip(times, high, low, strict=True)
    ]
    return found[np.array(strangers, np.bool_)]


def _number(address: str) -> tuple[int, int]:
    parsed = ipaddress.ip_address(address)
    return parsed.version, int(parsed)


def _text(version: int, number: int) -> str:
    return str(ipaddress.IPv4Address(number) if version == 4 else ipaddress.IPv6Address(number))
