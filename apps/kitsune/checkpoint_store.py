"""Checkpoints in Data Archives: in parts that fit into frames, found by what is saved last.  I/O.

    save ──► parts (bytes, at one event time) ──► archived ──► place, event time, length and sum of the whole
    load ──► the newest of the highest grant ──► its parts ──► whole and undamaged, or not there

The parts of one checkpoint are those of one instance at one event time, so that another instance, which was suspended
and writes late, mixes nothing up.
"""

import time
import zlib
from typing import Any, Final

import msgspec

from apps.kitsune.packed_arrays import CheckpointError
from due import DB_ONLY, Engine
from due.errors import ArchiveUnavailable
from due.shard_archive import ArchivedStates
from due.shards import Place

PART_BYTES: Final = 8 << 20
MOST_PARTS: Final = 64
"""Of one checkpoint: 512 MiB, compressed."""
_FLUSH_S: Final = 30.0


class _Whole(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is saved with the place."""

    instance: str
    time: int
    parts: int
    length: int
    sum: int


class CheckpointStore:
    """Writes and reads checkpoints by path.

    Args:
        engine: of the app.
        key: where they are archived; the path comes behind it, and behind `<key>_part` for the parts.
    """

    def __init__(self, engine: Engine, key: str) -> None:
        self._engine = engine
        self._parts = f"{key}_part"
        self._saved = ArchivedStates(engine, key)

    def save(self, path: str, data: bytes, place: Place) -> None:
        """Archive a checkpoint; on return it is in the archive.

        While the archive is away no more is spooled than the parts of one checkpoint.

        Args:
            path: as `ShardState.save` gets it.
            data: the checkpoint.
            place: as `ShardState.save` gets it.

        Raises:
            BackendError: the archive did not take it, or this instance may not write now.
            CheckpointError: it is too long.
        """
        parts = [data[at : at + PART_BYTES] for at in range(0, len(data), PART_BYTES)]
        if len(parts) > MOST_PARTS:
            raise CheckpointError(
                f"a checkpoint of {len(data):,} bytes, at most {MOST_PARTS * PART_BYTES:,} are kept; lower max_streams and max_links"
            )
        now = time.time_ns()
        with self._saved.archived(path, _FLUSH_S):
            for number, part in enumerate(parts):
                value = {"number": number, "data": part}
                if not self._engine.write(f"{self._parts}.{path}", value, [DB_ONLY], event_time=now):
                    raise ArchiveUnavailable(
                        f"the checkpoint of {path} was not written: this instance may not write now"
                    )
        whole = _Whole(
            instance=self._engine.instance_id,
            time=now,
            parts=len(parts),
            length=len(data),
            sum=zlib.crc32(data),
        )
        self._saved.save(path, msgspec.to_builtins(whole), place)

    def load(self, path: str) -> tuple[bytes | CheckpointError, Place] | None:
        """The checkpoint that was saved last.

        Args:
            path: as `ShardState.load` gets it.

        Returns:
            The checkpoint, or what is wrong with it, and its place; None: there is none.

        Raises:
            BackendError: the archive did not answer.
        """
        found = self._saved.load(path)
        if found is None:
            return None
        value, place = found
        try:
            return self._whole(path, value), place
        except CheckpointError as error:
            return error, place

    def _whole(self, path: str, value: Any) -> bytes:
        try:
            whole = msgspec.convert(value, _Whole)
        except (ValueError, TypeError, AttributeError, RecursionError) as error:
            raise CheckpointError(f"not a checkpoint: {error}") from error
        if not 0 <= whole.parts <= MOST_PARTS or not 0 <= whole.time < 1 << 63:
            raise CheckpointError(f"a checkpoint cannot have {whole.parts} parts and the time {whole.time}")
        query = {"dataKey": f"{self._parts}.{path}", "eventTime": whole.time, "instanceId": whole.instance}
        data = b"".join(_part(item.value) for item in self._engine.get(query, limit=whole.parts or 1))
        if len(data) != whole.length or zlib.crc32(data) != whole.sum:
            raise CheckpointError(
                f"the checkpoint is incomplete or changed ({len(data):,} of {whole.length:,} bytes); were archived parts deleted?"
            )
        return data


def _part(value: object) -> bytes:
    data = value.get("data") if isinstance(value, dict) else None
    return data if isinstance(data, bytes) else b""
