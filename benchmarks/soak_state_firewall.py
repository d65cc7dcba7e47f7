"""The firewall's part of `benchmarks.soak_state`: its service lives hours of a soak run in minutes.

Recording ──► evidence, alerts, handshakes, SYN-ACKs, ARP ─┐
switch: its state once a second, answers to decisions ─────┼──► FirewallService, with an archive in a file
operator: a block every ten seconds ───────────────────────┘
"""

import tempfile
from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, cast

import apps.firewall.evidence.archive
import apps.firewall.service
from apps.evidence import JUDGED, TRAINING
from apps.firewall.evidence.history import ANSWERS
from apps.firewall.service import CAPABILITIES, FirewallService
from apps.firewall.settings import Settings
from apps.messages import Confirmation, Decision, Instruction
from benchmarks.decisions_core import SWITCH
from benchmarks.soak_state_recording import Recording, played, recorded
from benchmarks.soak_state_stage import LOOKS, START_NS, FastClock, FastEngine, watched
from due import Engine
from due.codec import encode_value

HOURS: Final = 5.0
PACKETS: Final = 4_000_000
"""Of the recording."""
_DECISIONS: Final = tuple(
    f"network.{family}.firewall." for family in ("block", "block_prefix", "protect", "meter")
)
_COMMANDS: Final = ("network.p4_command.firewall.", "network.p4_command.firewall_kept.")
_CONFIRMATIONS: Final = f"network.confirmation.p4runtime_ctrl.{SWITCH}"
_STATES: Final = f"network.switch.p4runtime_ctrl.{SWITCH}"
_INSTRUCTIONS: Final = "network.instruction.soak_operator.firewall"
_BEGINS: Final = ("block", "protect", "meter")
_INSTRUCT_S: Final = 10
_BLOCK_S: Final = 120
_TICKS: Final = 4
"""A second; a tick looks at clocks, and finds the same whether it comes every 50 ms or more seldom."""


class FirewallHours:
    """The service and its surroundings.

    Args:
        recording: what it hears.
        folder: of the archive.
    """

    def __init__(self, recording: Recording, folder: Path) -> None:
        self._recording = recording
        self._clock = FastClock()
        self._clock.rule(apps.firewall.service, apps.firewall.evidence.archive)
        self._engine = FastEngine("firewall", self._clock, CAPABILITIES, folder, self._on_written)
        self._engine.archived = (*_DECISIONS, ANSWERS, _INSTRUCTIONS)
        self._engine.unwanted = (f"{JUDGED}.",)
        self._answers: deque[Confirmation] = deque()
        self._standing: dict[str, int] = {}
        """Packets that each block in the switch has dropped."""
        self._number = 0
        self.service = FirewallService(cast(Engine, self._engine), Settings())
        self.service.start()

    def hours(self, hours: float) -> Iterator[float]:
        """Let so many pass; how many have, from time to time."""
        training = encode_value(self._recording.training)
        self._engine.hand(f"{TRAINING}.kitsune", training, "kitsune", START_NS)
        messages = self._messages()
        at_us, key, app, payload = next(messages)
        look_s = max(1, round(hours * 3600 / LOOKS))
        for second in range(round(hours * 3600)):
            self._state(second)
            if second % _INSTRUCT_S == 0:
                self._instruct(second // _INSTRUCT_S)
            for part in range(1, _TICKS + 1):
                until = second + part / _TICKS
                while at_us < until * 1_000_000:
                    self._clock.seconds = at_us / 1_000_000
                    self._engine.hand(key, payload, app, START_NS + at_us * 1000)
                    self._confirm()
                    at_us, key, app, payload = next(messages)
                self._clock.seconds = until
                self.service.tick()
                self._confirm()
            if second % look_s == 0:
                yield second / 3600

    def health(self) -> Mapping[str, Any]:
        """Counters of the service, and what the engine keeps beside it."""
        found = {
            name: value for name, value in self.service.health().items() if isinstance(value, int | float)
        }
        return {
            **found,
            "retained_kb": self._engine.retained_bytes >> 10,
            "retained": self._engine.retained(),
        }

    def _messages(self) -> Iterator[tuple[int, str, str, bytes]]:
        turn = 0
        while True:
            since_us = round(turn * self._recording.seconds * 1_000_000)
            for one in self._recording.messages:
                self._number += 1
                payload = played(one, turn, START_NS // 1000 + since_us, self._number)
                yield since_us + one.at_us, one.key, one.app, payload
            turn += 1

    def _state(self, second: int) -> None:
        now = START_NS + second * 1_000_000_000
        for name in self._standing:
            self._standing[name] += 1
        value = {
            "switch": SWITCH,
            "primary": True,
            "event_time": now,
            "blocks": [{"id": name, "packets": packets} for name, packets in self._standing.items()],
        }
        self._engine.hand(_STATES, encode_value(value), "p4runtime_ctrl", now)
        self._confirm()

    def _instruct(self, number: int) -> None:
        # as in a soak run: nobody in the traffic has one
        subject = f"198.18.{number // 250 % 250}.{1 + number % 250}"
        said = Instruction(id=f"said{number}", verb="block", subject=subject, seconds=_BLOCK_S)
        self._engine.hand(_INSTRUCTIONS, encode_value(said.to_value()), "soak_operator")
        self._confirm()

    def _on_written(self, key: str, value: Any) -> None:
        now = self._clock.time_ns()
        if key.startswith(_DECISIONS):
            decision = Decision.from_value(value)
            begins = decision.action in _BEGINS
            if decision.action == "block":
                self._standing[decision.id] = 0
            elif not begins:
                self._standing.pop(decision.id, None)
            said = Confirmation(
                id=decision.id,
                switch=SWITCH,
                state="installed" if begins else "removed",
                action=decision.action,
                target=decision.target,
                event_time=now,
            )
            self._answers.append(said)
        elif key.startswith(_COMMANDS):
            self._answers.append(
                Confirmation(
                    id=value["id"], switch=SWITCH, state="installed", action="insert", event_time=now
                )
            )

    def _confirm(self) -> None:
        while self._answers:
            said = self._answers.popleft()
            value = encode_value(said.to_value())
            self._engine.hand(_CONFIRMATIONS, value, "p4runtime_ctrl", said.event_time)


def figures(scale: float = 1.0, *, objects: bool = False) -> dict[str, Any]:
    """Run the part.

    Args:
        scale: share of the hours.
        objects: count Python's objects, too.

    Returns:
        Figures; see `benchmarks.soak_state`.
    """
    recording, hours = recorded(PACKETS), scale * HOURS
    with tempfile.TemporaryDirectory(prefix="soak-state-") as folder:
        run = FirewallHours(recording, Path(folder))
        found = watched(run.hours(hours), hours, run.health, objects=objects)
    return {**found, "messages_per_hour": round(len(recording.messages) * 3600 / recording.seconds)}
