"""The paper's queries alone, in pairs and all together, in one running switch: is each right beside the others?

A round declares its keys, plays attacks of all kinds with an office, then, two minutes of capture time later, two
seconds of office so that every window is over, and withdraws its keys.  Rounds follow each other on one clock, so
that a round counts in cells that others have used.
"""

import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, Final, Self

import msgspec

from apps.sonata_adapter.query.catalogue import PAPER
from benchmarks.sonata_stage import PREFIX, SonataStage, wrong_results
from due import Item
from sdnator.testing.controller_run import Heard
from sdnator.testing.query_traffic import ACK, PSH, TimedFrame, mixed, tcp
from sdnator.testing.waiting import TookTooLong, wait_for

ROUND_US: Final = 180_000_000
"""From one round to the next, capture time: a multiple of every window."""
_COUNTED_US: Final = 60_000_000
"""The first frames of a round lie within the longest window, which begins with it."""
_CLOSE_US: Final = 120_000_000
_SECONDS: Final = 8.0
_FASTER: Final = 2.0
_SETTLE_S: Final = 60.0
_KEYSTROKE: Final = tcp("10.0.0.12", "192.0.2.7", 41_000, 23, PSH | ACK, b"k")


class RoundOutcome(msgspec.Struct, frozen=True):
    """What one set of queries came to."""

    wrong: list[str]
    """Queries whose results are not those of the naive evaluator."""
    in_switch: list[str]
    estimates: int


class SetsStage(SonataStage):
    """Declares sets of queries, one after the other."""

    def __enter__(self) -> Self:
        super().__enter__()
        self._commands = Heard(self._observer, "network.p4_command.sonata_adapter.s1")
        self._confirmations = Heard(self._observer, "network.confirmation.p4runtime_ctrl.s1")
        return self

    def round(self, names: Sequence[str], frames: Sequence[TimedFrame], number: int) -> RoundOutcome:
        """The results of these queries on the frames, as round `number` from 1 on."""
        start = frames[0].time_us // 10**6 * 10**6
        offset = number * ROUND_US
        results: list[Item] = []
        wanted = [self._observer.observe(f"{PREFIX}.{name}").subscribe(results.append) for name in names]
        wait_for(lambda: self._in_force(True), _SETTLE_S, self.log)
        self.play(frames, faster=_FASTER, zero=start - offset)
        # a copy of each kind that a query looks at says that its window is over
        quiet = [*mixed((), seconds=2), TimedFrame(start + 1_000_000, 60, _KEYSTROKE)]
        close = sorted(frame._replace(time_us=frame.time_us + _CLOSE_US) for frame in quiet)
        self.play(close, faster=_FASTER, zero=start - offset)
        self.settle()
        places = dict(self._health.values("health")[-1]["app"]["queries"])
        found = self._wrong(names, frames, results, offset)
        for each in wanted:
            each.dispose()
        wait_for(lambda: self._in_force(False), _SETTLE_S, self.log)
        estimates = sum(not item.value["exact"] for item in results if self._counts(item, offset))
        switch = [
            key.partition(":")[0].rpartition(".")[2] for key, place in places.items() if place == "switch"
        ]
        return RoundOutcome(found, sorted(switch), estimates)

    def _wrong(
        self, names: Sequence[str], frames: Sequence[TimedFrame], results: list[Item], offset: int
    ) -> list[str]:
        def look() -> list[str]:
            by_query: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
            for item in list(results):
                if self._counts(item, offset):
                    by_query[item.key.partition(":")[0].rpartition(".")[2]].append(dict(item.value))
            return wrong_results(names, frames, by_query, self.base_us + offset)

        try:
            wait_for(lambda: not look(), 20)
        except TookTooLong:
            return look()
        return []

    def _counts(self, item: Item, offset: int) -> bool:
        """Whether a result is of the round's own frames, not of those that close its windows."""
        return bool(item.value["window_start"] < (self.base_us + offset + _COUNTED_US) * 1000)

    def _in_force(self, wanted: bool) -> bool:
        """The switch has all classifier bits and counting entries that the adapter has asked for, or none."""
        health = self._health.values("health")
        bits = health[-1]["app"]["bits"] if health else -1
        asked = sum(len(item.value["updates"]) for item in self._commands.items)
        answered = sum(str(item.value["id"]).startswith("sonata-") for item in self._confirmations.items)
        return bits == len(self._telemetry) and bool(bits) == wanted and answered >= asked


def set_figures() -> dict[str, Any]:
    """Every query alone, every pair and all eleven."""
    frames = mixed(PAPER, seconds=_SECONDS)
    sets: list[tuple[str, ...]] = [(name,) for name in PAPER]
    sets += [*combinations(PAPER, 2), PAPER]
    outcomes: dict[tuple[str, ...], RoundOutcome] = {}
    with tempfile.TemporaryDirectory() as folder, SetsStage(Path(folder)) as stage:
        for number, names in enumerate(sets, start=1):
            outcomes[names] = outcome = stage.round(names, frames, number)
            print(
                f"{' + '.join(names) if len(names) < 3 else 'all'}: wrong {outcome.wrong}, "
                f"in the switch {len(outcome.in_switch)}, estimates {outcome.estimates}",
                file=sys.stderr,
            )
        late = stage.late_reads
    alone = {names[0]: each for names, each in outcomes.items() if len(names) == 1}
    pairs = [each for names, each in outcomes.items() if len(names) == 2]
    together = outcomes[PAPER]
    wrong: Counter[str] = Counter(name for each in outcomes.values() for name in each.wrong)
    return {
        "correct_alone": sum(not each.wrong for each in alone.values()),
        "correct_pairs": sum(not each.wrong for each in pairs),
        "correct_together": len(PAPER) - len(together.wrong),
        "in_switch_alone": sum(name in each.in_switch for name, each in alone.items()),
        "in_switch_together": len(together.in_switch),
        "on_host_together": sorted(set(PAPER) - set(together.in_switch)),
        "sets_wrong": {" + ".join(names): each.wrong for names, each in outcomes.items() if each.wrong},
        "sets_wrong_by_query": dict(wrong),
        "sets_estimates": sum(each.estimates for each in outcomes.values()),
        "sets_late_reads": late,
    }
