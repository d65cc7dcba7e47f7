"""What a Write may say beside an entry's key and action, and what then counts."""

import grpc
import pytest

from sdnator.testing.p4runtime_client import TIMEOUT_S, delete, insert, modify, update_errors
from tests.contract.asking import codes, entries, route
from tests.contract.differences import differs

INVALID, NOT_FOUND, ABORTED = 3, 5, 10


@pytest.mark.parametrize("make", [insert, modify, delete])
def test_is_const_is_not_for_the_controller_to_say(target, controller, names, make):
    update = make(route(names, 0x0A000000, 8, is_const=True))
    if differs(target, "is-const"):
        return
    with pytest.raises(grpc.RpcError) as caught:
        controller.write(update)
    (error,) = update_errors(caught.value)
    assert error.canonical_code == INVALID
    assert "is_const" in error.message
    assert controller.read(entries(names, "I.route")) == []


def test_an_entry_is_deleted_as_it_was_read(target, controller, names):
    """Nothing but its key counts then, whatever else was asked for."""
    controller.write(insert(route(names, 0x0A000000, 8)))
    asked = entries(names, "I.route")
    asked.table_entry.counter_data.SetInParent()
    asked.table_entry.time_since_last_hit.SetInParent()
    (entry,) = controller.read(asked)
    assert entry.table_entry.HasField("time_since_last_hit")
    if differs(target, "delete-with-age"):
        assert codes(lambda: controller.write(delete(entry))) == [INVALID]
        return
    controller.write(delete(entry))
    assert controller.read(asked) == []


def test_a_default_action_keeps_its_metadata_until_it_is_reset(target, controller, names):
    asked = names.default("I.route", None)
    (original,) = controller.read(asked)
    marked = names.default("I.route", "I.counted", [3])
    marked.table_entry.controller_metadata, marked.table_entry.metadata = 9, b"why"
    controller.write(modify(marked))
    assert controller.read(asked) == [marked]
    if not differs(target, "atomicity"):
        updates = [modify(asked), delete(route(names, 0x0A000000, 8))]
        got = codes(lambda: controller.write(*updates, atomicity="ROLLBACK_ON_ERROR"))
        assert got == [ABORTED, NOT_FOUND]
        assert controller.read(asked) == [marked]
    controller.write(modify(asked))
    assert controller.read(asked) == [original]


def test_an_atomicity_that_nobody_has_heard_of_is_refused(target, controller, names):
    request = controller.write_request(insert(route(names, 0x0A000000, 8)))
    request.atomicity = 7
    with pytest.raises(grpc.RpcError) as caught:
        controller.stub.Write(request, timeout=TIMEOUT_S)
    if differs(target, "atomicity"):
        assert caught.value.code() == grpc.StatusCode.UNIMPLEMENTED
    else:
        assert caught.value.code() == grpc.StatusCode.INVALID_ARGUMENT
        assert "atomicity 7" in caught.value.details()
    assert controller.read(entries(names, "I.route")) == []
