"""SetForwardingPipelineConfig and its answer: which pipeline is saved, which is in force.

VERIFY                 nothing changes
VERIFY_AND_SAVE        a second pipeline is made; reads and writes go there, packets do not yet
COMMIT                 the saved pipeline comes into force with what was written to it
VERIFY_AND_COMMIT      a new, empty pipeline comes into force
RECONCILE_AND_COMMIT   a new pipeline with all entities of the old one, or nothing at all
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from dataplane.errors import DataplaneError
from dataplane.p4runtime.pipeline import ForwardingPipeline, verify
from dataplane.p4runtime.reads import Reader
from dataplane.p4runtime.status import InvalidArgument, MissingEntity
from dataplane.p4runtime.writes import Writer
from p4rt import p4runtime

_Set = p4runtime.SetForwardingPipelineConfigRequest
_Get = p4runtime.GetForwardingPipelineConfigRequest
Make = Callable[[Any], ForwardingPipeline]
"""Makes a pipeline of a ForwardingPipelineConfig."""


@dataclass(frozen=True, slots=True)
class PipelineChange:
    """What is to be after the request."""

    active: ForwardingPipeline | None
    saved: ForwardingPipeline | None


def plan(
    request: Any, active: ForwardingPipeline | None, saved: ForwardingPipeline | None, make: Make
) -> PipelineChange:
    """Carry out a request as far as making pipelines goes; the caller puts the plan into force.

    Raises InvalidArgument, Missing.
    """
    action = request.action
    if action == _Set.COMMIT:
        if request.HasField("config"):
            raise InvalidArgument("COMMIT takes no configuration: it commits the saved one")
        if saved is None:
            raise MissingEntity("no configuration is saved: send VERIFY_AND_SAVE first")
        return PipelineChange(saved, None)
    if not request.HasField("config"):
        raise InvalidArgument("the request has no configuration")
    if action == _Set.VERIFY:
        verify(request.config)
        return PipelineChange(active, saved)
    if action == _Set.VERIFY_AND_SAVE:
        made = make(request.config)
        _close(saved)
        return PipelineChange(active, made)
    if action == _Set.VERIFY_AND_COMMIT:
        made = make(request.config)
        _close(saved)
        return PipelineChange(made, None)
    if action == _Set.RECONCILE_AND_COMMIT:
        made = make(request.config)
        _carry_over(active, made)
        _close(saved)
        return PipelineChange(made, None)
    raise InvalidArgument(f"action {action} is none of VERIFY … RECONCILE_AND_COMMIT")


def _close(pipeline: ForwardingPipeline | None) -> None:
    if pipeline is not None:
        pipeline.close()


def _carry_over(old: ForwardingPipeline | None, new: ForwardingPipeline) -> None:
    """All that was written to `old`, into `new`.  Raises InvalidArgument where it does not fit."""
    if old is None:
        return
    with old.switch.lock:
        updates = [_update(entity, new) for entity in _state(old)]
        registers = {name: array.written() for name, array in old.switch.registers.items()}
    results = Writer(new).apply(
        [update for update in updates if update is not None], p4runtime.WriteRequest.ROLLBACK_ON_ERROR
    )
    causes = [
        str(error)
        for error in results
        if error is not None and not str(error).startswith(("undone", "not tried"))
    ]
    causes += _carry_registers(registers, new)
    if causes:
        new.close()
        raise InvalidArgument(f"the forwarding state cannot be kept: {causes[0]}")


def _carry_registers(written: Mapping[str, list[tuple[int, int]]], new: ForwardingPipeline) -> list[str]:
    """What does not fit; read by array, since a program may have millions of cells."""
    causes = []
    for name, cells in written.items():
        array = new.switch.registers.get(name)
        if array is None:
            causes += [f"there is no register {name}"] if cells else []
            continue
        try:
            for index, value in cells:
                array.write(index, value)
        except DataplaneError as error:
            causes.append(str(error))
    return causes


def _state(old: ForwardingPipeline) -> list[Any]:
    entity = p4runtime.Entity
    entries, defaults = entity(), entity()
    entries.table_entry.counter_data.SetInParent()
    entries.table_entry.meter_config.SetInParent()
    defaults.table_entry.is_default_action = True
    groups, sessions = entity(), entity()
    groups.packet_replication_engine_entry.multicast_group_entry.SetInParent()
    sessions.packet_replication_engine_entry.clone_session_entry.SetInParent()
    filters = [entries, defaults, groups, sessions]
    for name in ("counter_entry", "meter_entry", "digest_entry"):
        one = entity()
        getattr(one, name).SetInParent()
        filters.append(one)
    responses, _ = Reader(old).read(filters)
    return [found for response in responses for found in response.entities]


def _update(found: Any, new: ForwardingPipeline) -> Any | None:
    """The update that makes an entity of the old pipeline in the new one; None = it is there already."""
    kind = found.WhichOneof("entity")
    update = p4runtime.Update(type=p4runtime.Update.MODIFY)
    if kind == "table_entry":
        if found.table_entry.is_const:
            return None
        if found.table_entry.is_default_action:
            table = new.schema.tables.get(found.table_entry.table_id)
            if table is None or table.const_default:
                return None
        else:
            update.type = p4runtime.Update.INSERT
    elif kind in ("packet_replication_engine_entry", "digest_entry"):
        update.type = p4runtime.Update.INSERT
    elif not _written(found, kind):
        return None
    update.entity.CopyFrom(found)
    return update


def _written(found: Any, kind: str) -> bool:
    if kind == "meter_entry":
        return bool(found.meter_entry.HasField("config"))
    data = found.counter_entry.data
    return bool(data.packet_count or data.byte_count)


def answer(request: Any, config: Any | None) -> Any:
    """The GetForwardingPipelineConfigResponse for a configuration, or for none."""
    response = p4runtime.GetForwardingPipelineConfigResponse()
    if config is None:
        return response
    response.config.SetInParent()
    if config.HasField("cookie"):
        response.config.cookie.CopyFrom(config.cookie)
    if request.response_type in (_Get.ALL, _Get.P4INFO_AND_COOKIE):
        response.config.p4info.CopyFrom(config.p4info)
    if request.response_type in (_Get.ALL, _Get.DEVICE_CONFIG_AND_COOKIE):
        response.config.p4_device_config = config.p4_device_config
    return response
