"""Tables and counters of a switch, read through P4Runtime; its controller stays in charge."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

from sdnator.dashboard.settings import SwitchPlace

_SECONDS = 5.0
_ENTRIES = 500
_FORWARDING = ("forward_port", "dmac")
_DROPPING = ("block", "block_mac", "block_src", "limit_over", "unparsed")


def read_switch(place: SwitchPlace) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Tables by name, and entries with what they have counted.  Raises OSError where the switch does not answer."""
    program, entries = _read(place, ())
    return _tables(program, entries), _rows(program, entries)


def read_traffic(place: SwitchPlace) -> dict[str, tuple[int, int, int]]:
    """By port: frames and bytes that were forwarded, and frames that were dropped, since the switch started.

    Args:
        place: the switch.

    Returns:
        Counters by `port N` (frames that came in there), `to port N` (frames of learnt addresses that went out
        there) and `any port` (drops of entries that name no port).

    Raises:
        OSError: the switch does not answer.
    """
    program, entries = _read(place, (*_FORWARDING, *_DROPPING))
    found: dict[str, tuple[int, int, int]] = {}
    for entry in entries:
        table = program.tables[entry.table_id].name.removeprefix("ingress.")
        port, packets, octets = _port_of(program, entry), entry.counter_data.packet_count, 0
        forwarded = dropped = 0
        if table in _FORWARDING:
            forwarded, octets = packets, entry.counter_data.byte_count
        else:
            dropped = packets
        before = found.get(port, (0, 0, 0))
        found[port] = before[0] + forwarded, before[1] + octets, before[2] + dropped
    return found


def _port_of(program: Any, entry: Any) -> str:
    table = program.tables[entry.table_id]
    fields = {field.id: field.name for field in table.fields}
    for match in entry.match:
        if fields.get(match.field_id) == "ingress_port":
            value = match.exact.value or match.ternary.value
            return f"port {int.from_bytes(value, 'big')}"
    if table.name.removeprefix("ingress.") == "dmac":
        for param in entry.action.action.params:
            return f"to port {int.from_bytes(param.value, 'big')}"
    return "any port"


def _read(place: SwitchPlace, tables: Sequence[str]) -> tuple[Any, list[Any]]:
    """Program and entries of these tables; none named: of all.  Raises OSError."""
    import grpc

    from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
    from p4rt import P4RuntimeStub, open_channel, p4runtime

    with open_channel(place.address, _security(place), [("grpc.max_receive_message_length", -1)]) as channel:
        stub = P4RuntimeStub(channel)
        wanted = p4runtime.GetForwardingPipelineConfigRequest(device_id=place.device_id)
        wanted.response_type = p4runtime.GetForwardingPipelineConfigRequest.P4INFO_AND_COOKIE
        try:
            program = ProgramInfo(stub.GetForwardingPipelineConfig(wanted, timeout=_SECONDS).config.p4info)
            return program, _entries(stub, place.device_id, program, tables)
        except grpc.RpcError as error:
            raise OSError(
                f"switch {place.name} at {place.address} does not answer: {error.code().name}"
            ) from None


def _security(place: SwitchPlace) -> Any:
    from p4rt import ChannelSecurity

    try:
        made = ChannelSecurity(**place.security)  # type: ignore[arg-type]  # said by `sdnator up`
        made.check(place.address)
    except (TypeError, ValueError) as error:
        raise OSError(f"switch {place.name}: {error}") from None
    return made


def _entries(stub: Any, device_id: int, program: Any, tables: Sequence[str]) -> list[Any]:
    from p4rt import p4runtime

    request = p4runtime.ReadRequest(device_id=device_id)
    for table in program.tables.values():
        if tables and table.name.removeprefix("ingress.") not in tables:
            continue
        wanted = request.entities.add().table_entry
        wanted.table_id = table.id
        if table.counted:
            wanted.counter_data.SetInParent()
    return [
        entity.table_entry
        for reply in stub.Read(request, timeout=_SECONDS)
        for entity in reply.entities
        if not entity.table_entry.is_default_action
    ]


def _tables(program: Any, entries: list[Any]) -> list[dict[str, Any]]:
    count = Counter(entry.table_id for entry in entries)
    return [
        {
            "table": table.name.removeprefix("ingress."),
            "entries": count[table.id],
            "size": table.size,
            "keys": ", ".join(field.name for field in table.fields) or "-",
        }
        for table in sorted(program.tables.values(), key=lambda one: (-count[one.id], one.name))
    ]


def _rows(program: Any, entries: list[Any]) -> list[dict[str, Any]]:
    rows = []
    for number, entry in enumerate(entries):
        if entry.HasField("counter_data"):
            action = program.actions.get(entry.action.action.action_id)
            rows.append(
                {
                    "id": number,
                    "entry": program.describe(entry),
                    "action": action.name if action is not None else "",
                    "packets": entry.counter_data.packet_count,
                    "bytes": entry.counter_data.byte_count,
                }
            )
    return sorted(rows, key=lambda row: -row["packets"])[:_ENTRIES]
