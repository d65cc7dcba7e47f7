"""A pipeline as a context manager."""

from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self


class WholeOrNone(ABC):
    """Starts all parts of a pipeline on entering; if one does not start, those that run are stopped at once."""

    def __enter__(self) -> Self:
        try:
            self._start()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    @abstractmethod
    def _start(self) -> None:
        """Start all parts."""

    @abstractmethod
    def stop(self) -> None:
        """Stop all parts, the last started first."""
