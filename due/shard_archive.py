"""States of a sharded app in Data Archives.

    save ──► <key>.<path>: state, place ──► archive ──► load: the one with the highest grant, of those the newest

An instance that was replaced while it was suspended may still write a state. Its grant is lower, so it is not found.
"""

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
        """Archive a state; on return it is durable.

        Args:
            path: as `ShardState.save` gets it.
            state: a DUE value.
            place: as `ShardState.save` gets it.

        Raises:
            BackendError: the archive did not answer, or this instance may not write now.
            UnsupportedValue: the state is not of a DUE type.
        """
        if not self._engine.write(f"{self._key}.{path}", {"state": state, "place": place}, [DB_ONLY]):
            raise ArchiveUnavailable(f"the state of {path} was not written: this instance may not write now")
        self._engine.flush(_SAVE_SECONDS)
