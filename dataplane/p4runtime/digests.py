"""Digest lists: buffering, suppression of duplicates, acknowledgements (P4Runtime 1.4, section 9.9).

    switch ── Digest ──► buffer (distinct) ── full or old enough ──► DigestList bytes ──► stream
                             ▲                                            │
                             └── not again while in the cache ◄───────────┘ until ack or ack_timeout

Lists are written as protobuf bytes directly, for the reason given in packet_io.py; their samples come
from the switch as they travel (compiler/samples.py).  Pure but for the
time stamp of a list: times are arguments.  The packet loop fills lists while controllers acknowledge and
configure in threads of their own, so one lock is held for each of these.

Samples of a block stay end to end while none of them is suppressed: without an ack time-out, and with different hashes.
"""

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dataplane.compiler.machine import Digest
from dataplane.compiler.samples import Samples, varint
from dataplane.p4runtime.schema import BoundDigest, Schema
from dataplane.p4runtime.status import Exists, InvalidArgument, MissingEntity
from dataplane.p4runtime.table_entities import DELETE, INSERT, Undo
from p4rt import p4runtime

MAX_LIST = 4096
MAX_UNACKNOWLEDGED = 1 << 16
"""Samples of one digest that are kept from being sent twice."""


@dataclass(slots=True)
class _Stream:
    """One configured digest."""

    digest: BoundDigest
    config: Any
    buffer: dict[bytes, None] = field(default_factory=dict)
    """What waits, ..."""
    parts: list[Samples] = field(default_factory=list)
    """... or this, of which no two are equal; one of both is empty."""
    since_ns: int = 0
    cache: dict[int, tuple[int, tuple[bytes, ...]]] = field(default_factory=dict)
    cached: set[bytes] = field(default_factory=set)

    @property
    def list_size(self) -> int:
        """Members after which a list is sent."""
        if self.config.max_timeout_ns == 0:
            return 1
        size: int = self.config.max_list_size
        return min(size, MAX_LIST) if size > 0 else MAX_LIST

    @property
    def waiting(self) -> int:
        """Samples that wait."""
        return len(self.buffer) or sum(map(len, self.parts))

    def take_whole(self, samples: Samples) -> bool:
        """Take samples as they are, if none of them may be suppressed."""
        if self.config.ack_timeout_ns or self.cached or self.buffer:
            return False
        hashes = np.concatenate([part.hashes for part in (*self.parts, samples)])
        hashes.sort()
        if (hashes[1:] == hashes[:-1]).any():
            return False
        self.parts.append(samples)
        return True

    def divide(self) -> None:
        """What waits in pieces waits sample by sample from now on."""
        for part in self.parts:
            self.buffer.update(dict.fromkeys(part.each()))
        self.parts.clear()


class DigestLists:
    """The digests of a pipeline: their configuration and what waits to be sent.

    wall_ns: clock of the lists' time stamps
    """

    def __init__(self, schema: Schema, wall_ns: Callable[[], int] = time.time_ns) -> None:
        self._digests = schema.digests
        self._by_name: dict[str, _Stream] = {}
        self._wall_ns = wall_ns
        self._lock = threading.Lock()
        self._list_id = 0
        self.unconfigured = 0
        self.suppressed = 0

    # -- configuration --------------------------------------------------------------------------------

    def write(self, kind: int, message: Any) -> Undo:
        """Insert, modify or delete a DigestEntry."""
        digest = self._known(message.digest_id)
        old = self._by_name.get(digest.name)
        if kind == INSERT and old is not None:
            raise Exists(f"digest {digest.name} is already configured")
        if kind != INSERT and old is None:
            raise MissingEntity(f"digest {digest.name} is not configured")
        config = message.config
        if min(config.max_timeout_ns, config.max_list_size, config.ack_timeout_ns) < 0:
            raise InvalidArgument(f"digest {digest.name}: time-outs and list size cannot be negative")
        with self._lock:
            if kind == DELETE:
                del self._by_name[digest.name]
            else:
                stream = old or _Stream(digest, None)
                stream.divide()
                self._by_name[digest.name] = replace(stream, config=_copy(config))

        def undo() -> None:
            with self._lock:
                if old is None:
                    del self._by_name[digest.name]
                else:
                    self._by_name[digest.name] = old

        return undo

    def read(self, message: Any) -> Iterator[Any]:
        """Entities for a DigestEntry filter; id 0 = all that are configured."""
        if message.digest_id:
            name = self._known(message.digest_id).name
            if name not in self._by_name:
                raise MissingEntity(f"digest {name} is not configured")
        for stream in list(self._by_name.values()):
            if message.digest_id in (0, stream.digest.id):
                entity = p4runtime.Entity()
                entity.digest_entry.digest_id = stream.digest.id
                entity.digest_entry.config.CopyFrom(stream.config)
                yield entity

    def _known(self, digest_id: int) -> BoundDigest:
        digest = self._digests.get(digest_id)
        if digest is None:
            raise InvalidArgument(f"digest id {digest_id} is not in the p4info")
        return digest

    # -- lists ----------------------------------------------------------------------------------------

    def add(self, digests: Iterable[Digest], now_ns: int) -> list[bytes]:
        """Take in what the switch made; the StreamMessageResponses that are complete now.

        now_ns: any monotonic clock
        """
        ready: list[bytes] = []
        streams = self._by_name
        with self._lock:
            for digest in digests:
                stream = streams.get(digest.name)
                if stream is None:
                    self.unconfigured += 1
                    continue
                stream.divide()
                sample, buffer = digest.sample, stream.buffer
                if sample in buffer or sample in stream.cached:
                    self.suppressed += 1
                    continue
                if not buffer:
                    stream.since_ns = now_ns
                buffer[sample] = None
                if len(buffer) >= stream.list_size:
                    ready.append(self._list(stream, now_ns))
        return ready

    def add_samples(self, name: str, samples: Samples, now_ns: int) -> list[bytes]:
        """As `add`, of one digest."""
        with self._lock:
            stream = self._by_name.get(name)
            if stream is None:
                self.unconfigured += len(samples)
                return []
            ready, first = list[bytes](), 0
            while first < len(samples):
                # so many at most fill the list
                end = min(first + max(0, stream.list_size - stream.waiting), len(samples))
                ready += self._fill(stream, samples.part(first, end), now_ns)
                first = end
            return ready

    def _fill(self, stream: _Stream, samples: Samples, now_ns: int) -> list[bytes]:
        before = stream.waiting
        if not stream.take_whole(samples):
            stream.divide()
            fresh = dict.fromkeys(samples.each())
            for known in stream.cached.intersection(fresh):
                del fresh[known]
            stream.buffer.update(fresh)
        now = stream.waiting
        self.suppressed += len(samples) - (now - before)
        if not before:
            stream.since_ns = now_ns
        return [self._list(stream, now_ns)] if now >= stream.list_size else []

    def due(self, now_ns: int) -> list[bytes]:
        """Lists whose time-out has passed; also forgets what was not acknowledged in time."""
        ready = []
        with self._lock:
            for stream in self._by_name.values():
                self._forget(stream, now_ns - stream.config.ack_timeout_ns)
                if stream.waiting and now_ns - stream.since_ns >= stream.config.max_timeout_ns:
                    ready.append(self._list(stream, now_ns))
        return ready

    def next_due_ns(self) -> int | None:
        """When the next list will be due, on the clock of `add`; None = nothing waits."""
        with self._lock:
            times = [s.since_ns + s.config.max_timeout_ns for s in self._by_name.values() if s.waiting]
        return min(times, default=None)

    def acknowledge(self, digest_id: int, list_id: int) -> None:
        """The controller has acted on a list.  Raises InvalidArgument for an unknown digest id."""
        stream = self._by_name.get(self._known(digest_id).name)
        with self._lock:
            if stream is not None and list_id in stream.cache:
                stream.cached.difference_update(stream.cache.pop(list_id)[1])

    def forget_sent(self) -> None:
        """The controller has changed: samples may be sent again."""
        with self._lock:
            for stream in self._by_name.values():
                stream.cache.clear()
                stream.cached.clear()

    @staticmethod
    def _forget(stream: _Stream, before_ns: int) -> None:
        for list_id in [list_id for list_id, (sent, _) in stream.cache.items() if sent <= before_ns]:
            stream.cached.difference_update(stream.cache.pop(list_id)[1])

    def _list(self, stream: _Stream, now_ns: int) -> bytes:
        self._list_id += 1
        if stream.parts:
            parts = [part.data for part in stream.parts]
            stream.parts.clear()
            return encode_list(stream.digest, self._list_id, parts, self._wall_ns())
        samples = tuple(stream.buffer)
        stream.buffer.clear()
        if stream.config.ack_timeout_ns:
            stream.cache[self._list_id] = (now_ns, samples)
            stream.cached.update(samples)
            while len(stream.cached) > MAX_UNACKNOWLEDGED:
                # of a controller that acknowledges nothing; the oldest may be sent again
                stream.cached.difference_update(stream.cache.pop(next(iter(stream.cache)))[1])
        return encode_list(stream.digest, self._list_id, samples, self._wall_ns())


def encode_list(
    digest: BoundDigest, list_id: int, samples: Iterable[bytes | memoryview], stamp_ns: int
) -> bytes:
    """A StreamMessageResponse with a DigestList of samples, each of them alone or several end to end."""
    head = b"".join((b"\x08", varint(digest.id), b"\x10", varint(list_id)))
    body = b"".join((head, *samples, b"\x20", varint(stamp_ns)))
    return b"".join((b"\x1a", varint(len(body)), body))


def _copy(message: Any) -> Any:
    copy = type(message)()
    copy.CopyFrom(message)
    return copy
