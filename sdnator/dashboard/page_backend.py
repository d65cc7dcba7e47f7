"""What the pages may ask of the app that serves them; panels know this and not the app."""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from apps.messages import Answer
from due import Item
from sdnator.dashboard.board import Board
from sdnator.dashboard.settings import Settings
from sdnator.dashboard.sign_in import Sessions


class PageBackend(Protocol):
    """The dashboard as its pages see it."""

    settings: Settings
    board: Board
    """The latest of everything that is shown."""
    sessions: Sessions
    """Who has signed in."""

    def note(self, who: str, deed: str, source: str) -> None:
        """Keep in the archive what somebody did, and from which address."""
        ...

    def instruct(self, verb: Any, subject: str, who: str, answered: Callable[[Answer], None]) -> str:
        """Tell the firewall; returns the instruction's id, and `answered` gets its answer.  Raises DueError."""
        ...

    def forget(self, instruction: str) -> None:
        """Nobody waits for its answer any more."""
        ...

    def find(self, key: str, start: int, end: int, limit: int) -> tuple[list[Item], bool]:
        """The latest items of the archive, and whether there are older ones; times in ns.  Raises DueError."""
        ...

    def explain(self, key: str, told: Callable[[Mapping[str, Any]], None]) -> Callable[[], None]:
        """Hear once a second what the Sonata adapter does for a key, until what is returned is called.

        Raises DueError; BadInput where too many pages ask.
        """
        ...
