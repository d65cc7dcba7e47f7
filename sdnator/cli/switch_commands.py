"""`sdnator tables` and `sdnator counters`: entries and counters of a running switch, over P4Runtime.

Reading needs no arbitration: its controller stays primary.
"""

import json
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sdnator.cli.plain_table import plain_table
from sdnator.cli.switch_place import DeviceId, Insecure, SwitchAddress, SwitchArgument, place_of
from sdnator.errors import BadInput, PipelineError

if TYPE_CHECKING:
    from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo

_SECONDS = 10.0
_ENTRY = ("packets", "bytes", "entry", "action")

Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]


def tables(
    switch: SwitchArgument = "",
    *,
    table: Annotated[str, typer.Option(help="Show only this table.", metavar="NAME")] = "",
    device_id: DeviceId = 1,
    insecure: Insecure = False,
    as_json: Json = False,
) -> None:
    """Show tables of a switch: size, entries, default actions; with --table every entry.

    Example: sdnator tables s1 --table block_mac
    """
    place = place_of(switch, device_id, insecure=insecure)
    program, rows = read_tables(place, table)
    if as_json:
        print(json.dumps({"switch": place.name, "address": place.address, "entries": rows}))
    elif table:
        print(plain_table(_ENTRY, map(_entry_cells, rows)))
    else:
        print(
            plain_table(("table", "entries", "size", "default action", "keys"), _table_cells(program, rows))
        )


def counters(
    switch: SwitchArgument = "", *, device_id: DeviceId = 1, insecure: Insecure = False, as_json: Json = False
) -> None:
    """Show the counters of a switch's entries, such as the drops of each block.

    Example: sdnator counters s1
    """
    place = place_of(switch, device_id, insecure=insecure)
    counted = [row for row in read_tables(place, "")[1] if "packets" in row]
    if as_json:
        print(json.dumps({"switch": place.name, "address": place.address, "counters": counted}))
    else:
        print(plain_table(_ENTRY, map(_entry_cells, counted)))


def read_tables(place: SwitchAddress, table: str) -> "tuple[ProgramInfo, list[dict[str, Any]]]":
    """The program that runs there and its entries; raises PipelineError, BadInput for a table it lacks."""
    import grpc

    from apps.p4runtime_ctrl.errors import ControllerError
    from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
    from p4rt import P4RuntimeStub, open_channel, p4runtime

    request = p4runtime.GetForwardingPipelineConfigRequest(
        device_id=place.device_id,
        response_type=p4runtime.GetForwardingPipelineConfigRequest.P4INFO_AND_COOKIE,
    )
    options = [("grpc.max_receive_message_length", -1)]
    with open_channel(place.address, place.security, options) as channel:
        stub = P4RuntimeStub(channel)
        try:
            reply = stub.GetForwardingPipelineConfig(request, timeout=_SECONDS)
            program = ProgramInfo(reply.config.p4info)
            chosen = [program.table(table)] if table else list(program.tables.values())
            rows = [
                _row(program, entry)
                for one in chosen
                for entry in _entries(stub, place.device_id, one.id, counted=one.counted)
            ]
        except ControllerError as error:
            raise BadInput(str(error)) from None
        except grpc.RpcError as error:
            raise PipelineError(
                f"switch at {place.address}: {error.code().name}: {error.details()}; see `sdnator status`"
            ) from None
    return program, rows


def _entries(stub: Any, device_id: int, table_id: int, *, counted: bool) -> Iterator[Any]:
    """Entries and the default action of a table."""
    from p4rt import p4runtime

    for default in (False, True):
        request = p4runtime.ReadRequest(device_id=device_id)
        entry = request.entities.add().table_entry
        entry.table_id, entry.is_default_action = table_id, default
        if counted and not default:
            entry.counter_data.SetInParent()
        for reply in stub.Read(request, timeout=_SECONDS):
            for entity in reply.entities:
                yield entity.table_entry


def _row(program: "ProgramInfo", entry: Any) -> dict[str, Any]:
    table = program.tables[entry.table_id]
    action = entry.action.action
    row: dict[str, Any] = {
        "table": table.name,
        "entry": program.describe(entry),
        "default": entry.is_default_action,
        "action": _action_text(program, action) if entry.action.HasField("action") else "",
    }
    if entry.HasField("counter_data") and not entry.is_default_action:
        row |= {"packets": entry.counter_data.packet_count, "bytes": entry.counter_data.byte_count}
    return row


def _action_text(program: "ProgramInfo", action: Any) -> str:
    from apps.p4runtime_ctrl.southbound import values

    known = program.actions.get(action.action_id)
    if known is None:
        return f"action {action.action_id:#x}"
    if "secret" in known.name:
        return f"{known.name}(hidden)"  # the secrets of SYN cookies must not be shown
    fields = {field.id: field for field in known.params}
    given = (
        f"{fields[param.param_id].name}={values.shown(values.number(param.value), fields[param.param_id].width)}"
        for param in action.params
    )
    return f"{known.name}({', '.join(given)})"


def _table_cells(program: "ProgramInfo", rows: Sequence[dict[str, Any]]) -> Iterator[tuple[str, ...]]:
    for table in sorted(program.tables.values(), key=lambda one: one.name):
        mine = [row for row in rows if row["table"] == table.name]
        default = next((row["action"] for row in mine if row["default"]), "")
        entries = sum(not row["default"] for row in mine)
        keys = ", ".join(field.name for field in table.fields)
        yield table.name, f"{entries:,}", f"{table.size:,}", default or "-", keys or "-"


def _entry_cells(row: dict[str, Any]) -> tuple[str, ...]:
    counts = (f"{row[name]:,}" if name in row else "-" for name in ("packets", "bytes"))
    return (*counts, row["entry"], row["action"])  # the long column comes last: it is not padded
