"""Reports of all printers in, the state of the fleet and of each printer out.

    manufacturing.clock.data_driver ─────► which step, which machines
    manufacturing.report.data_driver.* ──► FleetTwin ──► manufacturing.fleet.digital_twins
                                                    └──► manufacturing.machine_state.digital_twins.<machine>

A step's fleet is made once, and told again when its clock comes again.  After a restart the twins take the reports
before this step from the archive.
"""

import logging
import sys
from collections.abc import Sequence
from typing import Any

import msgspec

import due.service
from due import NO_WAIT, Capability, DueError, Engine, Interest, Item
from manufacturing.core.printer import Report
from manufacturing.core.twins import FleetTwin
from manufacturing.messages import (
    CLOCK,
    FLEET,
    MACHINE,
    REPORT,
    FleetMessage,
    ReportMessage,
    SimulatedClock,
    from_value,
    to_value,
    tolerant,
)

INTERESTS = (Interest(CLOCK), Interest(f"{REPORT}.*"))
CAPABILITIES = (Capability(FLEET), Capability(f"{MACHINE}.*"))

log = logging.getLogger("digital_twins")


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the twins."""

    seed: int = 0
    """Of the scenario: the good prints with which printers were commissioned follow from it."""
    sensors: bool = True
    """Watch the sensors; otherwise only ruined parts tell of a fault."""


class DigitalTwinsService:
    """The app as `due.service.run` drives it."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine, self._settings = engine, settings
        self._run = ""
        self._clock: SimulatedClock | None = None
        self._twins: FleetTwin | None = None
        self._reports: dict[str, Report] = {}
        """Of the newest step that was reported, by machine."""
        self._told: FleetMessage | None = None
        self._restored = 0

    def start(self) -> None:
        """Subscribe."""
        self._engine.observe(CLOCK).subscribe(tolerant(self._on_clock, log))
        self._engine.observe(f"{REPORT}.*").subscribe(tolerant(self._on_report, log))

    def tick(self) -> None:
        """Nothing to do between messages."""

    def _on_clock(self, item: Item) -> None:
        clock = from_value(item.value, SimulatedClock)
        if clock.run != self._run:
            self._begin(clock)
        self._clock = clock
        if self._told is not None and self._told.fleet.step == clock.step:
            self._tell()
        self._look()

    def _on_report(self, item: Item) -> None:
        message = from_value(item.value, ReportMessage)
        report = message.report
        if self._run and message.run != self._run:
            return
        self._reports[report.machine] = report
        self._look()

    def _begin(self, clock: SimulatedClock) -> None:
        self._run, self._told = clock.run, None
        twins = FleetTwin(clock.machines, self._settings.seed, sensors=self._settings.sensors)
        old = self._archived(clock) if clock.step else []
        twins.restore(old)
        self._restored = len(old)
        self._twins = twins

    def _archived(self, clock: SimulatedClock) -> list[Report]:
        """The reports before this step, each once, by step."""
        try:
            items = self._engine.get(f"{REPORT}.*")
        except DueError as error:
            log.warning("the archive cannot be read, twins begin without a past: %s", error)
            return []
        found: dict[tuple[int, str], Report] = {}
        for item in items:
            try:
                message = from_value(item.value, ReportMessage)
            except msgspec.ValidationError:
                continue
            report = message.report
            if message.run == clock.run and report.step < clock.step and report.machine in clock.machines:
                found.setdefault((report.step, report.machine), report)
        return [found[place] for place in sorted(found)]

    def _look(self) -> None:
        clock, twins = self._clock, self._twins
        if clock is None or twins is None or clock.step <= twins.step:
            return
        reports = [self._reports.get(machine) for machine in clock.machines]
        whole = [report for report in reports if report is not None and report.step == clock.step]
        if len(whole) == len(reports):
            self._told = FleetMessage(self._run, twins.update(whole))
            self._tell()

    def _tell(self) -> None:
        if self._told is None:
            return
        for machine in self._told.fleet.machines:
            self._engine.write(f"{MACHINE}.{machine.machine}", to_value(machine), [NO_WAIT])
        self._engine.write(FLEET, to_value(self._told), [NO_WAIT])

    def stop(self) -> None:
        """Nothing is left to write."""

    def health(self) -> dict[str, Any]:
        """Step, alarms, and what was restored at the start."""
        counts = self._twins.counts if self._twins is not None else None
        return {
            "step": self._twins.step if self._twins is not None else -1,
            "alarms": counts.alarms if counts is not None else 0,
            "inspections": counts.inspections if counts is not None else 0,
            "restored": self._restored,
        }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the app until a signal ends it."""
    return due.service.run("digital_twins", DigitalTwinsService, Settings, INTERESTS, CAPABILITIES, argv)


if __name__ == "__main__":
    sys.exit(main())
