"""Calls to one switch over gRPC: program, writes and reads.  I/O.

The calls have their own channel, so that a blocked stream never delays a write.
"""

import hashlib
import queue
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import grpc
from google.protobuf.message import DecodeError

from apps.p4runtime_ctrl.errors import Malformed, NotPrimary, P4InfoError, SwitchError, Unreachable
from apps.p4runtime_ctrl.settings import Settings, SwitchSettings
from apps.p4runtime_ctrl.southbound.digest_in import FRAME_DIGEST
from apps.p4runtime_ctrl.state.desired_state import Change, check_entry
from apps.p4runtime_ctrl.state.desired_switch import UpdateOutcome
from p4rt import ChannelSecurity, InsecureChannel, P4RuntimeStub, open_channel, p4runtime, status

_METADATA_BYTES: Final = 16 << 20  # a failed batch explains each of its updates in trailing metadata
_RECEIVED_BYTES: Final = 256 << 20
"""Most bytes of one message: a switch may send all entries of its tables at once."""
_BATCH: Final = 5_000
_AHEAD: Final = 1_000
"""Packet-outs that may wait for the switch."""
_DIGEST_WAITS_NS: Final = 2_000_000
_DIGEST_LIST: Final = 2048
_DIGEST_ACK_NS: Final = 1_000_000_000
_CHANNEL_OPTIONS: Final = (
    ("grpc.max_receive_message_length", _RECEIVED_BYTES),
    ("grpc.max_send_message_length", -1),
    ("grpc.max_metadata_size", _METADATA_BYTES),
    ("grpc.absolute_max_metadata_size", _METADATA_BYTES),
    # share no connection, and no backoff state, with another channel
    ("grpc.use_local_subchannel_pool", 1),
    # a connection attempt without an answer is abandoned and repeated after this time
    ("grpc.min_reconnect_backoff_ms", 1000),
    # a channel stays while its switch is away: after a refused connection it tries again as often as we do
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 200),
)


@dataclass(frozen=True)
class CompiledProgram:
    """A compiled program: BMv2 JSON and p4info."""

    config: bytes
    p4info: Any

    @property
    def cookie(self) -> int:
        """Identifies the program: 63 bits of the hash of both parts."""
        data = self.config + self.p4info.SerializeToString(deterministic=True)
        return int.from_bytes(hashlib.sha256(data).digest()[:8], "big") >> 1

    @cached_property
    def digests_of_frames(self) -> frozenset[int]:
        """Ids of the digests that are numbered."""
        return frozenset(
            each.preamble.id for each in self.p4info.digests if each.preamble.name == FRAME_DIGEST
        )


@dataclass(frozen=True)
class Address:
    """Address of a switch, with the controller's rank.

    `rank` is the high half of the election id: the controller of the highest rank is primary.  The
    low half is the time a stream was opened, so that a new stream wins over a dead one of the same
    rank that the switch still holds open.
    """

    target: str
    device_id: int
    rank: int
    copies_session: int = 1
    cpu_port: int = 510
    timeout_s: float = 5.0
    security: ChannelSecurity | None = None
    remembers: bool = True
    """It is to remember digests of frames until they are acknowledged, though no two of these are equal: all numbered."""

    def channel(self) -> grpc.Channel:
        """A channel of its own.  Raises P4InfoError where the settings do not say how it is secured."""
        try:
            return open_channel(self.target, self.security, _CHANNEL_OPTIONS)
        except InsecureChannel as error:
            raise P4InfoError(str(error)) from None


def security_of(settings: Settings, mine: SwitchSettings) -> ChannelSecurity:
    """How channels to a switch of the settings are secured; `insecure` of one switch wins over TLS of all."""
    if mine.insecure:
        return ChannelSecurity(insecure=True)
    return ChannelSecurity(ca=settings.tls_ca, certificate=settings.tls_certificate, key=settings.tls_key)


def address_of(settings: Settings, mine: SwitchSettings) -> Address:
    """Address of a switch of the settings, with the controller's rank.

    Raises:
        P4InfoError: the settings do not say how its channels are secured, or name files that cannot be read.
    """
    security = security_of(settings, mine)
    try:
        security.check(mine.address)
    except InsecureChannel as error:
        raise P4InfoError(str(error)) from None
    return Address(
        mine.address,
        mine.device_id,
        settings.rank,
        copies_session=settings.copy_session,
        cpu_port=settings.cpu_port,
        timeout_s=settings.timeout_s,
        security=security,
        remembers=mine.target != "embedded",
    )


class Outgoing:
    """Queue of messages to the switch on its stream: arbitration and acknowledgements at any time, packet-outs
    as fast as the switch takes them."""

    def __init__(self) -> None:
        self._waiting: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._ended = False

    def __iter__(self) -> Iterator[Any]:
        return iter(self._waiting.get, None)

    def put(self, message: Any) -> None:
        """Queue a message in any case."""
        self._waiting.put(message)

    def offer(self, message: Any) -> None:
        """Queue a message, unless too many wait because the switch does not read."""
        if self._waiting.qsize() < 2 * _AHEAD:
            self._waiting.put(message)

    def end(self) -> None:
        """The stream is over."""
        self._ended = True
        self._waiting.put(None)

    def send(self, packets: Sequence[Any], patience_s: float) -> int:
        """Queue packet-outs; waits while the switch is behind.  Returns how many were queued."""
        deadline = time.monotonic() + patience_s
        for sent, packet in enumerate(packets):
            while self._waiting.qsize() >= _AHEAD and not self._ended:
                if time.monotonic() > deadline:
                    return sent
                time.sleep(0.001)
            if self._ended:
                return sent
            self._waiting.put(p4runtime.StreamMessageRequest(packet=packet))
        return len(packets)


class P4RuntimeSession:
    """Calls to a switch while this controller is primary (a `switch.Transport`)."""

    def __init__(
        self,
        stub: P4RuntimeStub,
        address: Address,
        pipeline: CompiledProgram,
        election_id: Any,
        outgoing: Outgoing | None = None,
    ) -> None:
        self._stub = stub
        self._outgoing = outgoing or Outgoing()
        self._election_id = election_id
        self.broken = False
        """A call could not reach the switch: the stream must be opened again."""
        self.denied = False
        """The switch refused the last write: somebody else may be primary by now."""
        self._address = address
        self._pipeline = pipeline

    def ensure_program(self) -> bool:
        if self._loaded_cookie() == self._pipeline.cookie:
            return False
        # BMv2 keeps replicas of clone sessions over a new program
        self._write_copies(p4runtime.Update.DELETE)
        request = p4runtime.SetForwardingPipelineConfigRequest(
            device_id=self._address.device_id,
            election_id=self._election_id,
            action=p4runtime.SetForwardingPipelineConfigRequest.VERIFY_AND_COMMIT,
        )
        request.config.p4info.CopyFrom(self._pipeline.p4info)
        request.config.p4_device_config = self._pipeline.config
        request.config.cookie.cookie = self._pipeline.cookie
        self._call(self._stub.SetForwardingPipelineConfig, request, patience=6)
        return True

    def ensure_copies(self) -> None:
        outcome = self._write_copies(p4runtime.Update.INSERT)
        if outcome.code:  # BMv2 answers UNKNOWN or ALREADY_EXISTS if there is one
            outcome = self._write_copies(p4runtime.Update.MODIFY)
        if outcome.code:
            raise SwitchError(
                f"{self._address.target}: clone session {self._address.copies_session}"
                f" to port {self._address.cpu_port} refused: {outcome.message}"
            )

    def ensure_digests(self) -> None:
        for digest in self._pipeline.p4info.digests:
            outcome = self._write_digest(p4runtime.Update.INSERT, digest.preamble.id)
            if outcome.code:
                outcome = self._write_digest(p4runtime.Update.MODIFY, digest.preamble.id)
            if outcome.code:
                raise SwitchError(
                    f"{self._address.target}: digest {digest.preamble.name} refused: {outcome.message}"
                )

    def ensure_group(self, group: int, ports: Sequence[int]) -> None:
        outcome = self._write_group(p4runtime.Update.INSERT, group, ports)
        if outcome.code:
            outcome = self._write_group(p4runtime.Update.MODIFY, group, ports)
        if outcome.code:
            raise SwitchError(f"{self._address.target}: multicast group {group} refused: {outcome.message}")

    def write(self, changes: Sequence[Change]) -> list[UpdateOutcome]:
        updates = [change.update for change in changes]
        outcomes: list[UpdateOutcome] = []
        for start in range(0, len(updates), _BATCH):
            outcomes += self._write_updates(updates[start : start + _BATCH])
        return outcomes

    def read_entries(self) -> Iterator[Any]:
        # direct meters are returned only if they are requested
        return self._read(p4runtime.TableEntry(meter_config=p4runtime.MeterConfig()))

    def read_standing(self, entries: Iterable[Any]) -> Iterator[Any]:
        wanted = [_standing_key(entry) for entry in entries]
        return self._read(*wanted) if wanted else iter(())

    def read_counters(self, table_id: int) -> Iterator[Any]:
        return self._read(p4runtime.TableEntry(table_id=table_id, counter_data=p4runtime.CounterData()))

    def send(self, packets: Sequence[Any]) -> int:
        """Packet-outs on the stream; returns how many were sent before it ended or the switch stopped reading."""
        return self._outgoing.send(packets, self._address.timeout_s)

    def alive(self) -> str:
        """The switch's P4Runtime version; raises `Unreachable` when it does not answer."""
        reply = self._call(self._stub.Capabilities, p4runtime.CapabilitiesRequest())
        return str(reply.p4runtime_api_version)

    def _loaded_cookie(self) -> int | None:
        request = p4runtime.GetForwardingPipelineConfigRequest(
            device_id=self._address.device_id,
            response_type=p4runtime.GetForwardingPipelineConfigRequest.COOKIE_ONLY,
        )
        try:
            # the channel of the calls may not have noticed yet that the switch is back
            reply = self._invoke(self._stub.GetForwardingPipelineConfig, request, wait_for_ready=True)
        except grpc.RpcError as error:
            if error.code() in (grpc.StatusCode.FAILED_PRECONDITION, grpc.StatusCode.NOT_FOUND):
                return None
            raise self._translated(error) from error
        return int(reply.config.cookie.cookie) if reply.config.HasField("cookie") else None

    def _write_copies(self, kind: int) -> UpdateOutcome:
        update = p4runtime.Update(type=kind)
        session = update.entity.packet_replication_engine_entry.clone_session_entry
        session.session_id = self._address.copies_session
        if kind != p4runtime.Update.DELETE:
            session.replicas.add(egress_port=self._address.cpu_port, instance=1)
        return self._write_updates([update])[0]

    def _write_group(self, kind: int, group: int, ports: Sequence[int]) -> UpdateOutcome:
        update = p4runtime.Update(type=kind)
        entry = update.entity.packet_replication_engine_entry.multicast_group_entry
        entry.multicast_group_id = group
        for port in ports:
            entry.replicas.add(egress_port=port, instance=1)
        return self._write_updates([update])[0]

    def _write_digest(self, kind: int, digest_id: int) -> UpdateOutcome:
        update = p4runtime.Update(type=kind)
        update.entity.digest_entry.digest_id = digest_id
        config = update.entity.digest_entry.config
        config.max_timeout_ns = _DIGEST_WAITS_NS
        config.max_list_size = _DIGEST_LIST
        remembered = self._address.remembers or digest_id not in self._pipeline.digests_of_frames
        config.ack_timeout_ns = _DIGEST_ACK_NS if remembered else 0
        return self._write_updates([update])[0]

    def _write_updates(self, updates: list[Any]) -> list[UpdateOutcome]:
        request = p4runtime.WriteRequest(
            device_id=self._address.device_id, election_id=self._election_id, updates=updates
        )
        try:
            self._invoke(self._stub.Write, request, patience=4)
        except grpc.RpcError as error:
            return self._failures(error, updates)
        self.denied = False
        return [UpdateOutcome()] * len(updates)

    def _failures(self, error: Any, updates: list[Any]) -> list[UpdateOutcome]:
        details = _details(error)
        if len(details) == len(updates):
            return details
        if error.code() in _BROKEN or error.code() == grpc.StatusCode.PERMISSION_DENIED:
            raise self._translated(error) from error
        if len(updates) == 1:
            return [UpdateOutcome(error.code().value[0], error.details() or error.code().name)]
        # the switch did not say which failed: write again in halves; updates that succeeded now 'exist'
        half = len(updates) // 2
        again = self._write_updates(updates[:half]) + self._write_updates(updates[half:])
        return [_forgiven(update, outcome) for update, outcome in zip(updates, again, strict=True)]

    def _read(self, *entries: Any) -> Iterator[Any]:
        request = p4runtime.ReadRequest(device_id=self._address.device_id)
        for entry in entries:
            entity = request.entities.add()
            meter = isinstance(entry, p4runtime.MeterEntry)
            (entity.meter_entry if meter else entity.table_entry).CopyFrom(entry)
        try:
            for reply in self._invoke(self._stub.Read, request, patience=6):
                for entity in reply.entities:
                    kind = entity.WhichOneof("entity")
                    if kind not in ("table_entry", "meter_entry"):
                        raise Malformed(f"switch at {self._address.target}: read entries, got {kind}")
                    yield check_entry(getattr(entity, kind))
        except grpc.RpcError as error:
            raise self._translated(error) from error

    def _call(self, method: Callable[..., Any], request: Any, *, patience: int = 1) -> Any:
        try:
            return self._invoke(method, request, patience=patience)
        except grpc.RpcError as error:
            raise self._translated(error) from error

    def _translated(self, error: Any) -> SwitchError:
        found = translated(error, self._address.target)
        self.broken |= isinstance(found, Unreachable)
        self.denied |= isinstance(found, NotPrimary)
        return found

    def _invoke(
        self, method: Callable[..., Any], request: Any, *, patience: int = 1, wait_for_ready: bool = False
    ) -> Any:
        try:
            return method(request, timeout=self._address.timeout_s * patience, wait_for_ready=wait_for_ready)
        except ValueError as error:  # gRPC raises this if the channel was closed meanwhile
            raise Unreachable(f"switch at {self._address.target}: the connection was closed") from error


_BROKEN: Final = (
    grpc.StatusCode.UNAVAILABLE,
    grpc.StatusCode.DEADLINE_EXCEEDED,
    grpc.StatusCode.CANCELLED,
)


def _standing_key(entry: Any) -> Any:
    if isinstance(entry, p4runtime.MeterEntry):
        return p4runtime.MeterEntry(meter_id=entry.meter_id, index=entry.index)
    return p4runtime.TableEntry(table_id=entry.table_id, is_default_action=True)


def translated(error: Any, target: str) -> SwitchError:
    code = error.code()
    text = f"switch at {target}: {code.name}: {error.details()}"
    if code in _BROKEN:
        return Unreachable(text)
    if code == grpc.StatusCode.PERMISSION_DENIED:
        return NotPrimary(text)
    return SwitchError(text)


def _details(error: Any) -> list[UpdateOutcome]:
    """The outcomes of single updates from the trailing metadata; empty if it has none."""
    for key, value in error.trailing_metadata() or ():
        if key == "grpc-status-details-bin":
            try:
                return [_outcome(packed) for packed in status.Status.FromString(value).details]
            except DecodeError:
                return []
    return []


def _outcome(packed: Any) -> UpdateOutcome:
    detail = p4runtime.Error()
    packed.Unpack(detail)
    names = {code.value[0]: code.name for code in grpc.StatusCode}
    text = detail.message or names.get(detail.canonical_code, "")
    return UpdateOutcome(detail.canonical_code, text if detail.canonical_code else "")


def _forgiven(update: Any, outcome: UpdateOutcome) -> UpdateOutcome:
    inserted = (
        update.type == p4runtime.Update.INSERT and outcome.code == grpc.StatusCode.ALREADY_EXISTS.value[0]
    )
    deleted = update.type == p4runtime.Update.DELETE and outcome.code == grpc.StatusCode.NOT_FOUND.value[0]
    return UpdateOutcome() if inserted or deleted else outcome
