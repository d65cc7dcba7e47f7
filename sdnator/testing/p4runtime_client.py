"""A P4Runtime client for tests and benchmarks: one stream, requests that block, and entries built by name."""

import queue
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Self

import grpc
from google.protobuf import text_format

from p4rt import INSECURE, P4RuntimeStub, open_channel, p4info, p4runtime, status

_OPTIONS = (
    ("grpc.max_receive_message_length", -1),
    ("grpc.max_send_message_length", -1),
    ("grpc.max_metadata_size", 16 << 20),
    ("grpc.absolute_max_metadata_size", 16 << 20),
)
TIMEOUT_S = 60.0
"""Of every request, and of every answer waited for."""


def program_config(program: Path) -> Any:
    """A ForwardingPipelineConfig from what p4c wrote.

    Args:
        program: path without an ending; PROGRAM.json and PROGRAM.p4info.txtpb are read.
    """
    config = p4runtime.ForwardingPipelineConfig()
    text_format.Parse(program.with_suffix(".p4info.txtpb").read_text(encoding="utf-8"), config.p4info)
    config.p4_device_config = program.with_suffix(".json").read_bytes()
    return config


class P4RuntimeClient:
    """A client of one switch, whose stream is open from the start; a context manager that closes it.

    Args:
        address: HOST:PORT of the switch.
        device_id: P4Runtime device id.
        election_id: 128-bit number, the highest is primary; None: only a backup that reads.
        role: that it claims; empty: the default role.

    What the switch sends is in the queues `packets`, `digests` and `arbitrations`, all else in `others`.  Requests
    raise `grpc.RpcError`; `update_errors` reads what it says of each update.
    """

    def __init__(
        self, address: str, *, device_id: int = 1, election_id: int | None = 1, role: str = ""
    ) -> None:
        self.device_id, self.election_id, self.role = device_id, election_id, role
        self.channel = open_channel(address, INSECURE, _OPTIONS)
        self.stub = P4RuntimeStub(self.channel)
        self.error: grpc.RpcError | None = None
        """What ended the stream, if something did."""
        self.packets: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.digests: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.others: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.arbitrations: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.sinks: dict[str, Any] = {
            "packet": self.packets,
            "digest": self.digests,
            "arbitration": self.arbitrations,
        }
        """Kind of message to what takes it with `put`: a test may give another one."""
        self._requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._call = self.stub.StreamChannel(iter(self._requests.get, None))
        self.ended = threading.Event()
        """Set when the stream has ended."""
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()

    def _receive(self) -> None:
        try:
            for response in self._call:
                kind = response.WhichOneof("update")
                self.sinks.get(kind, self.others).put(getattr(response, kind))
        except grpc.RpcError as error:
            self.error = error
        self.ended.set()

    # -- stream ---------------------------------------------------------------------------------------

    def send(self, request: Any) -> None:
        """Put a message on the stream.

        Args:
            request: a StreamMessageRequest.
        """
        self._requests.put(request)

    def arbitrate(self, election_id: int | None = None) -> Any:
        """Ask to be primary, and wait for the switch's answer.

        Args:
            election_id: from now on; None: as before.

        Returns:
            The first answer, a MasterArbitrationUpdate.

        Raises:
            queue.Empty: no answer came within TIMEOUT_S.
        """
        if election_id is not None:
            self.election_id = election_id
        self.ask_for_arbitration()
        return self.arbitrations.get(timeout=TIMEOUT_S)

    def ask_for_arbitration(self) -> None:
        """Ask to be primary without waiting for the answer."""
        request = p4runtime.StreamMessageRequest()
        request.arbitration.device_id = self.device_id
        if self.role:
            request.arbitration.role.name = self.role
        if self.election_id is not None:
            request.arbitration.election_id.SetInParent()
            self._number(request.arbitration.election_id)
        self.send(request)

    def packet_out(self, payload: bytes, metadata: dict[int, bytes]) -> None:
        """Send a packet-out.

        Args:
            payload: the frame.
            metadata: values by the ids of the p4info's packet_out header.
        """
        request = p4runtime.StreamMessageRequest()
        request.packet.payload = payload
        for number, value in metadata.items():
            request.packet.metadata.add(metadata_id=number, value=value)
        self.send(request)

    # -- requests -------------------------------------------------------------------------------------

    def _number(self, message: Any) -> None:
        number = self.election_id or 0
        message.high, message.low = number >> 64, number & (1 << 64) - 1

    def set_pipeline(self, config: Any | None, action: str = "VERIFY_AND_COMMIT") -> Any:
        """Load a program.

        Args:
            config: a ForwardingPipelineConfig; None with an action that takes none.
            action: name of an Action of SetForwardingPipelineConfigRequest.

        Returns:
            The SetForwardingPipelineConfigResponse.
        """
        request = p4runtime.SetForwardingPipelineConfigRequest(device_id=self.device_id, role=self.role)
        self._number(request.election_id)
        request.action = getattr(p4runtime.SetForwardingPipelineConfigRequest, action)
        if config is not None:
            request.config.CopyFrom(config)
        return self.stub.SetForwardingPipelineConfig(request, timeout=TIMEOUT_S)

    def get_pipeline(self, kind: str = "ALL") -> Any:
        """Read which program is loaded.

        Args:
            kind: which parts: name of a ResponseType of GetForwardingPipelineConfigRequest.

        Returns:
            The ForwardingPipelineConfig.
        """
        kind_number = getattr(p4runtime.GetForwardingPipelineConfigRequest, kind)
        request = p4runtime.GetForwardingPipelineConfigRequest(
            device_id=self.device_id, response_type=kind_number
        )
        return self.stub.GetForwardingPipelineConfig(request, timeout=TIMEOUT_S).config

    def write_request(self, *updates: Any, atomicity: str = "CONTINUE_ON_ERROR") -> Any:
        """Make the request that `write` sends.

        Args:
            updates: as `insert`, `modify` and `delete` make them.
            atomicity: name of an Atomicity of WriteRequest.

        Returns:
            The WriteRequest.
        """
        request = p4runtime.WriteRequest(device_id=self.device_id, role=self.role, updates=updates)
        self._number(request.election_id)
        request.atomicity = getattr(p4runtime.WriteRequest, atomicity)
        return request

    def write(self, *updates: Any, atomicity: str = "CONTINUE_ON_ERROR") -> Any:
        """Write updates in one request.

        Args:
            updates: as `insert`, `modify` and `delete` make them.
            atomicity: name of an Atomicity of WriteRequest.

        Returns:
            The WriteResponse.
        """
        return self.stub.Write(self.write_request(*updates, atomicity=atomicity), timeout=TIMEOUT_S)

    def read(self, *entities: Any) -> list[Any]:
        """Read entities.

        Args:
            entities: filters: Entities in which what is left out matches everything.

        Returns:
            Entities that match any of the filters, in the order in which the switch sends them.
        """
        request = p4runtime.ReadRequest(device_id=self.device_id, entities=entities)
        return [
            entity for response in self.stub.Read(request, timeout=TIMEOUT_S) for entity in response.entities
        ]

    def close(self) -> None:
        """End the stream and the connection."""
        self._requests.put(None)
        self._call.cancel()
        self.ended.wait(TIMEOUT_S)
        self._thread.join(TIMEOUT_S)
        self.channel.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def update_errors(error: grpc.RpcError) -> list[Any]:
    """The p4.v1.Error messages of a failed Write or Read."""
    metadata: Any = error.trailing_metadata()
    for key, value in metadata or ():
        if key == "grpc-status-details-bin":
            packed = status.Status.FromString(value)
            errors = []
            for detail in packed.details:
                one = p4runtime.Error()
                detail.Unpack(one)
                errors.append(one)
            return errors
    return []


class EntryBuilder:
    """Builds entities by the names of a p4info.

    Args:
        info: the p4info message of the program.
    """

    def __init__(self, info: Any) -> None:
        self.info = info
        self.tables = {table.preamble.name: table for table in info.tables}
        self.actions = {action.preamble.name: action for action in info.actions}

    def entry(
        self,
        table: str,
        match: dict[str, Any],
        action: str | None = None,
        params: Iterable[int] = (),
        **fields: Any,
    ) -> Any:
        """Make an Entity with a TableEntry.

        Args:
            table: full name, such as `ingress.block_src`.
            match: field name to value: an int, or (value, mask), (value, prefix length), (low, high).
            action: full name; None: no action, as in a deletion.
            params: of the action, in the order of the p4info.
            fields: of the TableEntry, such as `priority`.

        Returns:
            The Entity.
        """
        known = self.tables[table]
        entity = p4runtime.Entity()
        entry = entity.table_entry
        entry.table_id = known.preamble.id
        by_name = {field.name: field for field in known.match_fields}
        for name, value in match.items():
            field = by_name[name]
            _MATCHES[field.match_type](entry.match.add(field_id=field.id), value)
        if action is not None:
            self.set_action(entry, action, params)
        for name, value in fields.items():
            setattr(entry, name, value)
        return entity

    def set_action(self, entry: Any, action: str, params: Iterable[int]) -> None:
        """Put an action into a TableEntry.

        Args:
            entry: the TableEntry.
            action: full name, such as `ingress.drop_src`.
            params: of the action, in the order of the p4info.
        """
        known = self.actions[action]
        entry.action.action.action_id = known.preamble.id
        for param, value in zip(known.params, params, strict=True):
            entry.action.action.params.add(param_id=param.id, value=text(value))

    def default(self, table: str, action: str | None, params: Iterable[int] = ()) -> Any:
        """Make the default entry of a table.

        Args:
            table: full name.
            action: full name; None: the one that the program defines.
            params: of the action, in the order of the p4info.

        Returns:
            The Entity.
        """
        entity = self.entry(table, {}, action, params)
        entity.table_entry.is_default_action = True
        return entity


def text(value: int) -> bytes:
    """A canonical byte string: big-endian, as short as it goes, at least one byte."""
    return value.to_bytes(max(1, (value.bit_length() + 7) // 8), "big")


def _exact(field: Any, value: int) -> None:
    field.exact.value = text(value)


def _optional(field: Any, value: int) -> None:
    field.optional.value = text(value)


def _ternary(field: Any, value: tuple[int, int]) -> None:
    field.ternary.value, field.ternary.mask = text(value[0]), text(value[1])


def _lpm(field: Any, value: tuple[int, int]) -> None:
    field.lpm.value, field.lpm.prefix_len = text(value[0]), value[1]


def _range(field: Any, value: tuple[int, int]) -> None:
    field.range.low, field.range.high = text(value[0]), text(value[1])


_MATCHES: dict[int, Callable[[Any, Any], None]] = {
    p4info.MatchField.EXACT: _exact,
    p4info.MatchField.OPTIONAL: _optional,
    p4info.MatchField.TERNARY: _ternary,
    p4info.MatchField.LPM: _lpm,
    p4info.MatchField.RANGE: _range,
}


def insert(entity: Any) -> Any:
    """The Update that inserts an entity."""
    return p4runtime.Update(type=p4runtime.Update.INSERT, entity=entity)


def modify(entity: Any) -> Any:
    """The Update that modifies an entity."""
    return p4runtime.Update(type=p4runtime.Update.MODIFY, entity=entity)


def delete(entity: Any) -> Any:
    """The Update that deletes an entity."""
    return p4runtime.Update(type=p4runtime.Update.DELETE, entity=entity)


def clone_session(number: int, *ports: int) -> Any:
    """An Entity with a clone session that copies to these ports."""
    entity = p4runtime.Entity()
    session = entity.packet_replication_engine_entry.clone_session_entry
    session.session_id = number
    for port in ports:
        session.replicas.add(egress_port=port, instance=1)
    return entity
