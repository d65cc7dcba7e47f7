"""A Read asks for so much and no more, comes in pages between which everybody has a turn, and ends with its client."""

import threading

import grpc
import pytest

from dataplane.p4runtime import reads
from dataplane.p4runtime.table_entities import PAGE
from dataplane.p4runtime.trust import AnyProgram
from p4rt import P4RuntimeStub, p4runtime
from sdnator.testing.p4runtime_client import (
    TIMEOUT_S,
    EntryBuilder,
    P4RuntimeClient,
    insert,
    program_config,
    update_errors,
)
from sdnator.testing.switch_double import SwitchDouble
from tests.dataplane.p4runtime.test_device import PROGRAM, frame, number_of, until
from tests.dataplane.p4runtime.test_trust import OWN

ROUTES = 64


@pytest.fixture
def switch():
    with SwitchDouble(programs=AnyProgram()) as made:
        yield made


@pytest.fixture(scope="module")
def own():
    """The product's program, whose registers have two million cells."""
    with SwitchDouble(programs=AnyProgram()) as made, P4RuntimeClient(made.address) as controller:
        controller.arbitrate()
        controller.set_pipeline(program_config(OWN))
        yield made, controller


def register(number=0, index=None):
    entity = p4runtime.Entity()
    entity.register_entry.register_id = number
    if index is not None:
        entity.register_entry.index.index = index
    return entity


def refused(call):
    with pytest.raises(grpc.RpcError) as caught:
        call()
    return caught.value.code().name, caught.value.details()


@pytest.mark.parametrize("asked", ["all registers", "one of a million cells", "many times a few"])
def test_more_cells_than_one_read_may_ask_for(own, asked):
    """Six bytes asked for 2.3 GB, and held the switch for 16 s."""
    _, controller = own
    info = program_config(OWN).p4info
    large = next(r.preamble.id for r in info.registers if r.size > reads.MOST_CELLS)
    small = next(r for r in info.registers if 1 < r.size <= 256)
    entities = {
        "all registers": [register()],
        "one of a million cells": [register(large)],
        "many times a few": [register(small.preamble.id)] * (reads.MOST_CELLS // small.size + 1),
    }[asked]
    code, text = refused(lambda: controller.read(*entities))
    assert code == "RESOURCE_EXHAUSTED"
    assert str(reads.MOST_CELLS) in text
    assert "by index" in text


def test_cells_by_index_and_whole_small_arrays_are_read(own):
    _, controller = own
    info = program_config(OWN).p4info
    large = next(r for r in info.registers if r.size > reads.MOST_CELLS)
    whole = next(r for r in info.registers if PAGE < r.size * 4 <= reads.MOST_CELLS)
    found = controller.read(register(large.preamble.id, large.size - 1), *[register(whole.preamble.id)] * 4)
    assert len(found) == 1 + 4 * whole.size


def test_a_write_may_not_set_any_number_of_cells(own):
    _, controller = own
    info = program_config(OWN).p4info
    large = next(r for r in info.registers if r.size > reads.MOST_CELLS)
    entity = register(large.preamble.id)
    entity.register_entry.data.bitstring = b"\x01"
    change = p4runtime.Update(type=p4runtime.Update.MODIFY, entity=entity)
    with pytest.raises(grpc.RpcError) as caught:
        controller.write(change, change, change)
    codes = [error.canonical_code for error in update_errors(caught.value)]
    assert (codes[0], codes[-1]) == (0, grpc.StatusCode.RESOURCE_EXHAUSTED.value[0])


def filled(switch, controller):
    config = program_config(PROGRAM)
    controller.set_pipeline(config)
    names = EntryBuilder(config.p4info)
    entries = [names.entry("I.route", {"h.ip.dst": (n << 8, 24)}, "I.drop") for n in range(ROUTES)]
    controller.write(*map(insert, entries))
    return names


def whole_table(names):
    entity = p4runtime.Entity()
    entity.table_entry.table_id = names.tables["I.route"].preamble.id
    return entity


def test_frames_are_forwarded_and_entries_deleted_between_two_pages(switch, monkeypatch):
    """What is deleted meanwhile is not in the pages to come."""
    monkeypatch.setattr("dataplane.p4runtime.table_entities.PAGE", 8)
    monkeypatch.setattr(reads, "PAGE", 8)
    with P4RuntimeClient(switch.address) as controller:
        controller.arbitrate()
        names = filled(switch, controller)
        request = p4runtime.ReadRequest(device_id=1, entities=[whole_table(names)])
        reading = switch.device.read(request)
        first = reading.page()
        switch.memory[1].inject(frame(7))
        assert number_of(controller.packets.get(timeout=TIMEOUT_S)) == 7
        gone = names.entry("I.route", {"h.ip.dst": ((ROUTES - 1) << 8, 24)})
        controller.write(p4runtime.Update(type=p4runtime.Update.DELETE, entity=gone))
        pages = [first]
        while (page := reading.page()) is not None:
            pages.append(page)
    sizes = [len(page.entities) for page in pages]
    assert (sum(sizes), max(sizes)) == (ROUTES - 1, 8)


def test_a_read_ends_when_the_pipeline_is_replaced(switch):
    with P4RuntimeClient(switch.address) as controller:
        controller.arbitrate()
        names = filled(switch, controller)
        reading = switch.device.read(p4runtime.ReadRequest(device_id=1, entities=[whole_table(names)]))
        controller.set_pipeline(program_config(PROGRAM))
        with pytest.raises(reads.Refused, match="replaced"):
            reading.page()


def test_a_client_that_is_gone_ends_the_work(switch, monkeypatch):
    """And so many Reads at once are served, no more."""
    going_on, pages = threading.Event(), []

    def endless(self, filters, results):
        while not going_on.is_set():
            pages.append(1)
            yield p4runtime.ReadResponse(entities=[p4runtime.Entity()] * PAGE)

    monkeypatch.setattr(reads.Reader, "pages", endless)
    request = p4runtime.ReadRequest(device_id=1)
    with P4RuntimeClient(switch.address) as controller:
        controller.arbitrate()
        filled(switch, controller)
        calls = [controller.stub.Read(request, timeout=TIMEOUT_S) for _ in range(8)]
        for call in calls:
            next(call)
        assert refused(lambda: list(controller.stub.Read(request)))[0] == "RESOURCE_EXHAUSTED"
        for call in calls:
            call.cancel()
        with grpc.insecure_channel(switch.address) as channel:
            stub = P4RuntimeStub(channel)
            until(lambda: next(stub.Read(request, timeout=TIMEOUT_S)))
        servicer = switch.server.servicer
        until(lambda: servicer.reads_in_progress == 0)
        before = len(pages)
        assert len(pages) == before
        going_on.set()
