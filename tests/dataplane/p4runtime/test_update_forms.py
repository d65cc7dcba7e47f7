"""Updates that are known by their form do what they do when they are read."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataplane.p4runtime.pipeline import ForwardingPipeline, verify
from dataplane.p4runtime.reads import Reader
from dataplane.p4runtime.update_forms import UpdateForms
from dataplane.p4runtime.writes import Writer
from p4rt import p4runtime
from sdnator.testing.p4runtime_client import EntryBuilder, program_config
from tests.naive.p4.python_machine import PythonMachine

PROGRAM = Path(__file__).parents[3] / "p4" / "sdnator"
CONFIG = program_config(PROGRAM)
NAMES = EntryBuilder(CONFIG.p4info)
VERIFIED = verify(CONFIG)
KINDS = (p4runtime.Update.INSERT, p4runtime.Update.MODIFY, p4runtime.Update.DELETE)
CONTINUE, ROLLBACK = p4runtime.WriteRequest.CONTINUE_ON_ERROR, p4runtime.WriteRequest.ROLLBACK_ON_ERROR


class Unlearned(UpdateForms):
    """Reads every update."""

    def find(self, _):
        return None


def pipeline(forms):
    made = ForwardingPipeline(VERIFIED, cpu_port=510, maker=PythonMachine, clock=lambda: 0)
    made.tables._forms = forms
    return made


def set_first(value):
    def spoil(update):
        update.entity.table_entry.match[0].exact.value = value

    return spoil


def spoil_with(**fields):
    def spoil(update):
        for name, value in fields.items():
            setattr(update.entity.table_entry, name, value)

    return spoil


SPOILERS = {
    "leading zero": set_first(b"\0\1"),
    "too wide": set_first(b"\xff\xff"),
    "empty": set_first(b""),
    "one left out": lambda update: update.entity.table_entry.match.pop(),
    "another order": lambda update: update.entity.table_entry.match.reverse(),
    "no action": lambda update: update.entity.table_entry.ClearField("action"),
    "no such action": lambda update: setattr(update.entity.table_entry.action.action, "action_id", 99),
    "priority": spoil_with(priority=3),
    "metadata": spoil_with(metadata=b"m"),
    "idle time-out": spoil_with(idle_timeout_ns=5),
    "default action": spoil_with(is_default_action=True),
    "age": lambda update: setattr(update.entity.table_entry.time_since_last_hit, "elapsed_ns", 5),
    "constant": spoil_with(is_const=True),
    "counter": lambda update: setattr(update.entity.table_entry.counter_data, "packet_count", 5),
    "no kind": lambda update: setattr(update, "type", 0),
}
PLACES = st.one_of(
    st.integers(1, 4).map(
        lambda n: ("block_src", {"is_ipv4": 1, "src": 0x0A000000 + n}, "ingress.drop_src", [])
    ),
    st.integers(0, 2).map(lambda n: ("block_src", {"is_ipv4": 0, "src": n}, "ingress.drop_src", [])),
    st.integers(254, 258).map(
        lambda n: ("forward_port", {"ingress_port": n}, "ingress.to_port", [n % 2 + 1])
    ),
    st.integers(1, 3).map(lambda n: ("smac", {"vid": 1, "eth_src": n}, "ingress.ignore", [])),
)


@st.composite
def updates(draw):
    """Insertions and deletions of few keys, now and then with something wrong or special about them."""
    table, match, action, params = draw(PLACES)
    entity = NAMES.entry(f"ingress.{table}", match, action, params)
    update = p4runtime.Update(type=draw(st.sampled_from(KINDS)), entity=entity)
    if not draw(st.integers(0, 3)):
        SPOILERS[draw(st.sampled_from(sorted(SPOILERS)))](update)
    return update


def said(results):
    return [result if result is None else (type(result), str(result)) for result in results]


@pytest.fixture(scope="module")
def twins():
    """One that learns forms and one that reads; what was learnt stays from example to example."""
    both = pipeline(UpdateForms()), pipeline(Unlearned())
    yield both
    for each in both:
        each.close()


BATCHES = st.lists(
    st.tuples(st.lists(updates(), max_size=6), st.sampled_from([CONTINUE, ROLLBACK])), max_size=12
)


@settings(max_examples=60, deadline=None)
@given(BATCHES)
def test_forms_change_nothing(twins, batches):
    everything = [p4runtime.Entity(table_entry=p4runtime.TableEntry())]
    for batch, atomicity in batches:
        results, entries = [], []
        for each in twins:
            results.append(said(Writer(each).apply(batch, atomicity)))
            entries.append([str(one) for one in Reader(each).read(everything)])
        assert results[0] == results[1]
        assert entries[0] == entries[1]
    for each in twins:
        for table in each.switch.tables.values():
            table.clear()


def insertion(number):
    entity = NAMES.entry("ingress.block_src", {"is_ipv4": 1, "src": number}, "ingress.drop_src")
    return p4runtime.Update(type=p4runtime.Update.INSERT, entity=entity)


def test_the_second_of_a_form_is_not_read():
    made = pipeline(UpdateForms())
    assert made.tables.write_update(insertion(0x0A000001)) is None
    Writer(made).apply([insertion(0x0A000001)], CONTINUE)
    assert made.tables.write_update(insertion(0x0A000002)) is not None
    assert made.tables.write_update(insertion(0x02)) is None, "another length"
    made.close()


@pytest.mark.parametrize("count", [100])
def test_forms_are_bounded(count):
    """What is learnt comes from outside."""
    made = pipeline(UpdateForms())
    for number in range(count):
        update = insertion(0x0A000001 + number)
        update.entity.table_entry.metadata = bytes(number)
        Writer(made).apply([update], CONTINUE)
    assert made.tables._forms.is_full
    assert len(made.switch.tables["ingress.block_src"]) == count
    made.close()
