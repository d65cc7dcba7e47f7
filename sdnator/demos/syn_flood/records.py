"""What the hosts of the SYN flood demo report, read as it is written."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal


@dataclass
class Attempt:
    """One connect(); `ok` is None while it lasts."""

    at: float
    """Wall time."""
    kind: Literal["known", "new"]
    to: str
    ok: bool | None = None
    ms: float = 0.0

    @property
    def ended(self) -> float:
        """Wall time; only for one that has ended."""
        return self.at + self.ms / 1000

    def connected_by(self, end: float) -> bool:
        """Whether it had succeeded at that time."""
        return bool(self.ok) and self.ended <= end


class Tail:
    """The new whole lines of a file: its writer may be in the middle of the last one."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._place = 0

    def lines(self) -> Iterator[dict[str, Any]]:
        """JSON objects since the last call."""
        if not self._path.exists():
            return
        with self._path.open("rb") as file:
            file.seek(self._place)
            text = file.read()
        whole = text[: text.rfind(b"\n") + 1]
        self._place += len(whole)
        for line in whole.splitlines():
            yield json.loads(line)


@dataclass
class Records:
    """All that was reported so far; call `update` to read on."""

    client: Tail
    victim: Tail
    flood: Tail
    counters: Tail
    attempts: dict[int, Attempt] = field(default_factory=dict)
    half_open: list[tuple[float, dict[str, int]]] = field(default_factory=list)
    """Wall time, and half-open connections by service address."""
    floods: dict[str, dict[str, Any]] = field(default_factory=dict)
    """The latest report of the flood towards an address."""
    counted: list[dict[str, Any]] = field(default_factory=list)
    """The guard's counters, and sometimes the entries by table."""

    def update(self) -> None:
        """Read what is new."""
        for line in self.client.lines():
            if "at" in line:
                self.attempts[line["number"]] = Attempt(line["at"], line["kind"], line["to"])
            else:
                attempt = self.attempts[line["number"]]
                attempt.ok, attempt.ms = line["ok"], line["ms"]
        self.half_open += [(line["at"], line["half_open"]) for line in self.victim.lines()]
        self.floods |= {line["to"]: line for line in self.flood.lines()}
        self.counted += self.counters.lines()

    def towards(self, address: str) -> list[Attempt]:
        """Attempts at one service."""
        return [each for each in self.attempts.values() if each.to == address]

    def half_open_at(self, address: str, begin: float, end: float) -> int:
        """The most half-open connections of a service in [begin, end], wall time."""
        return max((seen.get(address, 0) for at, seen in self.half_open if begin <= at <= end), default=0)

    def entries(self) -> list[dict[str, int]]:
        """Dynamic entries of the switch by table, each time they were looked at."""
        return [line["entries"] for line in self.counted if "entries" in line]

    def counter(self, name: str) -> int:
        """The latest value of one of the guard's counters."""
        return int(self.counted[-1].get(name, 0)) if self.counted else 0

    def first_rise(self, names: Iterable[str], since: float) -> float | None:
        """Wall time of the first reading after `since` in which any of these counters had gone up."""
        names = tuple(names)
        before: dict[str, Any] = next((line for line in reversed(self.counted) if line["at"] <= since), {})
        return next(
            (
                line["at"]
                for line in self.counted
                if line["at"] > since and any(line.get(name, 0) > before.get(name, 0) for name in names)
            ),
            None,
        )


def success(attempts: Iterable[Attempt], by: float) -> float | None:
    """Share of the attempts that had connected by a wall time; None where there are none."""
    tried = list(attempts)
    return round(sum(each.connected_by(by) for each in tried) / len(tried), 4) if tried else None
