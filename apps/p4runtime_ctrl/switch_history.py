"""What was decided about a switch before now: from Data Archives, and what was heard since.  I/O."""

import time
from collections import deque
from typing import Final

from apps.messages import Decision, Intake, TableCommand, read_latest
from apps.p4runtime_ctrl.settings import Settings, SwitchSettings
from apps.p4runtime_ctrl.state.heard_decisions import HeardDecisions
from apps.p4runtime_ctrl.state.history import DECISIONS, LONGEST_S, commands_of, decisions_for, in_order
from due import Engine, Item

_RESTORED: Final = 100_000
"""Most archived decisions of a kind, and commands, that are read at a start, the newest."""
_COMMANDS: Final = 1_000
"""Heard live, which the archive need not have yet."""


class SwitchHistory:
    """Decisions and commands of one switch.

    Args:
        engine: initialised.
        settings: of the controller.
        mine: the switch.
        intake: counts what cannot be read.
    """

    def __init__(self, engine: Engine, settings: Settings, mine: SwitchSettings, intake: Intake) -> None:
        self._engine = engine
        self._settings = settings
        self._mine = mine
        self._intake = intake
        self._decisions = HeardDecisions()
        self._commands: deque[tuple[int, TableCommand]] = deque(maxlen=_COMMANDS)

    def heard(self, decision: Decision, at: int) -> None:
        """Note a decision that was heard live, and when it was written."""
        self._decisions.hear(decision, at)

    def heard_command(self, command: TableCommand, at: int) -> None:
        """Note a command that was heard live, where the archive may be behind it, and when it was written."""
        self._commands.append((at, command))

    def read(self) -> list[Decision | TableCommand]:
        """Decisions and commands that may be in force, oldest first; none if the settings say so."""
        if not self._settings.restore:
            return []
        since = self._settings.restore_since
        recently = max(since, time.time_ns() - LONGEST_S * 1_000_000_000)
        items = [item for key in DECISIONS for item in self._archived(key, recently)]
        decisions = decisions_for(self._mine.name, items, list(self._decisions), since, self._intake)
        archived = self._archived(f"network.p4_command.*.{self._mine.name}", since)
        commands = commands_of(archived, since, self._intake)
        return in_order([] if self._mine.mirror else decisions, [*commands, *self._commands])

    def _archived(self, key: str, since: int) -> list[Item]:
        return read_latest(self._engine, {"dataKey": key}, since, _RESTORED)
