"""Which hosts a query has seen before: those of training, and those that came later.

    new ─ seen at a count that is not reported ────► known
    new ─ reported ─► suspect ─ ten times in a row ► known
                         └───── next window ───────► still new, whatever its count is

Time is capture time, microseconds.
"""

from collections import OrderedDict
from typing import Final

import msgspec

from apps.sonata_adapter.evidence.count_baseline import MOST_HOSTS, CountBaseline

MOST_IN_A_ROW: Final = 10
"""A new host that was reported in so many windows, one after the other, is known: people were told."""
_MOST_SUSPECTS: Final = 4_096


class KnownHosts:
    """A host is new until it has reached the lowest count that is looked at.

    Args:
        baseline: what training saw.
    """

    def __init__(self, baseline: CountBaseline) -> None:
        self._trained = baseline.highest
        self._met = dict.fromkeys(baseline.met, 0)
        """Hosts that came later, and the window in which they were met, us."""
        self._lately = 0
        """Hosts that were met since the last call of `noted`."""
        self._suspects: OrderedDict[str, tuple[int, int]] = OrderedDict()
        """New hosts that were reported: the last window, us, and in how many in a row; the last reported is the last."""

    def knows(self, host: str, window_us: int) -> bool:
        """Whether it was seen before this window; where no more hosts can be kept, everybody counts as known."""
        return self._kept_for_good(host) or self._met.get(host, window_us) < window_us

    def suspect(self, host: str, window_us: int, length_us: int) -> None:
        """A new host was reported in a window, which began at `window_us`."""
        self._met.pop(host, None)  # met in this window, whose report came late
        last_us, row = self._suspects.get(host, (window_us, 1))
        if window_us > last_us:
            row = row + 1 if window_us - last_us <= length_us else 1
        if row >= MOST_IN_A_ROW:
            self._learn(host, window_us)
            return
        self._suspects[host] = (max(window_us, last_us), row)
        self._suspects.move_to_end(host)
        if len(self._suspects) > _MOST_SUSPECTS:
            self._suspects.popitem(last=False)

    def meet(self, host: str, window_us: int, length_us: int) -> None:
        """It was seen in a window at a count that is not reported: it is known, if that is not the rest of an attack."""
        last_us, _ = self._suspects.get(host, (window_us - length_us - 1, 0))
        if not self._kept_for_good(host) and host not in self._met and window_us - last_us > length_us:
            self._learn(host, window_us)

    def noted(self, baseline: CountBaseline, seconds: float) -> CountBaseline:
        """The baseline with the hosts that were met in the last `seconds`.

        If they are more than training led to expect, so are the new hosts that are expected from now on.
        """
        if not self._lately:
            return baseline
        expected = min(round(self._lately * baseline.seconds / seconds), baseline.host_windows)
        self._lately = 0
        return msgspec.structs.replace(baseline, met=tuple(self._met), fresh=max(baseline.fresh, expected))

    def _learn(self, host: str, window_us: int) -> None:
        self._suspects.pop(host, None)
        self._met[host] = window_us
        self._lately += 1

    def _kept_for_good(self, host: str) -> bool:
        return host in self._trained or len(self._trained) + len(self._met) >= MOST_HOSTS
