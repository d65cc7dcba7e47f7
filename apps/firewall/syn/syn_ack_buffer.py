"""Half-open connections that a flood left at a server, and when they are reset.

    SYN-ACKs of servers ──► Answers (the last ones)
    guard or block decided ──► Resets: wait for the switch's confirmation, then RST what is old enough

Pure; `now` is the caller's monotonic clock in seconds.  A server's backlog holds exactly the connections
that it has answered, so its SYN-ACKs tell which connections these are, which sequence number a RST needs, and
behind which port of the switch the server is.  A client has `after_s` to finish its handshake.  Clients that
have finished one, or are known or allowed, are spared: their connections end by the server's time-out.
"""

import ipaddress
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from apps.firewall.evidence.recent_rows import AGED_S, Columns, RecentRows
from apps.firewall.syn.services import TcpService
from apps.firewall.syn.tcp_reset import HalfOpen, reset_frame
from due import RecordBatch

ANSWER_COLUMNS: Final[tuple[str, ...]] = (
    *("ip_version", "ip_dst_hi", "ip_dst_lo", "tcp_dport", "ip_src_hi", "ip_src_lo", "tcp_sport"),
    *("tcp_ack", "eth_dst", "eth_src", "vlan", "port"),
)
_HALF: Final = 64
_CONFIRMED_WITHIN_S: Final = 30.0
_JOBS: Final = 1024
_LOOK_S: Final = 0.1
_LATE_S: Final = 1.0
"""Copies of answers from before the rule may come so long after its confirmation: they take another way, and one that
shares a block with a later one counts as having come with it."""
_REMEMBERED: Final = 65_536
_FRAMES: Final = 512
"""Most frames in one item."""


class Answers:
    """Keeps at least the last `rows` SYN-ACKs; for those of the last `exact_s` the arrival time is exact."""

    def __init__(self, rows: int, exact_s: float = AGED_S) -> None:
        self._recent = RecentRows((*ANSWER_COLUMNS, "time_us"), rows, aged_s=exact_s)
        self.missing = ""
        """Columns that a reset needs and that the records lack."""

    def __len__(self) -> int:
        return len(self._recent)

    def add(self, batch: RecordBatch, now: float) -> None:
        """Add SYN-ACKs that have just arrived."""
        self.missing = ", ".join(name for name in (*ANSWER_COLUMNS, "time_us") if name not in batch)
        if not self.missing:
            self._recent.add(batch, now)

    def lacks(self, service: TcpService) -> bool:
        """Whether no recent answer of this service was seen: then it has no half-open connections."""
        wanted = Wanted(service)
        return not any(wanted.rows(block).any() for _, block in self._recent.blocks())

    def find(self, wanted: "Wanted", before: float) -> Iterator[HalfOpen]:
        """Wanted answers that arrived before a time; a connection may be in it more than once."""
        for came, block in self._recent.blocks():
            if came > before:
                return
            rows = np.flatnonzero(wanted.rows(block))
            columns = (block[name][rows].tolist() for name in ANSWER_COLUMNS)
            for version, to_hi, to_lo, to_port, from_hi, from_lo, from_port, *rest in zip(
                *columns, strict=True
            ):
                client, server = to_hi << _HALF | to_lo, from_hi << _HALF | from_lo
                yield HalfOpen(version, client, to_port, server, from_port, *rest)


@dataclass(frozen=True)
class Wanted:
    """Connections to a service since a capture time in ns, those of one source, or both."""

    service: TcpService | None = None
    source: str = ""
    since: int = 0

    def rows(self, batch: Columns) -> Any:
        """Selects these rows of a batch."""
        found = batch["time_us"] >= self.since // 1000
        if self.service is not None:
            found &= _is(batch, "ip_src", self.service.address)
            found &= batch["tcp_sport"] == self.service.port
        return found & _is(batch, "ip_dst", self.source) if self.source else found

    def __str__(self) -> str:
        parts = [f"of {self.source}"] if self.source else []
        return " ".join(parts + ([f"at {self.service}"] if self.service else []))


def _is(batch: Columns, name: str, text: str) -> Any:
    address = ipaddress.ip_address(text)
    high, low = int(address) >> _HALF, int(address) & ((1 << _HALF) - 1)
    same = (batch[f"{name}_hi"] == np.uint64(high)) & (batch[f"{name}_lo"] == np.uint64(low))
    return same & (batch["ip_version"] == address.version)


@dataclass
class _Job:
    decision: str
    wanted: Wanted
    decided: float
    confirmed: float = 0.0
    next_look: float = 0.0
    found: int = 0
    seen: bool = False
    """Connections were found, even if another decision had them reset."""


@dataclass(frozen=True)
class Note:
    """Outcome of a job, as text."""

    decision: str
    text: str


class SynAckBuffer:
    """At most `limit` connections are reset for one decision; those beyond are counted in `left_out`."""

    def __init__(self, answers: Answers, *, after_s: float, limit: int) -> None:
        self._answers = answers
        self._after_s = after_s
        self._limit = limit
        self._jobs: dict[str, _Job] = {}
        self._done: dict[HalfOpen, None] = {}
        self.sent = 0
        self.spared = 0
        """Connections of known, allowed or finished clients."""
        self.left_out = 0
        self.waited_out = 0
        """Decisions whose connections were left to the server's own time-out."""
        self.notes: deque[Note] = deque(maxlen=_JOBS)

    def plan(self, decision: str, wanted: Wanted, now: float) -> None:
        """Once this decision is confirmed, reset its connections that are still half-open."""
        if self._limit and len(self._jobs) < _JOBS:
            self._jobs[decision] = _Job(decision, wanted, now)

    def confirm(self, decision: str, state: str, now: float) -> None:
        """Record the switch's confirmation of a decision."""
        job = self._jobs.get(decision)
        if job is None:
            return
        if state in ("installed", "exists"):
            job.confirmed = job.confirmed or now
        elif state != "pending":
            del self._jobs[decision]

    def due(
        self, now: float, switches: Sequence[str], sparing: Callable[[], Callable[[str], bool]]
    ) -> list[HalfOpen]:
        """Connections to reset now; `sparing` returns the clients to spare."""
        found: list[HalfOpen] = []
        for job in list(self._jobs.values()):
            last = job.confirmed + _LATE_S + self._after_s
            if not job.confirmed:
                if now - job.decided > _CONFIRMED_WITHIN_S:
                    self._wait_out(job, "no switch confirmed the rule in time")
            elif len(switches) != 1:
                self._wait_out(job, f"{len(switches)} switches are connected, and records do not say which")
            elif now >= last:
                found += self._look(job, now, sparing())
                self._end(job)
            elif now >= job.next_look:
                found += self._look(job, now, sparing())
        self.sent += len(found)
        return found

    def _look(self, job: _Job, now: float, spare: Callable[[str], bool]) -> list[HalfOpen]:
        job.next_look = now + _LOOK_S
        latest: dict[tuple[int, ...], HalfOpen] = {}
        for half in self._answers.find(job.wanted, now - self._after_s):
            latest[half[:5]] = half
        found: list[HalfOpen] = []
        job.seen = job.seen or bool(latest)
        for half in latest.values():
            if half in self._done:
                continue
            job.found += 1
            if spare(_text(half.version, half.client)):
                self.spared += 1
            elif job.found <= self._limit:
                found.append(half)
            else:
                self.left_out += 1
            self._done[half] = None
        while len(self._done) > _REMEMBERED:
            del self._done[next(iter(self._done))]
        return found

    def _end(self, job: _Job) -> None:
        if job.found:
            del self._jobs[job.decision]
            text = f"half-open connections {job.wanted}: {job.found:,} were examined, and reset or spared"
            self.notes.append(Note(job.decision, text))
        elif job.seen:
            del self._jobs[job.decision]
        elif self._answers.missing:
            self._wait_out(job, f"the records lack {self._answers.missing}")
        else:
            self._wait_out(job, "no SYN-ACK was seen (cold start, or this direction passes elsewhere)")

    def _wait_out(self, job: _Job, why: str) -> None:
        del self._jobs[job.decision]
        self.waited_out += 1
        text = f"half-open connections {job.wanted} are not reset: {why}; the server's own time-out ends them"
        self.notes.append(Note(job.decision, text))


def _text(version: int, address: int) -> str:
    make = ipaddress.IPv4Address if version == 4 else ipaddress.IPv6Address
    return str(make(address))


def packet_outs(resets: Sequence[HalfOpen]) -> Iterator[dict[str, Any]]:
    """Values of `network.packet_out.firewall.<switch>`: ports, lengths, and the concatenated frames."""
    for start in range(0, len(resets), _FRAMES):
        some = resets[start : start + _FRAMES]
        frames = [reset_frame(each) for each in some]
        yield {
            "port": np.array([each.port for each in some], np.uint16),
            "length": np.array([len(frame) for frame in frames], np.uint16),
            "frames": b"".join(frames),
        }
