"""Multicast groups and clone sessions (PacketReplicationEngineEntry)."""

from collections.abc import Callable, Iterator
from typing import Any

from dataplane.p4runtime import bytestrings
from dataplane.p4runtime.status import (
    Exhausted,
    Exists,
    InvalidArgument,
    MissingEntity,
    OutOfRange,
    Unimplemented,
)
from dataplane.p4runtime.table_entities import DELETE, INSERT, Undo
from dataplane.v1model.switch import Replica, Switch
from p4rt import p4runtime

_PORT_BITS = 9
_INSTANCES = 1 << 16
# BMv2's ranges
MAX_REPLICAS = 1024
_MAX_GROUP = 1 << 15
_MAX_SESSION = 1 << 15


class ReplicationEntities:
    """What the packet replication engine holds; entries are read back as they were written."""

    def __init__(self, switch: Switch) -> None:
        self._switch = switch
        self._groups: dict[int, Any] = {}
        self._sessions: dict[int, Any] = {}

    def write(self, kind: int, message: Any) -> Undo:
        """Insert, modify or delete a group or session."""
        what = message.WhichOneof("type")
        if what == "multicast_group_entry":
            entry = message.multicast_group_entry
            number = entry.multicast_group_id
            _check_number(number, _MAX_GROUP, "multicast group")
            return self._write(kind, number, entry, self._groups, self._set_group)
        if what == "clone_session_entry":
            entry = message.clone_session_entry
            number = entry.session_id
            _check_number(number, _MAX_SESSION, "clone session")
            return self._write(kind, number, entry, self._sessions, self._set_session)
        raise InvalidArgument("a packet_replication_engine_entry needs a multicast group or a clone session")

    @staticmethod
    def _write(
        kind: int, number: int, entry: Any, entries: dict[int, Any], put: Callable[[int, Any | None], None]
    ) -> Undo:
        old = entries.get(number)
        name = type(entry).DESCRIPTOR.name
        if kind == INSERT and old is not None:
            raise Exists(f"{name} {number} already exists")
        if kind != INSERT and old is None:
            raise MissingEntity(f"{name} {number} does not exist")
        put(number, None if kind == DELETE else entry)
        return lambda: put(number, old)

    def _set_group(self, number: int, entry: Any | None) -> None:
        if entry is None:
            self._switch.delete_multicast_group(number)
            del self._groups[number]
            return
        self._switch.set_multicast_group(number, _replicas(entry))
        self._groups[number] = _copy(entry)

    def _set_session(self, number: int, entry: Any | None) -> None:
        if entry is None:
            self._switch.delete_clone_session(number)
            del self._sessions[number]
            return
        if entry.class_of_service:
            raise Unimplemented(f"clone session {number}: this target has one class of service, 0")
        if entry.packet_length_bytes < 0:
            raise InvalidArgument(
                f"clone session {number}: packet length {entry.packet_length_bytes} is negative"
            )
        self._switch.set_clone_session(number, _replicas(entry), packet_length=entry.packet_length_bytes)
        self._sessions[number] = _copy(entry)

    def read(self, message: Any) -> Iterator[Any]:
        """Entities for a filter; group or session 0 = all."""
        what = message.WhichOneof("type")
        if what == "multicast_group_entry":
            number, entries = message.multicast_group_entry.multicast_group_id, self._groups
        elif what == "clone_session_entry":
            number, entries = message.clone_session_entry.session_id, self._sessions
        else:
            raise InvalidArgument(
                "a packet_replication_engine_entry needs a multicast group or a clone session"
            )
        if number and number not in entries:
            raise MissingEntity(f"{what} {number} does not exist")
        for key, entry in sorted(entries.items()):
            if number in (0, key):
                entity = p4runtime.Entity()
                getattr(entity.packet_replication_engine_entry, what).CopyFrom(entry)
                yield entity


def _check_number(number: int, end: int, what: str) -> None:
    if not number:
        raise InvalidArgument(f"{what} 0 cannot be written: 0 means all in reads")
    if number >= end:
        raise OutOfRange(f"{what} {number} is not below {end}")


def _replicas(entry: Any) -> list[Replica]:
    if len(entry.replicas) > MAX_REPLICAS:
        raise Exhausted(f"{len(entry.replicas)} replicas; at most {MAX_REPLICAS} in a group or session")
    replicas = [_replica(replica) for replica in entry.replicas]
    if len(set(replicas)) != len(replicas):
        raise InvalidArgument("two replicas have the same port and instance")
    return replicas


def _replica(message: Any) -> Replica:
    kind = message.WhichOneof("port_kind")
    if kind is None:
        raise InvalidArgument("a replica needs a port")
    if message.backup_replicas:
        raise Unimplemented("backup replicas: this target does not watch ports")
    if kind == "port":
        port = bytestrings.decode(message.port, _PORT_BITS, "replica port")
    else:
        port = message.egress_port
    if port >> _PORT_BITS:
        raise InvalidArgument(f"replica port {port} does not fit into {_PORT_BITS} bits")
    if message.instance >= _INSTANCES:
        raise InvalidArgument(f"replica instance {message.instance} is not below {_INSTANCES}")
    return Replica(port, message.instance)


def _copy(message: Any) -> Any:
    copy = type(message)()
    copy.CopyFrom(message)
    return copy
