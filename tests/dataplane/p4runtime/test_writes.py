"""What the specification says about Writes, and the contract tests do not ask of BMv2."""

from pathlib import Path

import pytest

from dataplane.p4runtime.pipeline import ForwardingPipeline, verify
from dataplane.p4runtime.reads import Reader
from dataplane.p4runtime.status import InvalidArgument
from dataplane.p4runtime.writes import Writer
from p4rt import p4runtime
from sdnator.testing.p4runtime_client import EntryBuilder, delete, insert, modify, program_config
from tests.naive.p4.python_machine import PythonMachine

CONFIG = program_config(Path(__file__).parents[1] / "programs" / "features")
NAMES = EntryBuilder(CONFIG.p4info)
VERIFIED = verify(CONFIG)
CONTINUE, ROLLBACK = p4runtime.WriteRequest.CONTINUE_ON_ERROR, p4runtime.WriteRequest.ROLLBACK_ON_ERROR
ROUTE = {"h.ip.dst": (0x0A000000, 8)}


@pytest.fixture
def pipeline():
    made = ForwardingPipeline(VERIFIED, cpu_port=510, maker=PythonMachine, clock=lambda: 0)
    yield made
    made.close()


def read(pipeline, entity):
    responses, results = Reader(pipeline).read([entity])
    assert not results
    return [found for response in responses for found in response.entities]


@pytest.mark.parametrize("make", [insert, modify, delete])
def test_is_const_is_not_for_the_controller_to_say(pipeline, make):
    entry = NAMES.entry("I.route", ROUTE, "I.drop", is_const=True)
    (error,) = Writer(pipeline).apply([make(entry)], CONTINUE)
    assert isinstance(error, InvalidArgument)
    assert "is_const" in str(error)


def test_an_entry_is_deleted_as_it_was_read(pipeline):
    """Nothing but its key counts then, whatever else was asked for."""
    assert Writer(pipeline).apply([insert(NAMES.entry("I.route", ROUTE, "I.drop"))], CONTINUE) == []
    asked = NAMES.entry("I.route", {})
    asked.table_entry.counter_data.SetInParent()
    asked.table_entry.time_since_last_hit.SetInParent()
    (entry,) = read(pipeline, asked)
    assert entry.table_entry.HasField("time_since_last_hit")
    assert Writer(pipeline).apply([delete(entry)], CONTINUE) == []
    assert read(pipeline, asked) == []


def test_a_default_action_keeps_its_metadata_until_it_is_reset(pipeline):
    asked = NAMES.default("I.route", None)
    (original,) = read(pipeline, asked)
    marked = NAMES.default("I.route", "I.counted", [3])
    marked.table_entry.controller_metadata, marked.table_entry.metadata = 9, b"why"
    assert Writer(pipeline).apply([modify(marked)], CONTINUE) == []
    assert read(pipeline, asked) == [marked]
    reset_and_fail = [modify(asked), delete(NAMES.entry("I.route", ROUTE))]
    assert len(Writer(pipeline).apply(reset_and_fail, ROLLBACK)) == 2
    assert read(pipeline, asked) == [marked]
    assert Writer(pipeline).apply([modify(asked)], CONTINUE) == []
    assert read(pipeline, asked) == [original]


def test_an_atomicity_that_nobody_has_heard_of_is_refused(pipeline):
    entry = NAMES.entry("I.route", ROUTE, "I.drop")
    with pytest.raises(InvalidArgument, match="atomicity 7"):
        Writer(pipeline).apply([insert(entry)], 7)
    assert read(pipeline, NAMES.entry("I.route", {})) == []
