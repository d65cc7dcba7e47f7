"""Half-open connections that a flood left at a server, and when they are reset.

    SYN-ACKs of servers ──► Answers (the last ones)
    guard or block decided ──► Resets: wait for the switch's confirmation, then RST what is old enough

Pure; `now` is the time of the reader's monotonic clock in seconds.  A server's backlog holds exactly what it
has answered, so its SYN-ACKs say which connections those are, what sequence number a RST needs, and behind
which port of the switch the server is.  A client has `after_s` to finish its handshake; who has finished
any, is known or on the allow-list is spared, and waits for the server's own time-out as without us.
"""

import ipaddress
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from apps.firewall.recent_rows import AGED_S, Columns, RecentRows
from apps.firewall.services import Service
from apps.firewall.tcp_reset import HalfOpen, reset_frame
from due import RecordBatch

_COLUMNS: Final = (
    *("ip_version", "ip_dst_hi", "ip_dst_lo", "tcp_dport", "ip_src_hi", "ip_src_lo", "tcp_sport"),
    *("tcp_ack", "eth_dst", "eth_src", "vlan", "port"),
)
_HALF: Final = 64
_CONFIRMED_WITHIN_S: Final = 30.0
_JOBS: Final = 1024
_LOOK_S: Final = 0.1
_REMEMBERED: Final = 65_536
_FRAMES: Final = 512
"""At most so many in one item."""


class Answers:
    """At least the last `rows` SYN-ACKs; those of the last `exact_s` can be told apart by when they came."""

    def __init__(self, rows: int, exact_s: float = AGED_S) -> None:
        self._recent = RecentRows((*_COLUMNS, "time_us"), rows, aged_s=exact_s)
        self.missing = ""
        """Columns that a reset needs and the records lack."""

    def __len__(self) -> int:
        return len(self._recent)

    def add(self, batch: RecordBatch, now: float) -> None:
        """SYN-ACKs that came just now."""
        self.missing = ", ".join(name for name in (*_COLUMNS, "time_us") if name not in batch)
        if not self.missing:
            self._recent.add(batch, now)

    def lacks(self, service: Service) -> bool:
        """Whether this service has answered nobody lately, as far as is seen: then nothing is half-open there."""
        wanted = Wanted(service)
        return not any(wanted.rows(block).any() for _, block in self._recent.blocks())

    def find(self, wanted: "Wanted", before: float) -> Iterator[HalfOpen]:
        """Answers that came before a time and are wanted; a connection may come more than once."""
        for came, block in self._recent.blocks():
            if came > before:
                return
            rows = np.flatnonzero(wanted.rows(block))
            columns = (block[name][rows].tolist() for name in _COLUMNS)
            for version, to_hi, to_lo, to_port, from_hi, from_lo, from_port, *rest in zip(
                *columns, strict=True
            ):
                client, server = to_hi << _HALF | to_lo, from_hi << _HALF | from_lo
                yield HalfOpen(version, client, to_port, server, from_port, *rest)


@dataclass(frozen=True)
class Wanted:
    """Connections to a service since a capture time in ns, those of one source, or both."""

    service: Service | None = None
    source: str = ""
    since: int = 0

    def rows(self, batch: Columns) -> Any:
        """Which rows of a batch these are."""
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
    """Connections were there, be it that another decision had them reset."""


@dataclass(frozen=True)
class Note:
    """What became of a job, in words."""

    decision: str
    text: str


class Resets:
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
        """Decisions after which the server's own time-out had to be waited for."""
        self.notes: deque[Note] = deque(maxlen=_JOBS)

    def plan(self, decision: str, wanted: Wanted, now: float) -> None:
        """When this decision is confirmed, reset what is still half-open."""
        if self._limit and len(self._jobs) < _JOBS:
            self._jobs[decision] = _Job(decision, wanted, now)

    def confirm(self, decision: str, state: str, now: float) -> None:
        """What the switch said of a decision."""
        job = self._jobs.get(decision)
        if job is None:
            return
        if state in ("installed", "exists"):
            job.confirmed = job.confirmed or now
        else:
            del self._jobs[decision]

    def due(
        self, now: float, switches: Sequence[str], sparing: Callable[[], Callable[[str], bool]]
    ) -> list[HalfOpen]:
        """What is to be reset now; `sparing` is asked for who is to be spared when something is due."""
        found: list[HalfOpen] = []
        for job in list(self._jobs.values()):
            last = job.confirmed + self._after_s
            if not job.confirmed:
                if now - job.decided > _CONFIRMED_WITHIN_S:
                    self._wait_out(job, "no switch confirmed the rule in time")
            elif len(switches) != 1:
                self._wait_out(job, f"{len(switches)} switches are there, and records do not say which")
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
            text = f"half-open connections {job.wanted}: {job.found:,} were looked at, and reset or spared"
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
    """Values of `network.packet_out.firewall.<switch>`: ports, lengths, and the frames behind each other."""
    for start in range(0, len(resets), _FRAMES):
        some = resets[start : start + _FRAMES]
        frames = [reset_frame(each) for each in some]
        yield {
            "port": np.array([each.port for each in some], np.uint16),
            "length": np.array([len(frame) for frame in frames], np.uint16),
            "frames": b"".join(frames),
        }
