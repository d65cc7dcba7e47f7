"""The sending half of Data Updates on Redis or Valkey.

publish ──PUBLISH due:<path>──►                 pipelined: replies are read later
append  ──XADD due:stream:<path>──►             pipelined, kept until readers have acknowledged

A stream is announced after its first entry, by its producer's app: so an announced path has a stream.
Behind sentinels every connection goes to the primary of that moment; an entry counts once enough replicas have it
(`redis_replicas`), and what the next primary lacks is appended to it again.

A stream is made once in a life of the server: from then on an entry for a stream that is not there is answered with
nothing, and tells that the server has lost it, as by FLUSHALL, or where its clock jumped past the expiry of all keys.
That is treated as a restart.
"""

import logging
import select
import threading
import time
from collections import deque
from collections.abc import Iterable
from typing import Any, NamedTuple

import hiredis

from due.drivers.base import NO_RIGHT
from due.drivers.redis_primary import backoff_for, watch_for
from due.drivers.redis_progress import Question
from due.drivers.redis_receiver import channel_name
from due.drivers.redis_replicas import Confirmations, ReplicaQuestion
from due.drivers.redis_sentinel import least_replicas
from due.drivers.redis_streams import (
    CARE_SECONDS,
    LEAST_PAUSE,
    LIFETIME_S,
    NOBODY,
    NOTHING,
    PRODUCERS,
    SendWindow,
    StreamEntry,
    announced_name,
    next_pause,
    parse_id,
    readers_name,
    stream_name,
)
from due.drivers.redis_wire import Wire
from due.errors import Timeout, UpdatesUnavailable
from due.logs import without_passwords

log = logging.getLogger("due.updates")

_READ_REPLIES_AT = 16
_MOST_OUTSTANDING = 1024
_ASK_SECONDS = 0.02
_LONGEST_PAUSE = 5 * _ASK_SECONDS
_LONG_WAIT_SHARE = 0.25
"""Share of the window that may be full when a writer that waits long each time continues."""
_POLL_SECONDS = 0.5
_CHANNELS = 65536
_RECONNECT_SECONDS = 0.05
_DENIED_TOLD = 64
"""Distinct refusals that are logged."""


_MESSAGE = "message"
"""A best-effort message whose reply is pending; lost with the connection."""
_COMMAND = "command"
"""A command of our own whose reply is pending."""
_EMPTIED = b"emptied"
"""What no server's life is called: the streams of this one are gone, although it was not restarted."""


class _Renewal(NamedTuple):
    """A pending reply about the expiry of a stream, which tells whether it is there."""

    window: SendWindow


_Awaited = StreamEntry | SendWindow | Question | ReplicaQuestion | _Renewal | str | int
"""What a reply belongs to: a number is the `now` of a probe; a window waits for the number of readers that heard of its stream."""


class RedisPublisher:
    """One pipelined connection; see `due.drivers.base.Publisher`."""

    def __init__(self, url: str, app: str, limits: tuple[int, int, float, float]) -> None:
        self._url, self._place = url, without_passwords(url)
        self._app = app
        self._announced = announced_name(app)
        self._limits = limits
        self._lock = threading.RLock()
        self._wire: Wire | None = None
        self._outstanding: deque[_Awaited] = deque()
        self._windows: dict[str, SendWindow] = {}
        self._channels: dict[str, bytes] = {}
        self._life = b""
        self._backoff = backoff_for(url)
        self._watch = watch_for(url)
        self._replicas = Confirmations(least_replicas(url), self._place)
        self._collect_at = 0
        """Number of outstanding replies from which to collect them."""
        self._care_at = 0.0
        self._closed = False
        self.answered = 0
        """See `Publisher.answered`."""
        self._probing = False
        self._connecting = False
        self._denied: set[str] = set()
        counted = ("refused", "denied", "lost_disconnected", "reconnects", "held_back", "resent")
        self._counts = dict.fromkeys(counted, 0)
        self._connect()

    def publish(self, path: str, *payloads: bytes) -> None:
        """See `Publisher.publish`."""
        with self._lock:
            if self._wire is None:
                self._counts["lost_disconnected"] += len(payloads)
                raise UpdatesUnavailable(f"no connection to {self._place}")
            channel = self._channels.get(path) or self._channel(path)
            try:
                self._wire.send_all([(b"PUBLISH", channel, payload) for payload in payloads])
                self._outstanding.extend([_MESSAGE] * len(payloads))
                self._collect()
            except UpdatesUnavailable as error:
                self._lose(error)
                raise

    def append(self, path: str, payload: bytes) -> None:
        """See `Publisher.append`."""
        window = self._windows.get(path) or self._announce(path)
        if not self._append(window, payload):
            self._counts["held_back"] += 1
            self._wait_for_readers(window)
            self._append(window, payload, anyway=True)
        if not window.lasting:
            self._put_off(window)
        if window.half_full and window.ask_again(time.monotonic(), _ASK_SECONDS):
            self._ask(window)

    def has_room(self, path: str) -> bool:
        """See `Publisher.has_room`."""
        window = self._windows.get(path)
        return window is None or (not window.waiting and window.has_room(0))

    def settle(self, timeout: float | None = None) -> None:
        """See `Publisher.settle`."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while not self._settled():
            if deadline is not None and time.monotonic() > deadline:
                replicas = self._wire is not None and self._replicas.missing
                raise Timeout(
                    f"no min_replicas={self._replicas.least} replicas of {self._place} confirmed within {timeout} s"
                    if replicas
                    else f"{self._place} did not acknowledge within {timeout} s"
                )
            with self._lock:
                if self._wire is not None:
                    self._guarded_wait(0.05)
                    continue
            self.poll()
            time.sleep(0.01)

    def _settled(self) -> bool:
        """Whether nothing is awaited; asks the replicas where only they are."""
        with self._lock:
            if self._wire is None or self._outstanding:
                return False
            try:
                self._ask_replicas()
            except UpdatesUnavailable as error:
                self._lose(error)
            return self._wire is not None and not self._replicas.missing

    def poll(self) -> float:
        """See `Publisher.poll`."""
        self._leave_old_primary()
        with self._lock:
            away = self._wire is None
            connecting, self._connecting = self._connecting, self._connecting or away
        if away:
            if not connecting:
                try:
                    if self._backoff.due(time.monotonic()):
                        self._connect()
                finally:
                    self._connecting = False
            return _RECONNECT_SECONDS
        with self._lock:
            if self._wire is None:
                return _RECONNECT_SECONDS
            try:
                self._collect_at = 0
                self._collect(at_least=1)
            except UpdatesUnavailable as error:
                self._lose(error)
            now = time.monotonic()
            for window in list(self._windows.values()):
                if window.ask_again(now, _POLL_SECONDS / 2):
                    self._ask(window)
            if now >= self._care_at:
                self._care(now)
        return _POLL_SECONDS

    def probe(self, now: int) -> None:
        """See `Publisher.probe`; one at a time is on its way."""
        with self._lock:
            if self._wire is None or self._probing:
                return
            try:
                self._wire.send(b"PING")
            except UpdatesUnavailable as error:
                self._lose(error)
                return
            self._outstanding.append(now)
            self._probing = True

    def statistics(self) -> dict[str, int]:
        """Counters, and bytes kept for readers that have not acknowledged."""
        with self._lock:
            connected = int(self._wire is not None)
            confirmed = {"unconfirmed": self._replicas.missing} if self._replicas.least else {}
            return {
                **self._counts,
                "connected": connected,
                "kept_bytes": sum(x.kept_bytes for x in self._windows.values()),
                "streams": len(self._windows),
                **confirmed,
            }

    def close(self) -> None:
        """See `Publisher.close`."""
        with self._lock:
            self._closed = True
            if self._wire is not None:
                self._wire.close()
                self._wire = None
        if self._watch is not None:
            self._watch.close()

    def _channel(self, path: str) -> bytes:
        if len(self._channels) >= _CHANNELS:
            self._channels.clear()
        return self._channels.setdefault(path, channel_name(path))

    def _announce(self, path: str) -> SendWindow:
        with self._lock:
            window = self._windows.get(path)
            if window is None:
                window = self._windows[path] = SendWindow(path, *self._limits)
                if self._wire is not None:
                    self._wire.make_room()
            return window

    def _command(self, *arguments: bytes | str | int, awaited: _Awaited = _COMMAND) -> None:
        """Send a command of our own; its reply is taken later."""
        assert self._wire is not None  # noqa: S101 - callers checked
        self._wire.send(*arguments)
        self._outstanding.append(awaited)

    def _care(self, now: float) -> None:
        """Renew the expiry of streams in use; the others are announced again at their next use."""
        self._care_at = now + CARE_SECONDS
        for window in self._windows.values():
            window.lasting = False
            if window.kept or window.written:
                self._put_off(window)
            else:
                window.made = False  # it expires by right from now on
            window.written = False
            self._turn_away(window)

    def _turn_away(self, window: SendWindow) -> None:
        """Remove names of readers that do not read: whoever may read can add as many as it likes."""
        if window.strangers and self._wire is not None:
            try:
                self._command(b"SREM", readers_name(window.path), *window.strangers)
            except UpdatesUnavailable as error:
                self._lose(error)

    def _put_off(self, window: SendWindow) -> None:
        """Announce the stream and renew its expiry; streams of lost producers expire."""
        with self._lock:
            if self._wire is None:
                return
            try:
                self._command(b"SADD", PRODUCERS, self._app)
                now = int(time.time())
                self._command(b"ZADD", self._announced, now, window.path)
                self._command(b"ZREMRANGEBYSCORE", self._announced, b"-inf", now - LIFETIME_S)
                self._command(b"PUBLISH", self._announced, window.path, awaited=window)
                self._command(b"EXPIRE", self._announced, LIFETIME_S)
                self._command(b"EXPIRE", stream_name(window.path), LIFETIME_S, awaited=_Renewal(window))
                self._command(b"EXPIRE", readers_name(window.path), LIFETIME_S)
            except UpdatesUnavailable as error:
                self._lose(error)
                return
            window.lasting = True

    def _send_entry(self, entry: StreamEntry) -> None:
        if self._wire is None:
            return
        try:
            self._send_kept(self._wire, entry)
            self._collect()
        except UpdatesUnavailable as error:
            self._lose(error)

    def _append(self, window: SendWindow, payload: bytes, *, anyway: bool = False) -> bool:
        with self._lock:
            if self._closed:
                raise UpdatesUnavailable("the engine is closed")
            if not anyway and not window.has_room(len(payload)):
                return False
            self._send_entry(window.add(payload))
            return True

    def _wait_for_readers(self, window: SendWindow) -> None:
        """Back-pressure: wait until half of the window is free, or more if the readers are slow.

        Each question costs wake-ups.  If the last wait was long, sleep for half of that time, and then for as
        long as the readers' rate suggests, instead of waking up for each reply.
        """
        began = looked = time.monotonic()
        long = window.patience > _ASK_SECONDS
        longest, share = (window.patience, _LONG_WAIT_SHARE) if long else (_ASK_SECONDS, 0.5)
        pause, kept = max(LEAST_PAUSE, window.patience), window.kept_bytes
        window.waiting = True
        try:
            while window.excess(share) and not self._closed:
                connected = self._await_answer(window, asleep=pause if long else 0.0)
                if window.excess(share) and not (long and connected):
                    time.sleep(pause)
                now = time.monotonic()
                pause = next_pause(now - looked, kept - window.kept_bytes, window.excess(share), longest)
                looked, kept = now, window.kept_bytes
        finally:
            window.waiting = False
            window.patience = min(_LONGEST_PAUSE, (time.monotonic() - began) / 2)

    def _await_answer(self, window: SendWindow, *, asleep: float) -> bool:
        """Ask for the readers' progress and wait for the answer, without blocking other threads.

        Returns whether there is a connection.
        """
        if self._wire is None:
            self.poll()
        with self._lock:
            wire = self._wire
            if wire is None:
                return False
            self._guarded_take(wire)  # a new question is more informative than the answer to an earlier one
            self._ask(window)
            if self._wire is None:  # lost while asking
                return False
            number = wire.fileno()  # taken here: another thread may close the connection while we wait
        if asleep:
            time.sleep(asleep)
        else:
            poll = select.poll()
            poll.register(number, select.POLLIN)
            poll.poll(1000 * _ASK_SECONDS)
        with self._lock:
            if self._wire is wire:  # no other thread reconnected meanwhile
                self._guarded_take(wire)
        return True

    def _ask(self, window: SendWindow) -> None:
        with self._lock:
            if self._wire is None or window.asked:
                return
            question = Question(window)
            try:
                self._ask_replicas()  # first, so that the answer to the question may count
                self._wire.send_packed(question.command())
            except UpdatesUnavailable as error:
                self._lose(error)
                return
            window.asking(time.monotonic())
            self._outstanding.extend([question] * question.size)

    def _ask_replicas(self) -> None:
        """Raises `UpdatesUnavailable`."""
        question = self._replicas.question()
        if question is not None:
            self._command(*self._replicas.command(), awaited=question)

    def _acknowledged(self, question: Question) -> None:
        """Forget what the readers have acknowledged, here and on the server."""
        window = question.window
        window.asked = False
        up_to = question.answer()
        early = up_to == NOBODY and window.awaits_readers(time.monotonic())
        window.acknowledged(NOTHING if early else up_to, self._replicas.confirmed)
        for group in question.placed & window.places:
            window.places.discard(group)
            self._command(b"XGROUP", b"DESTROY", stream_name(window.path), group)
        if question.surprised:
            self._ask(window)
        point = window.trim_point(len(self._windows))
        if point is not None and self._wire is not None:
            command = (b"XTRIM", stream_name(window.path), b"MINID", b"~", f"{point[0]}-{point[1]}")
            self._wire.send(*command)
            self._outstanding.append(_COMMAND)

    def _collect(self, at_least: int = _READ_REPLIES_AT) -> None:
        if len(self._outstanding) < max(at_least, self._collect_at) or self._wire is None:
            return
        self._take(self._wire.replies())
        while len(self._outstanding) > _MOST_OUTSTANDING:
            self._take(self._wire.wait())
        self._collect_at = len(self._outstanding) + _READ_REPLIES_AT

    def _guarded_take(self, wire: Wire) -> None:
        try:
            self._take(wire.replies())
        except UpdatesUnavailable as error:
            self._lose(error)

    def _guarded_wait(self, timeout: float) -> None:
        if self._wire is None or not self._outstanding:
            return
        try:
            self._take(self._wire.wait(timeout))
        except UpdatesUnavailable as error:
            self._lose(error)

    def _take(self, replies: Iterable[Any]) -> None:
        for reply in replies:
            if not self._outstanding:
                raise UpdatesUnavailable("the server sent a reply that nobody asked for")
            self._answered(self._outstanding.popleft(), reply)

    def _answered(self, awaited: _Awaited, reply: Any) -> None:
        if isinstance(awaited, Question):
            if awaited.take(reply):
                self._acknowledged(awaited)
        elif isinstance(awaited, int):
            self.answered, self._probing = awaited, False
        elif isinstance(awaited, ReplicaQuestion):
            self._replicas.answered(awaited, reply)
        elif isinstance(reply, hiredis.ReplyError):
            self._refused(reply, awaited)
        elif isinstance(awaited, StreamEntry):
            window = self._windows[awaited.path]
            self._look_for(window, there=reply is not None)
            awaited.id, window.made = parse_id(reply), True
        elif isinstance(awaited, _Renewal):
            self._look_for(awaited.window, there=reply != 0)
        elif isinstance(awaited, SendWindow):
            awaited.announced(int(reply), time.monotonic())

    def _look_for(self, window: SendWindow, *, there: bool) -> None:
        """What a stream had that the server has lost is sent again with the next connection."""
        if window.made and not there:
            self._life = _EMPTIED
            raise UpdatesUnavailable(f"the server has lost the stream of {window.path}")

    def _refused(self, reply: Exception, awaited: _Awaited) -> None:
        self._counts["refused"] += 1
        if str(reply).startswith("NOPERM"):
            self._deny(reply, awaited)
            return
        if self._counts["refused"] == self._counts["denied"] + 1:
            log.error("Data Updates refused a message: %s", reply)
        if str(reply).startswith("READONLY"):
            raise UpdatesUnavailable(f"the server is a replica now: {reply}")
        if isinstance(awaited, StreamEntry):  # kept, and sent again on the next connection
            raise UpdatesUnavailable(f"the server refused an entry of {awaited.path}: {reply}")

    def _deny(self, reply: Exception, awaited: _Awaited) -> None:
        """A right is missing: what was to be said is lost, and everything else goes on."""
        self._counts["denied"] += 1
        what = f"an entry of {awaited.path}" if isinstance(awaited, StreamEntry) else "a message"
        if isinstance(awaited, StreamEntry):
            self._windows[awaited.path].discard(awaited)
        if what not in self._denied and len(self._denied) < _DENIED_TOLD:
            self._denied.add(what)
            log.error(NO_RIGHT, self._app, what, reply)

    def _lose(self, error: Exception) -> None:
        if self._wire is None:
            return
        self._wire.close()
        self._wire = None
        self._counts["lost_disconnected"] += self._outstanding.count(_MESSAGE)
        self._outstanding.clear()
        self._probing = False
        self._replicas.lost()
        for window in self._windows.values():
            window.asked = False
        delay = self._backoff.failed(time.monotonic())
        log.warning("lost Data Updates at %s: %s; retrying in %.2f s", self._place, error, delay)

    def _leave_old_primary(self) -> None:
        """Without the lock: whoever holds it may be waiting for the old one."""
        wire = self._wire
        if self._watch is None or wire is None:
            return
        successor = self._watch.successor([wire.primary])
        if successor and successor != wire.primary:
            wire.interrupt()
            with self._lock:
                if self._wire is wire:
                    self._lose(UpdatesUnavailable(f"{successor} is the primary now"))

    def _connect(self) -> None:
        """Without the lock until the server has answered: nobody waits for one that does not."""
        try:
            wire = Wire(self._url)
            life = wire.life()
        except UpdatesUnavailable as error:
            delay = self._backoff.failed(time.monotonic())
            log.warning("%s; retrying in %.2f s", error, delay)
            return
        with self._lock:
            self._take_up(wire, life)

    def _take_up(self, wire: Wire, life: bytes) -> None:
        if self._closed:
            wire.close()
            return
        self._backoff.succeeded()
        self._wire = wire
        if self._life:
            self._counts["reconnects"] += 1
            log.warning("reconnected to Data Updates at %s", self._place)
        try:
            for window in self._windows.values():
                self._restore(wire, window, restarted=life != self._life)
            self._life = life
        except UpdatesUnavailable as error:
            self._lose(error)

    def _restore(self, wire: Wire, window: SendWindow, *, restarted: bool) -> None:
        """Resend what the server may not have; readers recognise repeats.

        A replica that has become the primary may lack the latest entries: it gets all that somebody still has to
        read. Those that all have read are missed by nobody, unless the stream is gone.
        """
        self._guarded_settle(wire)
        wire.make_room()
        window.lasting = False
        if restarted:
            window.forget_ids(time.monotonic())
            there = self._called(wire, "EXISTS", stream_name(window.path))
            done = 0
            if not there:
                done = len(window.retained)
                self._resend(wire, list(window.retained))
            self._restore_groups(wire, window, done)
        self._resend(wire, [entry for entry in window.kept if entry.id is None])
        if window.kept or window.retained:
            self._put_off(window)

    def _restore_groups(self, wire: Wire, window: SendWindow, done: int) -> None:
        """The groups that lived go on behind what they had all done, whether or not a member of them still lives.

        Their work lists are theirs alone to make; a place on the stream tells their next member where to begin, which
        otherwise would begin with what comes after it.
        """
        groups = sorted(window.living_groups())
        if groups:
            name = stream_name(window.path)
            # what others have appended already may be new to the group
            start = "$" if self._called(wire, "XLEN", name) == done else "0"
            window.places.update(groups)
            for group in groups:
                # refused for a group whose place another producer was quicker to restore
                self._called(wire, "XGROUP", "CREATE", name, group, start, "MKSTREAM")

    def _resend(self, wire: Wire, entries: Iterable[StreamEntry]) -> None:
        for entry in entries:
            self._counts["resent"] += 1
            self._send_kept(wire, entry)
            self._collect()

    def _send_kept(self, wire: Wire, entry: StreamEntry) -> None:
        """Send an entry of a window; its id, and which replicas have it, are learnt later."""
        only_there = (b"NOMKSTREAM",) if self._windows[entry.path].made else ()
        wire.send(b"XADD", stream_name(entry.path), *only_there, b"*", b"f", entry.payload)
        entry.number = self._replicas.number()
        self._outstanding.append(entry)

    def _called(self, wire: Wire, *command: bytes | str) -> Any:
        """The reply, after all replies to what was sent before; an error of the server is one, too."""
        self._guarded_settle(wire)
        return wire.call(*command)

    def _guarded_settle(self, wire: Wire) -> None:
        while self._outstanding:
            self._take(wire.wait())
