"""States of a sharded app in Data Archives.

    save ──► <key>.<path>: state, place ──► archive ──► load: the one with the highest grant, of those the newest

An instance that was replaced while it was suspended may still write a state. Its grant is lower, so it is not found.
A state in this host's spool is found by nobody on another host: it does not count as saved.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from due.engine import Engine
from due.errors import ArchiveUnavailable
from due.messages import DB_ONLY
from due.shards import Place, grant_of

_LOOK_BACK = 16
"""Newest states of which one is chosen."""
_SAVE_SECONDS = 5.0


class ArchivedStates:
    """Reads and writes states; for the `load` and `save` of a `ShardState`.

    Args:
        engine: of the app.
        key: where the states are written, for instance "network.state.detector"; the path comes behind it.
    """

    def __init__(self, engine: Engine, key: str) -> None:
        self._engine = engine
        self._key = key
        self._behind = False
        """It is not known that what was written last is in the archive."""

    def load(self, path: str) -> tuple[Any, Place] | None:
        """The state that was saved last, and its place.

        Args:
            path: as `ShardState.load` gets it.

        Returns:
            The two values given to `save`; None: nothing was saved.

        Raises:
            BackendError: the archive did not answer.
        """
        found = [
            item
            for item in self._engine.get(f"{self._key}.{path}", limit=_LOOK_BACK)
            if isinstance(item.value, dict) and {"state", "place"} <= item.value.keys()
        ]
        if not found:
            return None
        newest = max(found, key=lambda item: (grant_of(item.value["place"]), item.timestamp))
        return newest.value["state"], newest.value["place"]

    def save(self, path: str, state: Any, place: Place) -> None:
        """Archive a state; on return it is in the archive.

        Args:
            path: as `ShardState.save` gets it.
            state: a DUE value.
            place: as `ShardState.save` gets it.

        Raises:
            BackendError: the archive did not take it, or this instance may not write now.
            UnsupportedValue: the state is not of a DUE type.
        """
        with self.archived(path):
            if not self._engine.write(f"{self._key}.{path}", {"state": state, "place": place}, [DB_ONLY]):
                raise ArchiveUnavailable(
                    f"the state of {path} was not written: this instance may not write now"
                )

    @contextmanager
    def archived(self, path: str, timeout: float = _SAVE_SECONDS) -> Iterator[None]:
        """What is written in the body of `with` is in the archive at its end.

        While the archive is away the body is entered once; then not before it answers again.

        Args:
            path: named in errors.
            timeout: seconds for the archive to take it.

        Raises:
            BackendError: the archive did not take it, or not all of it for certain.
        """
        self._catch_up(path)
        before = self._not_archived()
        self._behind = True
        yield
        self._engine.flush(timeout)
        if self._not_archived() != before:
            raise ArchiveUnavailable(f"the archive did not take the state of {path}")
        self._behind = False

    def _catch_up(self, path: str) -> None:
        if self._behind:
            archive = self._engine.health().get("archive", {})
            if archive.get("away") and archive["backlog"]:
                raise ArchiveUnavailable(
                    f"the state of {path} is not written: what was written before still waits"
                )
        # what was written before may be refused, and is not to be taken for what is written now
        self._engine.flush(_SAVE_SECONDS)

    def _not_archived(self) -> int:
        """Items of this engine, also under other keys, that went elsewhere; their number is the same if none did."""
        health = self._engine.health()
        archive = health.get("archive", {})
        elsewhere = (int(archive.get(name, 0)) for name in ("spooled", "lost", "refused"))
        return int(health["refused"]) + sum(elsewhere)
