"""An app of one site of `cluster_bridge`: writes two keys, and reads those of the other site.

`python -m benchmarks.cluster_bridge_app SITE URL FOLDER SIZE`; each line on standard input is an order:

    load RELIABLE BEST_EFFORT   items a second from now on; `inf`: as many as are taken
    mark                        the figures since the last one; they begin anew
    flush                       answered when all that was written is acknowledged
    end                         the last line has the sums, and the program ends

It prints JSON lines; times are `time.monotonic()`, which all processes of a machine share.
"""

import json
import os
import sys
import threading
import time
from typing import Any, Final, Literal

from due import CONSUMER, PRODUCER, PUB_ONLY, Capability, Engine, Interest, Item, Options

RELIABLE: Final = "plant.state.{}.item"
BEST_EFFORT: Final = "plant.report.{}.item"
_OTHER: Final = {"near": "far", "far": "near"}
_TELL_S: Final = 0.2
_LATE_S: Final = 1.0
"""A writer that is further behind its rate does not make up for it."""
_MOST_TIMES: Final = 200_000
"""Latencies kept between two marks."""


class PacedWriter:
    """Writes numbered items of one key in a thread of its own.

    Args:
        engine: writes them.
        key: of the items.
        padding: what an item holds besides its number and time.
    """

    def __init__(self, engine: Engine, key: str, padding: bytes) -> None:
        self._engine, self._key, self._padding = engine, key, padding
        self.rate = 0.0
        """Items a second."""
        self.written = 0
        """Items that somebody wanted; the number of the next one."""
        self.unwanted = 0
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        due = time.monotonic()
        while True:
            rate, now = self.rate, time.monotonic()
            if not rate:
                due = now
                time.sleep(0.01)
                continue
            if not self._engine.write(self._key, [self.written, now, self._padding], [PUB_ONLY]):
                self.unwanted += 1
                time.sleep(0.01)
                continue
            self.written += 1
            due = max(due + 1 / rate, now - _LATE_S)
            time.sleep(max(0.0, due - time.monotonic()))


class Arrivals:
    """What has come of one key: numbers, latencies, the longest pause."""

    def __init__(self) -> None:
        self._numbers: set[int] = set()
        self.first = -1
        """Number of the first item; -1: none has come."""
        self.newest = -1
        self.again = 0
        """Items that came a second time."""
        self.disordered = 0
        """Items that came after a later one."""
        self.mark()

    def mark(self) -> None:
        """Latencies, pauses and the count of `came` begin anew."""
        self.came = 0
        self._times: list[float] = []
        self._last = time.monotonic()
        self._pause = 0.0

    def take(self, item: Item) -> None:
        """A callback."""
        now = time.monotonic()
        number, written, _ = item.value
        self._pause = self.longest_pause(now)
        self._last = now
        self.came += 1
        if len(self._times) < _MOST_TIMES:
            self._times.append(now - written)
        if self.first < 0:
            self.first = number
        self.again += number in self._numbers
        self.disordered += number < self.newest
        self._numbers.add(number)
        self.newest = max(self.newest, number)

    def longest_pause(self, now: float) -> float:
        """Since the mark: between two items, before the first one or since the last one, s."""
        return max(self._pause, now - self._last)

    def progress(self) -> dict[str, Any]:
        """As fields of a line."""
        return {
            "came": self.came,
            "numbers": len(self._numbers),
            "first": self.first,
            "newest": self.newest,
            "again": self.again,
            "disordered": self.disordered,
            "pause_ms": 1000 * self.longest_pause(time.monotonic()),
        }

    def latencies(self) -> dict[str, Any]:
        """Percentiles since the last mark."""
        times = sorted(self._times)
        shares = {"p50_ms": 0.5, "p99_ms": 0.99}
        return {name: 1000 * times[int(share * (len(times) - 1))] for name, share in shares.items() if times}


class SiteApp:
    """Both directions of one site.

    Args:
        site: `near`, `far`.
        url: of its Data Updates.
        folder: of its own.
        size: bytes of an item.
    """

    def __init__(self, site: str, url: str, folder: str, size: int) -> None:
        keys: dict[Literal["reliable", "best_effort"], str] = {
            "reliable": RELIABLE,
            "best_effort": BEST_EFFORT,
        }
        other = _OTHER[site]
        options = Options(updates=url, archive="memory://cluster", directory=folder, pause_limit=60.0)
        self._engine = Engine(options)
        self._engine.init(
            site,
            PRODUCER | CONSUMER,
            capabilities=[Capability(key.format(site), delivery=kind) for kind, key in keys.items()],
            interests=[Interest(key.format(other)) for key in keys.values()],
        )
        padding = os.urandom(size)
        self._arrivals = {kind: Arrivals() for kind in keys}
        for kind, key in keys.items():
            self._engine.observe(key.format(other)).subscribe(self._arrivals[kind].take)
        self._writers = {kind: PacedWriter(self._engine, keys[kind].format(site), padding) for kind in keys}
        threading.Thread(target=self._tell, daemon=True).start()

    def obey(self, order: str, *rates: str) -> None:
        """Do what a line says."""
        if order == "load":
            for writer, rate in zip(self._writers.values(), rates, strict=True):
                writer.rate = float(rate)
        elif order == "mark":
            latencies = {kind: arrivals.latencies() for kind, arrivals in self._arrivals.items()}
            say(marked=True, latencies=latencies, **self._figures())
            for arrivals in self._arrivals.values():
                arrivals.mark()
        elif order == "flush":
            self._engine.flush(240)
            say(flushed=True)

    def close(self) -> None:
        """Say the sums and leave."""
        say(end=True, gaps=self._engine.health()["receiving"]["gaps"], **self._figures())
        self._engine.close()

    def _tell(self) -> None:
        while True:
            time.sleep(_TELL_S)
            say(**self._figures())

    def _figures(self) -> dict[str, Any]:
        return {
            "wanted": all(self._engine.wanted(writer._key) for writer in self._writers.values()),
            "written": {kind: writer.written for kind, writer in self._writers.items()},
            "unwanted": {kind: writer.unwanted for kind, writer in self._writers.items()},
            "got": {kind: arrivals.progress() for kind, arrivals in self._arrivals.items()},
        }


def say(**fields: Any) -> None:
    """One JSON line; called by two threads."""
    sys.stdout.write(json.dumps({"at": time.monotonic(), **fields}) + "\n")
    sys.stdout.flush()


def main(site: str, url: str, folder: str, size: str) -> None:
    """Obey until told to end."""
    app = SiteApp(site, url, folder, int(size))
    say(ready=True)
    for line in sys.stdin:
        if line.strip() == "end":
            break
        app.obey(*line.split())
    app.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
