"""The controller's part of `benchmarks.soak_state`: what it keeps of one switch, hours of a soak run in minutes.

strangers who finish a handshake ──► KnownSources ─► commands ─┐                                ┌─► switch: takes all
operator: a block every ten seconds ───────────────► decisions ┴─► DesiredSwitch, HeardDecisions ┴─► confirmations, kept

Packets, which are gone once they are published, and the connection to a switch are not in it.
"""

import ipaddress
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

from msgspec import structs

from apps.firewall.evidence.known_sources import KnownSources, in_batches
from apps.firewall.settings import Settings
from apps.messages import Confirmation, Decision, TableCommand, Target
from apps.p4runtime_ctrl.state.decision_ends import DecisionEnds
from apps.p4runtime_ctrl.state.desired_state import Change
from apps.p4runtime_ctrl.state.desired_switch import DesiredSwitch, UpdateOutcome
from apps.p4runtime_ctrl.state.heard_decisions import HeardDecisions
from benchmarks.decisions_core import SWITCH
from benchmarks.soak_state_stage import LOOKS, SECOND, START_NS, send_window, watched
from due.codec import decode_value, encode_value
from sdnator.testing.product_program import program

HOURS: Final = 5.0
_STRANGERS: Final = 1.5
"""A second: as often a source finishes its first handshake in office traffic of 4,000 packets a second."""
_FIRST: Final = int(ipaddress.IPv4Address("23.0.0.0"))
_APART: Final = 7_919
_INSTRUCT_S: Final = 10
_BLOCK_S: Final = 120
_STREAMS: Final = 5
"""Reliable ones of a controller: packets, digests, counts, cells and confirmations."""


class WillingSwitch:
    """A transport to a switch that does all that it is told."""

    def ensure_program(self) -> bool:
        """It was empty."""
        return True

    def ensure_copies(self) -> None:
        """Done."""

    def ensure_digests(self) -> None:
        """Done."""

    def ensure_group(self, group: int, ports: Sequence[int]) -> None:
        """Done."""

    def write(self, changes: Sequence[Change]) -> list[UpdateOutcome]:
        """All are."""
        return [UpdateOutcome() for _ in changes]

    def read_entries(self) -> Iterable[Any]:
        """None: it is asked at the start."""
        return ()

    def read_standing(self, entries: Iterable[Any]) -> Iterable[Any]:
        """As after a start."""
        del entries
        return ()

    def read_counters(self, table_id: int) -> Iterable[Any]:
        """Nothing was dropped."""
        del table_id
        return ()


class ControllerHours:
    """What a controller keeps, and those who tell it."""

    def __init__(self) -> None:
        self._now = START_NS
        self._switch = DesiredSwitch(SWITCH, program(), lambda: (self._now, 0))
        self._transport = WillingSwitch()
        self._heard, self._ends = HeardDecisions(), DecisionEnds()
        self._known = KnownSources(Settings().known_limit)
        self._confirmations = send_window(f"network.confirmation.p4runtime_ctrl.{SWITCH}")
        self._standing: dict[int, Decision] = {}
        """Blocks, by the second in which they end."""
        self._strangers = self._confirmed = 0
        self._switch.bring_up(self._transport)

    def hours(self, hours: float) -> Iterator[float]:
        """Let so many pass; how many have, from time to time."""
        look_s = max(1, round(hours * 3600 / LOOKS))
        for second in range(round(hours * 3600)):
            self._now = START_NS + second * SECOND
            self._learn(second)
            if second % _INSTRUCT_S == 0:
                self._block(second)
            if (over := self._standing.pop(second, None)) is not None:
                self._decide(structs.replace(over, action="unblock", event_time=self._now))
            self._ends.pass_until(self._now // 1000)
            if second % look_s == 0:
                yield second / 3600

    def health(self) -> Mapping[str, Any]:
        """How much is kept."""
        return {
            "confirmed": self._confirmed,
            "known_sources": len(self._known),
            "blocks": self._switch.blocks,
            "decisions_heard": len(self._heard),
            "retained_kb": sum(entry.size for entry in self._confirmations.retained) >> 10,
        }

    def _learn(self, second: int) -> None:
        while self._strangers < _STRANGERS * (second + 1):
            self._strangers += 1
            self._known.learn(str(ipaddress.IPv4Address(_FIRST + self._strangers * _APART)), self._now)
        for batch in in_batches(self._known.changes()):
            command = TableCommand(id=f"firewall-{second}", updates=batch)
            heard = TableCommand.from_value(_received(command.to_value()))
            self._confirm(self._switch.command(heard, self._transport))

    def _block(self, second: int) -> None:
        number, end = second // _INSTRUCT_S, second + _BLOCK_S
        # as in a soak run: nobody in the traffic has one
        target = Target(kind="ip", address=f"198.18.{number // 250 % 250}.{1 + number % 250}")
        self._standing[end] = Decision(
            id=f"block{number}",
            action="block",
            switch="*",
            target=target,
            reason="by hand: no reason given",
            event_time=self._now,
            expires=START_NS + end * SECOND,
        )
        self._decide(self._standing[end])

    def _decide(self, decision: Decision) -> None:
        heard = Decision.from_value(_received(decision.to_value()))
        self._heard.hear(heard)
        self._ends.add(heard)
        self._confirm(self._switch.decide([heard], self._transport))

    def _confirm(self, confirmations: Iterable[Confirmation]) -> None:
        for each in confirmations:
            self._confirmed += 1
            entry = self._confirmations.add(encode_value(each.to_value()))
            entry.id = (self._now // 1_000_000, self._confirmed)
            self._confirmations.acknowledged(entry.id)
            self._confirmations.trim_point(_STREAMS)


def _received(value: object) -> Any:
    """Each message brings names and texts of its own."""
    return decode_value(encode_value(value))


def figures(scale: float = 1.0, *, objects: bool = False) -> dict[str, Any]:
    """Run the part.

    Args:
        scale: share of the hours.
        objects: count Python's objects, too.

    Returns:
        Figures; see `benchmarks.soak_state`.
    """
    run, hours = ControllerHours(), scale * HOURS
    return watched(run.hours(hours), hours, run.health, objects=objects)
