"""The printers and their common clock."""

import time
from collections.abc import Callable

from manufacturing.core.orders import Scenario
from manufacturing.core.printer import STEP_S, Printer


class WrongStep(ValueError):
    """The clock cannot be set to this step; the text says which one comes next."""


class TooEarly(Exception):
    """The next step has not come at the declared speed-up; the text says in how many seconds it does."""


class EmulatedFleet:
    """All printers of a scenario; simulated time moves in steps when it is asked to, and not faster than declared.

    Args:
        scenario: says how many printers, with which faults.
        speed_up: simulated seconds in a second at most; 0: without limit.
        clock: seconds that never go back.
    """

    def __init__(
        self, scenario: Scenario, speed_up: float = 0.0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.step = 0
        self.printers = [
            Printer(number, scenario.seed, faulty=scenario.faults) for number in range(scenario.machines)
        ]
        self._pause = STEP_S / speed_up if speed_up else 0.0
        self._clock = clock
        self._next = 0.0
        for printer in self.printers:
            printer.advance(0.0)

    def go_to(self, step: int) -> None:
        """Let time pass up to a step: this one or the next.  Raises WrongStep, TooEarly."""
        if step == self.step:
            return
        if step != self.step + 1:
            raise WrongStep(f"step {step}: it is {self.step}, the next one is {self.step + 1}")
        now = self._clock()
        if now < self._next:
            raise TooEarly(f"the next step comes in {self._next - now:.3f} s")
        self._next = now + self._pause
        self.step = step
        for printer in self.printers:
            printer.advance(step * STEP_S)
