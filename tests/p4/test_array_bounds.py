"""No index of the program leaves its array, whatever frames, entries, registers and packet-outs say: a BMv2 built
for release would end."""

from collections.abc import Iterator
from contextlib import suppress
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataplane.v1model.switch import Switch
from dataplane.v1model.tables import TableError
from sdnator.testing import counting_traffic, hostile_traffic
from sdnator.testing.switch_traffic import Chooser, network_frame
from tests.dataplane.loading import MAKERS, sdnator
from tests.p4.counting_switch import (
    ADDS,
    ask,
    clear_cells,
    counts,
    difference,
    send,
    sweep,
    told,
    want_by_port,
)
from tests.p4.sdnator_switch import CPU, made

_ROUNDS = 12
_BURST = 8
_MAX_ENTRIES = 6
_RECIPROCALS = (0, 1 << 32, (1 << 64) - 1, *map(hostile_traffic.reciprocal, (10, 1_000, 3_600_000_000)))


@pytest.fixture(scope="module", params=MAKERS)
def scribbled(request: pytest.FixtureRequest) -> Iterator[Switch]:
    """A switch of its own: hypothesis runs many cases on one, and leaves registers as it likes."""
    made_switch = made(sdnator(), request.param)
    yield made_switch
    made_switch.close()


@pytest.fixture
def switch(switch: Switch) -> Switch:
    """Nothing is counted yet."""
    clear_cells(switch)
    return switch


def fill(switch: Switch, chooser: Chooser) -> None:
    """Random entries for every table; most frames belong to queries, and reach counting stages."""
    for table in switch.tables.values():
        table.clear()
        for number in range(chooser.random.randint(0, _MAX_ENTRIES) if table.spec.keys else 0):
            with suppress(TableError):  # equal to another, or an action that entries may not have
                table.insert(chooser.entry(table.spec, number))
    for name, action, params in counting_traffic.defaults(chooser.random):
        switch.tables[name].set_default(action, params)
    switch.tables["ingress.telemetry_link"].set_default(
        "ingress.match_link", (chooser.random.getrandbits(8),)
    )
    for name in switch.tables:
        if name.startswith("ingress.count_"):
            switch.tables[name].clear()
    for name, entry in hostile_traffic.entries(chooser.random, switch.tables, _RECIPROCALS):
        with suppress(TableError):
            switch.tables[name].insert(entry)


def scribble(switch: Switch, random: Random) -> None:
    """What a controller may write into registers."""
    for _ in range(20):
        array = switch.registers[random.choice(sorted(switch.registers))]
        array.write(random.randrange(min(array.size, 256)), random.getrandbits(array.width))


@given(st.integers(0, 2**64))
@settings(max_examples=40)
def test_no_access_out_of_range(scribbled, seed):
    """All operations of packet-outs, entries whose cells lie anywhere, frames of all kinds, some mutilated."""
    chooser = Chooser(seed)
    random, now, before = chooser.random, 0, scribbled.out_of_range()
    fill(scribbled, chooser)
    for _ in range(_ROUNDS):
        if random.random() < 0.2:
            scribble(scribbled, random)
        now += random.choice([0, 1, 900, 10**6, 1 << 40])
        frames = [chooser.spoil(network_frame(random)) for _ in range(_BURST)]
        asked = [hostile_traffic.question(random) for _ in range(_BURST)]
        outs = [counting_traffic.packet_out(scribbled.program, each) + b"?" for each in asked]
        scribbled.process_many(random.choice([0, 1, 2, 3, CPU]), frames, [now] * _BURST)
        scribbled.process_many(CPU, [chooser.spoil(each) for each in outs], [now] * _BURST)
    assert scribbled.out_of_range() == before


def test_a_difference_without_room_in_a_bank_goes_to_the_host(switch):
    """Cells that are not all within a bank are none: no count, and every frame is overflow."""
    for base, size in ((0, 0), (32_768, 1), (32_767, 2), (0, 32_769), (2**32 - 1, 2), (1, 2**32 - 1)):
        want_by_port(switch)
        difference(switch, 1, 1000, base=base, size=size)
        (digest,) = told(send(switch, ADDS, 1, 10))
        assert (digest.crossed, digest.overflow) == (0, 1 << (ADDS - 1))
        answer = ask(switch, source=0x0A000001, timestamp=10)
        assert answer is not None
        assert (answer.count, answer.overflow) == (1 << 31, True)
        switch.tables["ingress.count_0.queries"].clear()
        switch.tables["ingress.telemetry_link"].clear()


def test_the_last_cells_of_a_bank_are_cells(switch):
    """The bound itself is inside."""
    want_by_port(switch)
    difference(switch, 1, 1000, base=32_767, size=1, generation=7)
    assert told(send(switch, ADDS, 1, 10)) == []
    answer = ask(switch, source=0x0A000001, timestamp=10)
    assert answer is not None
    assert (answer.count, answer.overflow) == ((1 << 31) + 1, False)
    assert [one.count for one in counts(sweep(switch, 2000))] == [1]


def test_entries_of_one_query_that_do_not_agree_about_its_ring(switch):
    """A ring that another entry has filled further has no place here: what would wait is reported at once."""
    want_by_port(switch)
    difference(switch, 1, 1_000_000, size=1024, generation=9)
    for host in range(1, 10):
        assert told(send(switch, ADDS, host, 10)) == []
    switch.tables["ingress.count_0.queries"].clear()
    difference(switch, 1, 1_000_000, size=1, generation=9)
    (digest,) = told(send(switch, ADDS, 100, 1_000_010))
    assert digest.crossed | digest.overflow == 1 << (ADDS - 1)
    result = sweep(switch, 2_000_010, always=True)
    assert counts(result) == []
    assert len(result.packet_ins) == 1, "an answer, and nothing more to sweep"
    assert int.from_bytes(result.packet_ins[0][12:16], "big") == 0
