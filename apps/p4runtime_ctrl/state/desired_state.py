"""The desired state of a switch, and the changes that lead from the present state to it.

Entries are compared by their canonical bytes: the *key* (table, match, priority, or 'default') says
which entry, the *body* (action, idle time-out, meter) what it does.  Cells of indirect meters stand
beside table entries; like default actions they are always there and only ever modified.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Final

from apps.p4runtime_ctrl.errors import Malformed
from apps.p4runtime_ctrl.southbound import values
from p4rt import p4runtime

INSERT: Final = p4runtime.Update.INSERT
MODIFY: Final = p4runtime.Update.MODIFY
DELETE: Final = p4runtime.Update.DELETE


def entry_key(entry: Any) -> bytes:
    """Which entry of which table; equal for entries that P4Runtime regards as the same."""
    if isinstance(entry, p4runtime.MeterEntry):
        return b"meter %d %d" % (entry.meter_id, entry.index.index)
    key = p4runtime.TableEntry(
        table_id=entry.table_id, priority=entry.priority, is_default_action=entry.is_default_action
    )
    for match in sorted(entry.match, key=lambda match: match.field_id):
        added = key.match.add()
        added.CopyFrom(match)
        _canonicalise(added)
    return bytes(key.SerializeToString(deterministic=True))


def check_entry(entry: Any) -> Any:
    """The entry as a switch sent it; raises `Malformed` for a match without a condition."""
    if isinstance(entry, p4runtime.TableEntry) and any(
        match.WhichOneof("field_match_type") is None for match in entry.match
    ):
        raise Malformed(f"an entry of table {entry.table_id:#x} has a match without a condition")
    return entry


def entry_body(entry: Any) -> bytes:
    """What the entry does: action, parameters, idle time-out and meter."""
    if isinstance(entry, p4runtime.MeterEntry):
        return bytes(entry.config.SerializeToString(deterministic=True))
    body = p4runtime.TableEntry(idle_timeout_ns=entry.idle_timeout_ns)
    action = entry.action.action
    body.action.action.action_id = action.action_id
    for param in sorted(action.params, key=lambda param: param.param_id):
        value = values.canonical(values.number(param.value))
        body.action.action.params.add(param_id=param.param_id, value=value)
    if entry.HasField("meter_config"):
        body.meter_config.CopyFrom(entry.meter_config)
    return bytes(body.SerializeToString(deterministic=True))


def is_standing(entry: Any) -> bool:
    """Whether the entry is always there: a default action or the cell of a meter."""
    return isinstance(entry, p4runtime.MeterEntry) or bool(entry.is_default_action)


def table_id(entry: Any) -> int:
    """The table of an entry; 0 for a meter's cell."""
    return 0 if isinstance(entry, p4runtime.MeterEntry) else int(entry.table_id)


def _canonicalise(match: Any) -> None:
    condition = getattr(match, match.WhichOneof("field_match_type"))
    for name in ("value", "mask", "low", "high"):
        data = getattr(condition, name, None)
        if data and not data[0] and len(data) > 1:
            setattr(condition, name, values.canonical(values.number(data)))


@dataclass(frozen=True)
class Change:
    """One step: insert, modify or delete of one table entry, or modify of a meter's cell."""

    kind: int
    entry: Any

    @property
    def update(self) -> Any:
        """The P4Runtime `Update` of this step."""
        if isinstance(self.entry, p4runtime.MeterEntry):
            entity = p4runtime.Entity(meter_entry=self.entry)
        else:
            entity = p4runtime.Entity(table_entry=self.entry)
        return p4runtime.Update(type=self.kind, entity=entity)


class EntrySet:
    """Table entries by key: what is desired of a switch, or what was read from it."""

    def __init__(self, entries: Iterable[Any] = ()) -> None:
        self._entries = {entry_key(entry): entry for entry in entries}

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self) -> Any:
        return iter(self._entries.values())

    def __contains__(self, entry: Any) -> bool:
        return entry_key(entry) in self._entries

    def get(self, entry: Any) -> Any | None:
        """The entry with the same key, if there is one."""
        return self._entries.get(entry_key(entry))

    def put(self, entry: Any) -> None:
        """Add the entry, in place of one with the same key."""
        self._entries[entry_key(entry)] = entry

    def discard(self, entry: Any) -> bool:
        """Remove the entry with this key; False if there was none."""
        return self._entries.pop(entry_key(entry), None) is not None

    def keys(self) -> set[bytes]:
        return set(self._entries)

    def items(self) -> Iterable[tuple[bytes, Any]]:
        return self._entries.items()


def difference(
    desired: EntrySet, present: EntrySet, *, rank: Callable[[Change], Any] | None = None
) -> list[Change]:
    """The changes that make `present` equal to `desired`: none if they are equal.

    Deletions come first (a full table must have room for what follows), then modifications, then
    insertions; `rank` sorts otherwise.  What is always there is only ever modified, and left alone
    where nothing is desired of it.
    """
    have = dict(present.items())
    want = dict(desired.items())
    changes = [deletion(entry) for key, entry in have.items() if key not in want and not is_standing(entry)]
    for key, entry in want.items():
        held = have.get(key)
        if held is None and not is_standing(entry):
            changes.append(Change(INSERT, entry))
        elif held is None or entry_body(held) != entry_body(entry):
            changes.append(Change(MODIFY, entry))
    return sorted(changes, key=rank or _deletions_first)


def _deletions_first(change: Change) -> int:
    return (DELETE, MODIFY, INSERT).index(change.kind)


def deletion(entry: Any) -> Change:
    """The step that removes an entry, named by its key only."""
    bare = p4runtime.TableEntry()
    bare.CopyFrom(entry)
    for name in ("action", "counter_data", "time_since_last_hit", "meter_config", "meter_counter_data"):
        bare.ClearField(name)
    bare.idle_timeout_ns = 0
    return Change(DELETE, bare)
