"""Where a pass with blocking may run freely: away from everything that a dry run of the same capture has shown.

    signs of the dry run ──► spans of capture time ──► packets at which the loop has to keep up; others go freely

Until the first block both passes are the same, so nothing is decided where the dry run saw no sign.  Behind it the dry
run still foretells something: what others than the blocked senders do.  That may be wrong, so it is watched: a sign that
was not foretold holds the pass back for a while, and longer each time.  Pure; times are capture time, ns.
"""

from collections.abc import Collection, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apps.messages import Decision

BEFORE_NS: Final = 10_000_000_000
"""Capture time before a sign in which the loop keeps up already: the switch's part in queries has to be as well."""
AFTER_NS: Final = 5_000_000_000
"""And after it: a flood's SYNs are sampled and examined after its report."""
EVIDENCE_BEFORE_NS: Final = 3_000_000_000
"""The same for Kitsune's evidence, of which the feeder knows when it is judged ..."""
EVIDENCE_AFTER_NS: Final = 1_000_000_000
"""... and which is judged at its own time."""
COUNTED_NS: Final = 75_000_000_000
"""And before the end of a block: whether it is extended depends on the drops of its last minute."""
HOLD_NS: Final = 5_000_000_000
"""How long a sign that was not foretold holds a pass back; a decision that comes nevertheless makes it worthless."""
STOPPING: Final = ("block", "meter")
"""Actions of decisions that drop packets."""
ENDING: Final = ("unblock", "unmeter")
"""Actions of decisions that end those."""
MOST_DECISIONS: Final = 1_000
"""Decisions of a pass behind which nothing is foretold."""
_SLICE: Final = 65_536
_LATEST: Final = np.iinfo(np.int64).max


class Sign(NamedTuple):
    """Something that may lead to a decision: evidence, the result of a query, a decision."""

    time_ns: int
    senders: tuple[str, ...] = ()
    """MAC and address of the sender that it is about; empty if that is nobody or unknown."""
    supporting: bool = False
    """It leads to nothing unless the sender has given a sign that is more than that."""
    judged: bool = False
    """It is evidence of which the feeder knows when it is judged."""


def sign_of(value: Any, time_ns: int, *, judged: bool) -> Sign:
    """The sign that evidence or the result of a query is.

    Args:
        value: of the item.
        time_ns: of the item.
        judged: whether it is Kitsune's evidence.
    """
    if not isinstance(value, Mapping):
        return Sign(time_ns, judged=judged)
    sender = value.get("sender")
    found = (
        (sender.get("mac"), sender.get("ip"))
        if isinstance(sender, Mapping)
        else (value.get("address"), value.get("src"))
    )
    senders = tuple(each for each in found if each and isinstance(each, str))
    return Sign(time_ns, senders, supporting=value.get("supporting") is True, judged=judged)


class QuietStretches:
    """The stretches of a capture without a sign, as far as a dry run can tell, and whether it was right so far.

    Args:
        time_ns: capture time of each packet, in the order of the capture.
        signs: what may lead to a decision.
        decided: capture time of the first decision that would have dropped packets; None if there was none.
        foresees: whether a stretch behind that may be quiet.
    """

    def __init__(
        self,
        time_ns: NDArray[np.int64],
        signs: Collection[Sign],
        decided: int | None = None,
        *,
        foresees: bool = True,
    ) -> None:
        self._time_ns = time_ns
        self._suspects: dict[tuple[str, ...], int] = {}
        """Since when more than supporting signs about senders are known."""
        for sign in signs:
            self._suspect(sign)
        by_senders: dict[tuple[tuple[str, ...], bool], list[int]] = {}
        for sign in signs:
            if self._counts(sign):
                by_senders.setdefault((sign.senders, sign.judged), []).append(sign.time_ns)
        self._signs = {each: np.unique(np.array(times, np.int64)) for each, times in by_senders.items()}
        """Times of what counts, by senders, and by whether it is judged evidence."""
        self._foresees = foresees
        self._behind = len(time_ns)
        """Index of the first packet that the first block of the dry run may have met."""
        if decided is not None:
            behind = time_ns >= decided - BEFORE_NS
            self._behind = int(behind.argmax()) if behind.any() else len(time_ns)
        self._standing: dict[str, Decision] = {}
        """What drops packets in this pass, by id ..."""
        self._since: dict[str, int] = {}
        """... since when ..."""
        self._blocked: dict[str, list[tuple[int, int]]] = {}
        """... and when senders were blocked before: from, until."""
        self._decided: list[int] = []
        self._over = False
        self._surprised = False
        self._held_until = -1
        self._begins, self._ends = self._spans()

    def end(self, index: int) -> int:
        """Where the quiet stretch that a packet is in ends.

        Args:
            index: of the packet.

        Returns:
            Index of the first packet behind the stretch, or of one in it that is far enough; `index` itself if the
            packet is in none.
        """
        if self._over or (index >= self._behind and not self._decided):
            return index
        if self._surprised:
            self._surprised = False
            self._held_until = int(self._time_ns[index]) + HOLD_NS
        limit = min(index + _SLICE, len(self._time_ns) if self._decided else self._behind)
        loud = self._is_loud(self._time_ns[index:limit])
        return index + int(loud.argmax()) if loud.any() else limit

    def hear(self, sign: Sign) -> None:
        """Take a sign of this pass, that of a decision excepted."""
        self._suspect(sign)
        if not self._counts(sign) or self._is_stopped(sign):
            return
        if not self._is_loud(np.array([sign.time_ns], np.int64))[0]:
            self._surprised = True
            self._over = self._over or not self._foresees or not self._decided

    def decide(self, decision: Decision) -> None:
        """Take a decision of this pass that drops packets, or ends another that does."""
        self._over = self._over or not self._foresees or len(self._decided) >= MOST_DECISIONS
        self._decided.append(decision.event_time)
        since = self._since.setdefault(decision.id, decision.event_time)
        if decision.action in STOPPING:
            self._standing[decision.id] = decision
        else:
            self._standing.pop(decision.id, None)
            del self._since[decision.id]
            if decision.action == "unblock":
                self._blocked.setdefault(decision.target.address, []).append((since, decision.event_time))
        self._begins, self._ends = self._spans()

    def _suspect(self, sign: Sign) -> None:
        if not sign.supporting:
            since = self._suspects.get(sign.senders, sign.time_ns)
            self._suspects[sign.senders] = min(since, sign.time_ns)

    def _counts(self, sign: Sign) -> bool:
        """Whether a sign may lead to a decision: supporting evidence alone never makes up a bound."""
        return not sign.supporting or self._suspects.get(sign.senders, _LATEST) <= sign.time_ns

    def _is_stopped(self, sign: Sign) -> bool:
        return any(
            since <= sign.time_ns < until
            for who in sign.senders
            for since, until in self._times_blocked().get(who, ())
        )

    def _times_blocked(self) -> dict[str, list[tuple[int, int]]]:
        found = {who: list(times) for who, times in self._blocked.items()}
        for name, each in self._standing.items():
            if each.action == "block":
                found.setdefault(each.target.address, []).append((self._since[name], each.expires or _LATEST))
        return found

    def _spans(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Begins, in order, of the spans in which the loop keeps up, and the latest end until there."""
        blocked = self._times_blocked()
        ends = np.array([each.expires for each in self._standing.values() if each.expires], np.int64)
        decided = np.array(self._decided, np.int64)
        begins, until = [decided - BEFORE_NS, ends - COUNTED_NS], [decided + AFTER_NS, ends + AFTER_NS]
        for (senders, judged), times in self._signs.items():
            stopped = np.zeros(len(times), np.bool_)
            for since, to in (each for who in senders for each in blocked.get(who, ())):
                stopped |= (times >= since) & (times < to)
            begins.append(times[~stopped] - (EVIDENCE_BEFORE_NS if judged else BEFORE_NS))
            until.append(times[~stopped] + (EVIDENCE_AFTER_NS if judged else AFTER_NS))
        begin, end = np.concatenate(begins), np.concatenate(until)
        order = np.argsort(begin, kind="stable")
        return begin[order], np.maximum.accumulate(end[order])

    def _is_loud(self, time_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        found: NDArray[np.bool_] = time_ns < self._held_until
        if len(self._begins):
            span = np.searchsorted(self._begins, time_ns, side="right") - 1
            found |= (span >= 0) & (time_ns <= self._ends[span])
        return found


def laps(time_ns: NDArray[np.int64], ahead_ns: int) -> int:
    """Rounds through the loop where nothing is sent that is later than the oldest packet in flight by more than this.

    Args:
        time_ns: capture time of each packet.
        ahead_ns: how much later.

    Returns:
        About as many rounds, however many packets may be in flight.
    """
    return int(np.count_nonzero(np.diff(time_ns // ahead_ns))) + 1 if len(time_ns) else 0
