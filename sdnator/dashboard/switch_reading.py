"""Tables and counters of a switch, read through P4Runtime; its controller stays in charge."""

from collections import Counter
from typing import Any

from sdnator.dashboard.settings import SwitchPlace

_SECONDS = 5.0
_ENTRIES = 500


def read_switch(place: SwitchPlace) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Tables by name, and entries with what they have counted.  Raises OSError where the switch does not answer."""
    import grpc

    from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
    from p4rt import P4RuntimeStub, p4runtime

    with grpc.insecure_channel(place.address, options=[("grpc.max_receive_message_length", -1)]) as channel:
        stub = P4RuntimeStub(channel)
        wanted = p4runtime.GetForwardingPipelineConfigRequest(device_id=place.device_id)
        wanted.response_type = p4runtime.GetForwardingPipelineConfigRequest.P4INFO_AND_COOKIE
        try:
            program = ProgramInfo(stub.GetForwardingPipelineConfig(wanted, timeout=_SECONDS).config.p4info)
            entries = _entries(stub, place.device_id, program)
        except grpc.RpcError as error:
            raise OSError(
                f"switch {place.name} at {place.address} does not answer: {error.code().name}"
            ) from None
    return _tables(program, entries), _rows(program, entries)


def _entries(stub: Any, device_id: int, program: Any) -> list[Any]:
    from p4rt import p4runtime

    request = p4runtime.ReadRequest(device_id=device_id)
    for table in program.tables.values():
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
