"""The contracts between the engine and its backends.

    engine ──► UpdatesDriver  (Data Updates: Redis)           publisher() and receiver()
    engine ──► archiver ──► ArchiveDriver (Data Archives: SQLite, MongoDB)
                      └──► Spool          (disk, while the archive is away)

A driver turns every error of its client library into a `due.errors.BackendError`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import msgspec

from due.drivers.lasting import NOTHING, Lasting
from due.messages import Item, PackedFrame

NO_RIGHT = (
    "%s has no right to %s: %s; grant its key by `sdnator app enrol`, or under [[grants]] in sdnator.toml"
)
"""Logged where the server refuses an app: its id, what it may not do, and the server's words."""


@runtime_checkable
class ArchiveDriver(Protocol):
    """Data Archives.  The constructor takes the URL.

    Document fields of queries: dataKey, value (and value.*), timestamp, eventTime, appId, instanceId,
    sequence.  Called from one thread at a time per instance for `insert*`/`prune`, and from any
    thread, at the same time, for `find`.

    Every method raises `ArchiveUnavailable` if the same call may succeed later (server away,
    file locked, disk full), otherwise `BackendError`; `find` also raises `InvalidQuery`.
    """

    @property
    def damaged(self) -> int:
        """Rows that were left out of answers so far because they are damaged."""
        ...

    def insert(self, items: Sequence[Item]) -> None:
        """Store items.  On return they are committed.  Idempotent on (instance_id, key, sequence)."""
        ...

    def insert_frames(self, frames: Sequence[PackedFrame]) -> None:
        """Store whole frames; equivalent to `insert` of all their items.

        The archiver uses this because it is faster: a frame may be stored as one row with its
        payload untouched and decoded by `due.codec.unpack` when found.  A frame's items have one key,
        one instance and consecutive sequence numbers from `frame.sequence`; their timestamps lie in
        [first_timestamp, last_timestamp].  Idempotent on (instance_id, key, sequence of each item);
        a frame is always resent unchanged, so (instance_id, key, sequence) of the first
        item suffices.  `frame.index` asks for item-wise storage with an index on values.
        """
        ...

    def find(self, query: Mapping[str, Any], *, limit: int | None = None) -> list[Item]:
        """Items that match a MongoDB-dialect query, oldest first (timestamp, then sequence).

        With a `limit` only the latest are read and returned.

        A plain string under `dataKey` is a DUE key: wildcards allowed, fewer specs match more items
        (`due.keys.Key.matches`).  Times are int ns or datetime (naive = UTC).
        """
        ...

    def prune(
        self, *, before: int | None = None, max_bytes: int | None = None, lasting: Lasting = NOTHING
    ) -> int:
        """Retention: delete items older than `before` (ns), then oldest first down to `max_bytes`.

        Items of `lasting` keys have an age of their own, and by size they go only as far as they exceed half
        of `max_bytes`: see `due.drivers.lasting`.

        Returns how many items were deleted.
        """
        ...

    def tend(self) -> None:
        """Release what is of no more use; called every second, also while nothing is read or written.

        Raises `BackendError`.
        """
        ...

    def close(self) -> None:
        """Release connections and files; further calls raise `BackendError`."""
        ...


@runtime_checkable
class Spool(Protocol):
    """A bounded queue of frames on disk, first in first out, that outlives the process.

    Used by the archiver's thread only.  `take` does not remove: a crash between `take` and `done`
    delivers the frames again, and the archive recognises them.
    """

    @property
    def damaged(self) -> int:
        """Damaged files that were set aside, and damaged records that were dropped, so far."""
        ...

    def put(self, frames: Sequence[PackedFrame]) -> int:
        """Append; returns how many *items* did not fit (they are lost and the archiver counts them).

        Raises `BackendError` where the disk takes nothing; then no frame was appended.
        """
        ...

    def take(self, frames: int) -> list[PackedFrame]:
        """Up to `frames` of the oldest frames, without removing them; [] when empty."""
        ...

    def done(self, frames: int) -> None:
        """Remove that many of the oldest frames."""
        ...

    def adopt(self) -> None:
        """Also take over the spools of instances of the app that have ended."""
        ...

    def __len__(self) -> int:
        """Frames in the spool."""
        ...

    def close(self) -> None:
        """Close files; what is in the spool stays for the next start."""
        ...


class Delivery(msgspec.Struct, frozen=True, gc=False):
    """A received payload."""

    path: str
    """The key's segments, or the name of a control channel."""
    payload: bytes
    token: str = ""
    """Names it for `acknowledge`; empty for best-effort payloads, which need none."""
    tries: int = 1
    """How often it was delivered to a consumer of the group, including this time."""


class Publisher(Protocol):
    """The sending half of a Data Updates connection.  Thread-safe; sends keep their order."""

    def publish(self, path: str, *payloads: bytes) -> None:
        """Send to all current subscribers (best effort); does not wait for the server's answer.

        Raises `UpdatesUnavailable` when there is no connection: the payloads are lost.
        """
        ...

    def append(self, path: str, payload: bytes) -> None:
        """Append to the reliable stream `path`; keeps the payload until its readers have acknowledged it.

        Blocks while the stream's window is full (back-pressure) and while the connection is away.
        """
        ...

    def has_room(self, path: str) -> bool:
        """Whether `append` to this path would go through without waiting for readers."""
        ...

    def settle(self, timeout: float | None = None) -> None:
        """Return when the server has acknowledged everything sent so far; raises `Timeout`.

        Where the URL names sentinels: when enough replicas have it, too.
        """
        ...

    def poll(self) -> float:
        """Periodic work: read acknowledgements, reconnect when due, resend what the server lost.

        Returns the seconds until the next call.
        """
        ...

    def probe(self, now: int) -> None:
        """Ask the server for a sign of life; nothing while there is no connection.

        Args:
            now: of the caller's clock, for `answered`.
        """
        ...

    @property
    def answered(self) -> int:
        """The `now` of the latest `probe` that the server has answered, as far as replies were read; 0: none."""
        ...

    def statistics(self) -> dict[str, int]:
        """Counters for `health`."""
        ...

    def close(self) -> None:
        """Close the connection; unacknowledged payloads are lost."""
        ...


class Receiver(Protocol):
    """The receiving half.  One thread calls `receive` and `acknowledge`; the rest is thread-safe."""

    def subscribe(self, pattern: str) -> None:
        """Receive best-effort payloads of a path; `*` and `**` as in keys."""
        ...

    def unsubscribe(self, pattern: str) -> None:
        """The inverse of `subscribe`."""
        ...

    def follow(self, pattern: str, *, start: str = "") -> None:
        """Also read the reliable streams whose path matches, existing and future ones.

        `start`: "" = where the group stopped, or entries from now on; otherwise a stream id, or "0"
        for all retained entries: the group's position is set to it.
        """
        ...

    def unfollow(self, pattern: str) -> None:
        """The inverse of `follow`."""
        ...

    @property
    def connected(self) -> bool:
        """Whether best-effort payloads of what was subscribed can arrive now."""
        ...

    def receive(self, timeout: float) -> list[Delivery]:
        """Received payloads, in order; [] after `timeout` seconds or `wake`.

        Reconnects with back-off by itself.
        """
        ...

    def acknowledge(self, delivery: Delivery) -> None:
        """Tell the server that the group is done with a delivery; may be sent with the next `receive`."""
        ...

    def activate(self, active: bool, *, take_over: bool = False) -> None:
        """Start or stop reading streams.  `take_over`: the group's other members are known to have ended."""
        ...

    def share(self, shards: frozenset[str] | None) -> None:
        """Read only these shards; None: all that is followed.

        A shard is what one member reads while the others leave it alone: a stream, or on Kafka a partition.  Of a shard
        that is taken away nothing new is fetched; what has been fetched is still delivered.
        """
        ...

    def offered(self) -> tuple[str, ...]:
        """The shards of what is followed, known so far."""
        ...

    def held(self) -> tuple[str, ...]:
        """Shards that are this member's, or of which it has fetched entries that are not acknowledged."""
        ...

    def shard_of(self, delivery: Delivery) -> str:
        """The shard of a delivery from a stream."""
        ...

    def abandon(self, shard: str) -> None:
        """Leave the fetched entries of a shard, which another member may have by now, to whoever reads it."""
        ...

    def wake(self) -> None:
        """Make `receive` return soon."""
        ...

    def set_aside(self, delivery: Delivery, payload: bytes, reason: str) -> None:
        """Set aside a payload on which callbacks keep failing, or that cannot be read.

        While the server is away, up to 16 MiB of them wait in this process, and on Kafka also what its client has taken
        already (`set_aside_waiting`), until a later `receive`, or `close`; what does not fit is lost and counted (`set_aside_lost`).
        """
        ...

    def aside(self) -> list[tuple[bytes, str]]:
        """Payloads set aside by this app, oldest first, with reasons."""
        ...

    def drain(self) -> bool:
        """Take best-effort payloads off the server while the receiving thread is busy; any thread.

        Returns whether there were any.  Payloads beyond the backlog limit are dropped; readers see a gap.
        """
        ...

    def renew(self) -> None:
        """Renew this reader's leases; called about every second from any thread."""
        ...

    def statistics(self) -> dict[str, int]:
        """Counters for `health`."""
        ...

    def close(self) -> None:
        """Close connections.  Unacknowledged deliveries go to another member of the group."""
        ...


def own_group(app: str, instance: str) -> str:
    """The group of a single instance, which reads every path however many instances the app has."""
    return f"{app}:{instance}"


def app_of(group: str) -> str:
    """The app whose instances are this group, or one of them."""
    return group.partition(":")[0]


class UpdatesDriver(Protocol):
    """Data Updates behind one URL."""

    url: str

    def publisher(self, app: str) -> Publisher:
        """A new sending half, which announces its streams as those of `app`."""
        ...

    def receiver(self, group: str, consumer: str, *, shared: bool = False) -> Receiver:
        """A new receiving half: `consumer` of the readers `group`, an app id or an `own_group`.

        `shared`: members divide the streams among them, so order is not kept between them.
        """
        ...

    def close(self) -> None:
        """Release what the driver itself holds."""
        ...
