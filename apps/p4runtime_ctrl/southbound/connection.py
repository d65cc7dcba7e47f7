"""The stream to one switch: arbitration, packet-ins, notifications; opened again whenever it ends.  I/O.

A lost stream is opened again, with growing pauses.  The active controller claims to be primary with its rank, a
standby with the lowest election id.  When the switch reports that there is no primary, a standby waits a
moment for the active one, then asks to be primary, and stays so until the active one claims the switch above it
(`outbid`).  With `steps_up` a standby that is primary at once, because the switch is new, claims it with its rank, too.
"""

import threading
import time
from typing import Any, Final, Protocol

import grpc
from google.protobuf.message import DecodeError

from apps.p4runtime_ctrl.southbound.claim_pauses import ClaimPauses
from apps.p4runtime_ctrl.southbound.digest_rows import ReceivedDigests
from apps.p4runtime_ctrl.southbound.session import (
    Address,
    CompiledProgram,
    Outgoing,
    P4RuntimeSession,
    translated,
)
from p4rt import P4RuntimeStub, p4runtime, stream_of_bytes

_FIRST_PAUSE: Final = 0.05
_BACKUP_WAITS_S: Final = 0.5
_LONGEST_LINGER_S: Final = 0.01
_LISTS: Final = 4
"""Most digest lists handed over at once: up to eight thousand frames, so that all parts work at the same time."""
_BYTES: Final = 32 << 20
"""Of digest lists that wait for the listener."""
_SHARE: Final = 4
"""A list waits this many times as long as the previous one took to handle."""
_PRIMARY, _NO_PRIMARY = 0, 5
_HIGHEST_ID: Final = (1 << 128) - 1


class Listener(Protocol):
    """Callbacks for one switch; called from the connection's threads."""

    def became_primary(self, session: "P4RuntimeSession") -> None: ...
    def became_backup(self) -> None: ...
    def lost(self, cause: str) -> None: ...
    def packets(self, messages: list[Any]) -> None: ...
    def digests(self, lists: list[Any]) -> None: ...
    def other(self, message: Any) -> None: ...


class Connection:
    """Keeps the stream to one switch open and its listener informed.

    Packet-ins and digests are handed over in lists, each in its order: as soon as the listener is free again and at most
    `linger_s` after the first of them, never more than `batch` at once.  If the listener needs long for a list
    the next one waits four times as long, 10 ms at most: each list costs milliseconds however short it is, and under
    a flood many short ones would keep packets from being read.  While the listener is busy at most four batches
    wait; then reading stops and gRPC's flow control stops the switch.
    """

    def __init__(
        self,
        address: Address,
        pipeline: CompiledProgram,
        listener: Listener,
        *,
        batch: int = 1024,
        linger_s: float = 0.002,
        longest_pause_s: float = 0.2,
        active: bool = True,
        patience_s: float = _BACKUP_WAITS_S,
        steps_up: bool = False,
    ) -> None:
        self._address = address
        self._pipeline = pipeline
        self._listener = listener
        self._batch = batch
        self._linger_s = linger_s
        self._longest_pause_s = longest_pause_s
        self._closing = threading.Event()
        self._gathered: list[Any] = []
        self._bytes_in = self._bytes_out = 0
        """Bytes of digest lists so far, each counted by one thread alone."""
        self._changed = threading.Condition()
        self._call: Any = None
        self._stub: Any = None
        self._requests = Outgoing()
        self._election_id: Any = None
        self._opened_ms = 0
        self._highest = 0
        """The highest election id that the switch has seen, as far as it said."""
        self._claim_pauses = ClaimPauses()
        self._told: tuple[bool, Any] | None = None
        """What the listener knows: primary or not, and the election id of its writes."""
        self._active = active
        self._patience_s = patience_s
        self._steps_up = steps_up
        self._patience: threading.Timer | None = None
        name = address.target
        self._threads = [
            threading.Thread(target=self._keep_open, name=f"stream {name}", daemon=True),
            threading.Thread(target=self._hand_over, name=f"packets {name}", daemon=True),
        ]

    def open(self) -> None:
        """Start; the listener is notified of success and failure."""
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End the stream (a backup takes over at once) and wait for the threads."""
        self._closing.set()
        self._stop_waiting()
        self.break_off()
        with self._changed:
            self._changed.notify_all()
        for thread in self._threads:
            if thread.is_alive() and thread is not threading.current_thread():
                thread.join(timeout=5)

    @property
    def works(self) -> bool:
        """Whether its threads run; a thread that raised an error has ended, and the error is in the log."""
        return self._closing.is_set() or all(thread.is_alive() for thread in self._threads)

    def stand(self, *, active: bool) -> None:
        """Become active or standby of the controllers of this switch."""
        if active != self._active:
            self._active = active
            self._claim(self._usual_id())

    def outbid(self) -> bool:
        """Claim the switch above whoever is primary, unless its rank is higher or the last claim was moments ago.

        Clocks of two machines differ, so the time of a stream does not decide between two of one rank.

        Returns:
            Whether it was claimed.
        """
        of_lower_rank = self._highest >> 64 <= self._address.rank
        if not (self._active and self._told == (False, None) and of_lower_rank):
            return False
        if not self._claim_pauses.due(time.monotonic()):
            return False
        self._claim(min(max(self._highest + 1, self._usual_id()), _HIGHEST_ID))
        return True

    def break_off(self) -> None:
        """Close this stream; a new one is opened unless `close` was called."""
        call = self._call
        if call is not None:
            call.cancel()

    def _keep_open(self) -> None:
        # The channels stay for good and reconnect by themselves: a channel that is closed while its stream is being
        # cancelled corrupts gRPC's memory once in some eighty times (grpcio 1.85 without EventEngine).
        with self._address.channel() as stream, self._address.channel() as calls:
            self._stub = P4RuntimeStub(calls)
            self._keep_streaming(stream_of_bytes(stream))

    def _keep_streaming(self, open_stream: Any) -> None:
        pause = _FIRST_PAUSE
        answered = True
        while not self._closing.is_set():
            opened = time.monotonic()
            # Only a call that waits makes the channel try again as often as its options say; to calls that fail at
            # once, a switch that is back shows itself two seconds later.
            cause = self._one_stream(open_stream, waits=not answered)
            if self._closing.is_set():
                return
            answered = self._told is not None
            self._listener.lost(cause)
            if time.monotonic() - opened > self._longest_pause_s * 2:
                pause = _FIRST_PAUSE
            self._closing.wait(pause)
            pause = min(pause * 2, self._longest_pause_s)

    def _one_stream(self, open_stream: Any, *, waits: bool) -> str:
        """Open the stream, waiting for the switch or not, and read it to its end; returns why it ended."""
        self._requests = Outgoing()
        self._told = None
        self._claim(self._usual_id())
        self._call = open_stream(iter(self._requests), wait_for_ready=waits)
        if self._closing.is_set():
            self._call.cancel()
        try:
            for data in self._call:
                self._take(data)
        except grpc.RpcError as error:
            return str(translated(error, self._address.target))
        else:
            return f"switch at {self._address.target} closed the stream"
        finally:
            self._stop_waiting()
            self._requests.end()
            self._call = None

    def _usual_id(self) -> int:
        rank = self._address.rank if self._active else 0
        # even if the wall clock is set back, a new stream must win over the previous one
        self._opened_ms = max(time.time_ns() // 1_000_000, self._opened_ms + 1)
        return rank << 64 | self._opened_ms

    def _claim(self, election_id: int) -> None:
        """Ask to be primary under this id."""
        self._election_id = p4runtime.Uint128(high=election_id >> 64, low=election_id & (1 << 64) - 1)
        request = p4runtime.StreamMessageRequest()
        request.arbitration.device_id = self._address.device_id
        request.arbitration.election_id.CopyFrom(self._election_id)
        self._requests.put(request)

    def _take(self, data: bytes) -> None:
        """One message of the stream; digest lists, which are most of it, stay bytes."""
        digests = ReceivedDigests.of(data)
        if digests is not None:
            self._acknowledge(digests)
            self._bytes_in += len(data)
            self._gather(digests)
            return
        try:
            message = p4runtime.StreamMessageResponse.FromString(data)
        except DecodeError:
            self._listener.other(p4runtime.StreamMessageResponse())
            return
        kind = message.WhichOneof("update")
        if kind == "packet":
            self._gather(message.packet)
        elif kind == "digest":
            self._acknowledge(message.digest)
            self._gather(message.digest)
        elif kind == "arbitration":
            self._arbitrated(message.arbitration)
        else:
            self._listener.other(message)

    def _arbitrated(self, arbitration: Any) -> None:
        """The switch repeats its status whenever a controller comes or goes; only changes are passed on."""
        self._stop_waiting()
        highest = self._highest = arbitration.election_id.high << 64 | arbitration.election_id.low
        if arbitration.status.code == _NO_PRIMARY:
            self._fill_the_place(min(max(highest + 1, self._usual_id()), _HIGHEST_ID))
            return
        primary = arbitration.status.code == _PRIMARY
        if primary and self._steps_up and self._election_id.high < self._address.rank:
            # of a switch that has seen no higher id; the next standby, or a watchdog, would win by its time alone
            self._claim(self._address.rank << 64 | self._opened_ms)
            return
        told = (primary, self._election_id if primary else None)
        if told == self._told:
            return
        self._told = told
        if primary:
            session = P4RuntimeSession(
                self._stub, self._address, self._pipeline, self._election_id, self._requests
            )
            self._listener.became_primary(session)
        else:
            self._listener.became_backup()

    def _fill_the_place(self, election_id: int) -> None:
        if self._active:
            self._claim(election_id)
            return
        self._patience = threading.Timer(self._patience_s, self._claim, (election_id,))
        self._patience.daemon = True
        self._patience.start()

    def _stop_waiting(self) -> None:
        if self._patience is not None:
            self._patience.cancel()
            self._patience = None

    def _acknowledge(self, digest: Any) -> None:
        if not self._address.remembers and digest.digest_id in self._pipeline.digests_of_frames:
            return
        request = p4runtime.StreamMessageRequest()
        request.digest_ack.digest_id = digest.digest_id
        request.digest_ack.list_id = digest.list_id
        self._requests.offer(request)

    def _gather(self, message: Any) -> None:
        gathered = self._gathered
        gathered.append(message)
        count = len(gathered)
        if count != 1 and count % self._batch and self._bytes_in - self._bytes_out < _BYTES:
            return
        with self._changed:
            self._changed.notify_all()
            while self._is_behind() and not self._closing.is_set():
                self._changed.wait(timeout=1)

    def _is_behind(self) -> bool:
        return len(self._gathered) >= 4 * self._batch or self._bytes_in - self._bytes_out >= _BYTES

    def _hand_over(self) -> None:
        spent = 0.0
        while not self._closing.is_set():
            with self._changed:
                while not self._gathered and not self._closing.is_set():
                    self._changed.wait(timeout=1)
                if len(self._gathered) < self._batch:
                    self._changed.wait(timeout=max(self._linger_s, min(_SHARE * spent, _LONGEST_LINGER_S)))
            began = time.monotonic()
            while self._gathered and not self._closing.is_set():
                # appends go to the same list from the other thread; both slices are atomic
                messages = self._gathered[: self._batch]
                del self._gathered[: len(messages)]
                self._bytes_out += sum(each.size for each in messages if type(each) is ReceivedDigests)
                with self._changed:
                    self._changed.notify_all()
                self._tell(messages)
                if len(self._gathered) < self._batch:
                    break
            spent = time.monotonic() - began

    def _tell(self, messages: list[Any]) -> None:
        """One list of each kind.

        Under load a digest arrives every 2 ms; handling it at once would split packet-ins into tiny batches.
        """
        packets = [each for each in messages if type(each) is p4runtime.PacketIn]
        digests = [each for each in messages if type(each) is not p4runtime.PacketIn]
        for first in range(0, len(digests), _LISTS):
            self._listener.digests(digests[first : first + _LISTS])
        if packets:
            self._listener.packets(packets)
