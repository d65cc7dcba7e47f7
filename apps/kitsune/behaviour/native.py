"""`Behaviour` on the C tracker: equal results, no Python object a packet.

Of training C returns sums, from which the Python baselines learn; when it ends, the baselines are handed to C.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from apps.kitsune.behaviour import behaviour as twin
from apps.kitsune.behaviour import callbacks, contacts, exchanges, findings, outside
from apps.kitsune.behaviour.baseline import (
    BLOCKS,
    LEAST_SHARE,
    MOST_SUBJECTS,
    NEIGHBOURS_SHARE,
    WINDOWS_S,
)
from apps.kitsune.behaviour.behaviour import CALIBRATION_PACKETS, CONTACTS, Behaviour
from apps.kitsune.behaviour.findings import Finding, Statistic
from apps.kitsune.behaviour.outside import NEVER
from apps.kitsune.behaviour.rows import SenderId, address_of, parts_of
from apps.kitsune.blocked import Blocked
from apps.kitsune.kernel import Columns, Kernel
from apps.kitsune.kernel_rows import (
    WORDS,
    SwitchNumbers,
    check,
    events_in,
    rows_of,
    seed,
    sender_parts,
    sender_words,
    victim_version,
)

STATISTICS: Final[tuple[Statistic, ...]] = (
    *CONTACTS,
    *("logins", "one_way", "claims", "thefts", "strangers", "scores", "threshold", "callbacks"),
)
"""In the order of C; the last two have no counter."""
_COUNTED: Final = STATISTICS[:-2]
_NEW_SENDER, _NEW_OWNER = len(STATISTICS), len(STATISTICS) + 1
_BY_SERVICE: Final = ("contacts", "ports", "targets", "logins")
_MOST_WINDOWS: Final = len(WINDOWS_S)
_WHO, _VICTIM, _SUMS = slice(2, 6), slice(6, 8), slice(-_MOST_WINDOWS, None)
_EVENT: Final = np.dtype(
    [
        *(("what", "i4"), ("block", "i4"), *((f"who{word}", "u8") for word in range(4))),
        *(("victim_hi", "u8"), ("victim_lo", "u8"), ("service", "i8"), ("kind", "u8")),
        *((name, "f8") for name in ("nats", "total", "count", "window", "usual", "begun", "time")),
        *(("arrival", "u8"), ("has_sender", "i4"), ("supporting", "i4")),
        *((f"sum{number}", "f8") for number in range(_MOST_WINDOWS)),
    ]
)
"""A `BehaviourEvent` of C; its arrays are fields one by one, which come out as plain numbers."""
_WHAT: Final = "behaviour"


class NativeBehaviour(Behaviour):
    """Follows all senders of all switches.

    Args:
        training_packets: packets of training, to divide it into blocks.
        kernel: the C kernel.
    """

    def __init__(self, training_packets: int, kernel: Kernel) -> None:
        super().__init__(training_packets)
        self._kernel, self._lib = kernel, kernel.lib
        self._silence, self._reached = NEVER, 0.0
        self._switches = SwitchNumbers()
        logins = np.array(sorted(twin.LOGINS), dtype=np.uint16)
        pointer = kernel.pointer("uint16_t", logins)
        state = self._lib.behaviour_new(
            self._limits(), self._counter_settings(), self._per_block, pointer, len(logins), seed()
        )
        if state == kernel.ffi.NULL:
            raise MemoryError("behaviour: no memory for its tables")
        self._state = kernel.ffi.gc(state, self._lib.behaviour_free)

    @classmethod
    def restored(cls, state: Mapping[str, Any], kernel: Kernel) -> "NativeBehaviour":
        """From what `to_state` returned.

        Raises:
            KeyError, TypeError, ValueError: the state is not one.
        """
        former = Behaviour.from_state(state)
        self = cls(1, kernel)
        for name in (
            "seconds",
            "usual_score",
            "senders",
            "_owners",
            "_addresses",
            "_counters",
            "contacts",
            "_learning",
            "_callbacks",
            "_outside",
        ):
            setattr(self, name, getattr(former, name))
        try:
            self._hand_over()
            self._hand_over_names()
        except OverflowError as error:
            raise ValueError(str(error)) from error
        return self

    def add(
        self,
        batch: Columns,
        switch: str,
        scores: npt.NDArray[np.float64],
        trained: int,
        rescored: Callable[[], npt.NDArray[np.float64]],
        threshold: float = 1.0,
        blocked: Blocked | None = None,
    ) -> list[Finding]:
        """As `Behaviour.add`."""
        if not len(scores):
            return []
        rows = rows_of(self._kernel, batch)
        number = self._switches.number(switch)
        self._apply_blocks(blocked if blocked is not None else Blocked())
        if trained:
            null = self._kernel.ffi.NULL
            code = self._lib.behaviour_add(
                self._state, rows.decoded, rows.count, 0, trained, number, null, null, 0.0
            )
            check(code, _WHAT)
            self._learn()
        if trained >= rows.count:
            return []
        if self._learning:
            self._close_training(rescored())
        scores = np.ascontiguousarray(scores, dtype=np.float64)
        logs = self._log_scores(scores)
        code = self._lib.behaviour_add(
            self._state,
            rows.decoded,
            rows.count,
            trained,
            rows.count,
            number,
            self._kernel.pointer("double", scores),
            self._kernel.pointer("double", logs),
            threshold,
        )
        check(code, _WHAT)
        return [self._finding_of(event) for event in self._events()]

    @property
    def subjects(self) -> int:
        """As `Behaviour.subjects`."""
        return int(self._lib.behaviour_subjects(self._state))

    def proven(self, address: int) -> bool:
        """Whether the address has completed a TCP handshake."""
        version, hi, lo = parts_of(address)
        return bool(self._lib.behaviour_proven(self._state, version == 6, hi, lo))

    def to_state(self) -> dict[str, Any]:
        """What training has taught, as plain values for the model file."""
        if not self._learning:
            self.contacts.trained = set(self._contacts(training=True))
        return super().to_state()

    def _limits(self) -> Any:
        return self._kernel.ffi.new(
            "BehaviourLimits *",
            {
                "most_subjects": MOST_SUBJECTS,
                "kept": twin.KEPT,
                "most_contacts": contacts.MOST_CONTACTS,
                "calibration": CALIBRATION_PACKETS,
                "grace_s": contacts.GRACE_S,
                "least_nats": findings.LEAST_NATS,
                "most_nats": findings.MOST_NATS,
                "least_step": findings.LEAST_STEP,
                "least_share": findings.LEAST_SHARE,
                "deciding_nats": findings.DECIDING_NATS,
                "half_life_s": findings.HALF_LIFE_S,
                "neighbours_share": NEIGHBOURS_SHARE,
                "least_scale_share": LEAST_SHARE,
                "asked_s": twin.ASKED_S,
                "present_s": twin.PRESENT_S,
                "theft": twin.THEFT,
                "again_s": twin.AGAIN_S,
                "soon_s": callbacks.SOON_S,
                "most_logins": callbacks.MOST_LOGINS,
                "refused_bytes": twin.REFUSED_BYTES,
                "replies_count": exchanges.REPLIES_COUNT,
                "chosen": twin.CHOSEN,
                "blocks": BLOCKS,
                "in_vain_s": outside.IN_VAIN_S,
                "others": outside.OTHERS,
            },
        )

    def _counter_settings(self) -> Any:
        counters = [self._counters[name] for name in _COUNTED]
        return self._kernel.ffi.new(
            "CounterSettings[]",
            [
                {
                    "windows": len(counter.sums.windows),
                    "own": counter.baseline.own,
                    "rates": counter.baseline.rates,
                    "window": list(counter.sums.windows),
                    "least_scale": counter.baseline.least_scale,
                }
                for counter in counters
            ],
        )

    def _log_scores(self, scores: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        logs = np.maximum(scores, twin.TINY)
        logs /= self.usual_score
        return np.log(logs, logs)

    def _apply_blocks(self, blocked: Blocked) -> None:
        rows = self._switches.changed_blocks(blocked)
        if rows is not None:
            pointer = self._kernel.pointer("uint64_t", rows)
            check(self._lib.behaviour_blocks(self._state, pointer, len(rows)), _WHAT)

    def _events(self) -> list[tuple[Any, ...]]:
        count = self._kernel.ffi.new("long *")
        pointer = self._lib.behaviour_events(self._state, count)
        return events_in(self._kernel, _EVENT, pointer, count[0])

    def _sender(self, words: Sequence[int]) -> SenderId:
        number, port, mac, address = sender_parts(words)
        return self._switches.names[number], port, mac, address_of(*address)

    def _finding_of(self, event: tuple[Any, ...]) -> Finding:
        who, victim, statistic = event[_WHO], event[_VICTIM], STATISTICS[event[0]]
        service, _, nats, total, count, window, usual, begun, time, arrival, named, supporting = event[
            8:-_MOST_WINDOWS
        ]
        return Finding(
            statistic,
            self._sender(who) if named else None,
            address_of(victim_version(who), *victim),
            service,
            nats,
            total,
            count,
            window,
            self.usual_score if statistic == "threshold" else usual,
            begun,
            time,
            arrival,
            bool(supporting),
        )

    def _learn(self) -> None:
        for event in self._events():
            what, block, who, (service, kind) = event[0], event[1], event[_WHO], event[8:10]
            if what >= _NEW_SENDER:
                self._know(self._sender(who), owner=what == _NEW_OWNER)
                continue
            statistic = STATISTICS[what]
            counter = self._counters[statistic]
            whose: Any = self._sender(who) if statistic != "strangers" else None
            if statistic == "strangers":
                whose = (address_of(victim_version(who), *event[_VICTIM]), service)
            elif statistic in (*_BY_SERVICE, "one_way"):
                whose = (whose, service)
            sums = event[_SUMS][: len(counter.sums.windows)]
            counter.baseline.learn(whose, block, sums, _kind_in(statistic, kind))
        times = np.empty(6)
        self._lib.behaviour_training(self._state, self._kernel.pointer("double", times))
        self.begun, self.seconds, self._silence, self._reached, replies, slowest = times.tolist()
        self.contacts.arp_seen = int(replies), slowest

    def _know(self, sender: SenderId, *, owner: bool) -> None:
        if owner:
            self._addresses.add(sender[3])
            self._owners.setdefault(sender[3], set()).add(sender[2])
        else:
            self.senders.add(sender)

    def _calibrate(self, scores: npt.NDArray[np.float64]) -> None:
        self.usual_score = findings.usual_score_of(scores)
        logs = self._log_scores(np.ascontiguousarray(scores))
        count = min(len(logs), self._trained_tail())
        pointer = self._kernel.pointer("double", logs)
        check(self._lib.behaviour_calibrate(self._state, pointer, count, BLOCKS), _WHAT)
        for event in self._events():
            baseline = self._counters[STATISTICS[event[0]]].baseline
            baseline.learn(self._sender(event[_WHO]), event[1], event[_SUMS], None)

    def _trained_tail(self) -> int:
        return int(self._lib.behaviour_tail(self._state))

    def _close_training(self, rescored: npt.NDArray[np.float64]) -> None:
        self.contacts.trained = set(self._contacts(training=False))  # callbacks are learnt from them
        super()._close_training(rescored)
        self._lib.behaviour_close_training(self._state)
        self._hand_over()

    def _close_outside(self) -> None:
        self._outside.restore(self._silence, bool(self._reached))

    def _hand_over(self) -> None:
        """The baselines, what callbacks weigh and what is known of the outside, to C."""
        self._lib.behaviour_outside(self._state, self._outside.longest, self._outside.reachable)
        self._lib.behaviour_arp_grace(self._state, self.contacts.arp_grace)
        self._lib.behaviour_callbacks(self._state, self._callbacks.nats, self._callbacks.back)
        for what, statistic in enumerate(_COUNTED):
            counter, baseline = self._counters[statistic], self._counters[statistic].baseline
            shared = [(_kind_words(statistic, kind), counts) for kind, counts in baseline.shared.items()]
            highest = [
                (self._subject(statistic, whose), counts) for whose, counts in baseline.highest.items()
            ]
            for own, rows in enumerate((shared, highest)):
                keys = _keys(words for words, _ in rows)
                counts = np.array([_padded(counts) for _, counts in rows], dtype=np.float64)
                pointers = self._kernel.pointer("uint64_t", keys), self._kernel.pointer("double", counts)
                check(self._lib.behaviour_baseline(self._state, what, own, *pointers, len(rows)), _WHAT)
            check(
                self._lib.behaviour_scales(
                    self._state, what, counter.usable, *baseline.scales, baseline.rarity
                ),
                _WHAT,
            )

    def check_names(self) -> None:
        """Refuse names of subjects and kinds that cannot be handed to C, as a damaged checkpoint may have them.

        Raises:
            TypeError, ValueError, OverflowError: one of them is none.
        """
        known = len(self._switches.names)
        for statistic in _COUNTED:
            kinds, subjects = self._counters[statistic].baseline.names()
            _keys(_kind_words(statistic, kind) for kind in kinds)
            _keys(self._subject(statistic, whose) for whose in subjects)
        self._trained_names()
        if len(self._switches.names) != known:
            raise ValueError("a baseline is about a switch that is not in the checkpoint")

    def _trained_names(self) -> tuple[npt.NDArray[np.uint64], ...]:
        """Senders, owners of addresses and contacts of training, as C has them."""
        return (
            _keys(map(self._words, self.senders)),
            _keys(
                (version == 6, mac, hi, lo, 0, 0)
                for address, macs in self._owners.items()
                for version, hi, lo in (parts_of(address),)
                for mac in macs
            ),
            _keys(_contact_words(*contact) for contact in self.contacts.trained),
        )

    def _hand_over_names(self) -> None:
        """The names of a saved training, to C."""
        parts = self._trained_names()
        given = [item for part in parts for item in (self._kernel.pointer("uint64_t", part), len(part))]
        check(self._lib.behaviour_know(self._state, *given), _WHAT)

    def _contacts(self, *, training: bool) -> Iterable[contacts.Contact]:
        count = self._lib.behaviour_contacts(self._state, training, self._kernel.ffi.NULL, 0)
        keys = np.zeros((count, WORDS), dtype=np.uint64)
        self._lib.behaviour_contacts(self._state, training, self._kernel.pointer("uint64_t", keys), count)
        for service, six, *ends in keys.tolist():
            version = 6 if six else 4
            yield address_of(version, *ends[:2]), address_of(version, *ends[2:]), service

    def _words(self, sender: SenderId, more: int = 0) -> tuple[int, ...]:
        switch, port, mac, address = sender
        return sender_words(self._switches.number(switch), port, mac, parts_of(address), more)

    def _subject(self, statistic: Statistic, whose: Any) -> tuple[int, ...]:
        if statistic == "strangers":
            version, hi, lo = parts_of(whose[0])
            return (whose[1], version == 6, hi, lo, 0, 0)
        if statistic in (*_BY_SERVICE, "one_way"):
            return self._words(whose[0], whose[1])
        return self._words(whose)


def _kind_in(statistic: Statistic, kind: int) -> Any:
    """A kind as Python's baselines name it; the inverse of `_kind_words`."""
    if statistic in _BY_SERVICE:
        return (kind - 1) >> 1, bool((kind - 1) & 1)
    return kind >> 1 if statistic == "one_way" else None


def _kind_words(statistic: Statistic, kind: Any) -> tuple[int, ...]:
    number = 0
    if statistic in _BY_SERVICE:
        number = (kind[0] << 1 | bool(kind[1])) + 1
    elif statistic == "one_way":
        number = kind << 1 | 1
    return (number, 0, 0, 0, 0, 0)


def _contact_words(source: int, target: int, service: int) -> tuple[int, ...]:
    (version, *first), (other, *second) = parts_of(source), parts_of(target)
    return (service, 6 in (version, other), *first, *second)


def _keys(rows: Iterable[tuple[int, ...]]) -> npt.NDArray[np.uint64]:
    return np.array(list(rows), dtype=np.uint64).reshape(-1, WORDS)


def _padded(counts: list[float]) -> list[float]:
    return counts + [0.0] * (_MOST_WINDOWS - len(counts))
