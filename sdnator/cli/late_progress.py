"""Progress bars that do not stand in front of an error: nothing is drawn before the first step."""

from types import TracebackType
from typing import Any, Self

from rich.progress import Progress

from sdnator.errors import BadInput


class LateProgress(Progress):
    """A `Progress` that is drawn from the first update on, and removed if the input turns out to be bad.

    A command can open its input inside the `with` block: if that fails, only the error is shown.
    """

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, BadInput):
            self.live.transient = True
            self.live.stop()
        elif self.live.is_started:
            self.stop()

    def update(self, *arguments: Any, **changes: Any) -> None:
        """As `Progress.update`; draws the bars if this is the first step."""
        self.start()
        super().update(*arguments, **changes)
