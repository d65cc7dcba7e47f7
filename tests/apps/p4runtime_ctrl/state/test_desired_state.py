"""The difference between two states leads from one to the other, and is empty where they are equal."""

from hypothesis import given
from hypothesis import strategies as st

from apps.messages import TableUpdate
from apps.p4runtime_ctrl.state.desired_state import DELETE, INSERT, MODIFY, EntrySet, difference, entry_body
from sdnator.testing.product_program import program


def wire(ingress, egress):
    return program().entry(
        TableUpdate(
            kind="insert",
            table="forward_port",
            match={"ingress_port": ingress},
            action="to_port",
            params={"port": egress},
        )
    )


def active(bits):
    return program().entry(
        TableUpdate(
            kind="modify",
            table="telemetry_active",
            action="set_active",
            params={"active": bits, "copies": bits, "digests": 0},
        )
    )


def applied(present, changes):
    """A naive switch: refuses what a real one would refuse."""
    after = EntrySet(present)
    for change in changes:
        if change.kind == INSERT:
            assert change.entry not in after
            after.put(change.entry)
        elif change.kind == MODIFY:
            assert change.entry.is_default_action or change.entry in after
            after.put(change.entry)
        else:
            assert not change.entry.HasField("action")
            assert after.discard(change.entry)
    return after


def bodies(entries):
    return {key: entry_body(entry) for key, entry in entries.items()}


wires = st.dictionaries(st.integers(1, 6), st.integers(1, 3))


@given(wires, wires)
def test_the_difference_leads_from_present_to_desired(desired, present):
    want = EntrySet(wire(*ports) for ports in desired.items())
    have = EntrySet(wire(*ports) for ports in present.items())
    changes = difference(want, have)
    assert bodies(applied(have, changes)) == bodies(want)
    assert difference(want, want) == []
    kinds = [change.kind for change in changes]
    assert kinds == sorted(kinds, key=(DELETE, MODIFY, INSERT).index)


def test_values_that_are_not_canonical_are_the_same():
    padded = wire(1, 2)
    padded.match[0].exact.value = b"\x00\x01"
    padded.action.action.params[0].value = b"\x00\x02"
    assert difference(EntrySet([wire(1, 2)]), EntrySet([padded])) == []


def test_default_actions_are_modified_only_and_left_alone_where_nothing_is_desired():
    assert difference(EntrySet(), EntrySet([active(3)])) == []
    assert [change.kind for change in difference(EntrySet([active(1)]), EntrySet([active(3)]))] == [MODIFY]
    assert [change.kind for change in difference(EntrySet([active(1)]), EntrySet())] == [MODIFY]
