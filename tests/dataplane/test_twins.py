"""Generated C against generated Python: random entries and frames, no difference in anything seen."""

from collections.abc import Callable
from dataclasses import replace
from random import Random

import pytest

from dataplane.v1model.externs import MeterConfig
from dataplane.v1model.switch import Replica, Switch
from dataplane.v1model.tables import TableError
from dataplane.v1model.tree import Program
from sdnator.testing import counting_traffic
from sdnator.testing.switch_traffic import Chooser, Maker, feature_frame, network_frame
from tests.dataplane.loading import MAKERS, features, sdnator, shared

_FRAMES = 600
_COUNTING_FRAMES = 1500
_WINDOW_US = 10_000


def backwards() -> Program:
    """Frames leave with their headers in another order."""
    return replace(sdnator(), deparser=sdnator().deparser[::-1])


def without_addresses() -> Program:
    """Frames leave without a header that they came with."""
    return replace(sdnator(), deparser=tuple(name for name in sdnator().deparser if name != "ipv4"))


def long_digests() -> Program:
    """Digests whose length takes one byte or two."""
    digests = {
        number: replace(spec, fields=9 * spec.fields, widths=9 * spec.widths)
        for number, spec in features().digests.items()
    }
    return replace(features(), digests=digests)


_CASES: dict[str, tuple[Callable[[], Program], Maker]] = {
    "features": (features, feature_frame),
    "small": (lambda: shared("small"), network_frame),
    "sketch": (lambda: shared("sketch"), network_frame),
    "sdnator": (sdnator, network_frame),
    "backwards": (backwards, network_frame),
    "without addresses": (without_addresses, network_frame),
    "long digests": (long_digests, feature_frame),
}


def fill_table(chooser: Chooser, name: str, switches: list[Switch]) -> None:
    spec = switches[0].tables[name].spec
    for number in range(chooser.random.choice([0, 1, 3, 10, 40]) if spec.keys else 0):
        entry = chooser.entry(spec, number)
        outcomes = []
        for switch in switches:
            try:
                switch.tables[name].insert(entry)
                outcomes.append("")
            except TableError as error:
                outcomes.append(str(error))
        assert len(set(outcomes)) == 1
        if spec.has_meter and not outcomes[0]:
            for switch in switches:
                switch.tables[name].set_meter(entry.match, entry.priority, MeterConfig(3, 5, 10, 200))
    entries = switches[0].tables[name].entries()
    for entry in chooser.random.sample(entries, len(entries) // 3):
        for switch in switches:
            switch.tables[name].delete(entry.match, entry.priority)


def fill(chooser: Chooser, switches: list[Switch]) -> None:
    for name, table in switches[0].tables.items():
        if not table.spec.is_const:
            fill_table(chooser, name, switches)
        if not table.spec.default_is_const and chooser.random.random() < 0.4:
            action = chooser.random.choice(table.spec.actions)
            params = chooser.params(action)
            for switch in switches:
                switch.tables[name].set_default(action.name, params)
    for switch in switches:
        for session in (1, 98, 99):
            switch.set_clone_session(session, [Replica(510, 1)])
        for session in (5, 6):
            switch.set_clone_session(session, [Replica(4, 7), Replica(510, 1)], packet_length=session * 12)
        switch.set_multicast_group(1, [Replica(1, 1), Replica(2, 2), Replica(3, 3)])
        for meters in switch.meters.values():
            for index in range(meters.size):
                meters.configure(index, MeterConfig(1, 3, 5, 8))


def compare_state(one: Switch, two: Switch, now_us: int) -> None:
    assert one.statistics() == two.statistics()
    assert one.out_of_range() == two.out_of_range()
    if one.program is sdnator():
        assert one.out_of_range() == {}
    for name, table in one.tables.items():
        twin = two.tables[name]
        for entry in table.entries():
            key = (entry.match, entry.priority)
            assert table.counter(*key) == twin.counter(*key)
            assert table.idle_ns(*key, now_us) == twin.idle_ns(*key, now_us)
    for name, counters in one.counters.items():
        for index in range(counters.size):
            assert counters.read(index) == two.counters[name].read(index)
    for name, registers in one.registers.items():
        assert registers.written() == two.registers[name].written()


def run(program: Program, frame_of: Maker, seed: int) -> None:
    chooser = Chooser(seed)
    switches = [Switch(program, maker=maker) for maker in MAKERS]
    fill(chooser, switches)
    random, now, sent = chooser.random, 1000, 0
    while sent < _FRAMES:
        count, port = random.choice([1, 7, 64]), random.choice([0, 1, 2, 3, 510])
        frames = [chooser.spoil(frame_of(random)) for _ in range(count)]
        times = []
        for _ in frames:
            now += random.choice([0, 1, 100, 5000, 400_000, 1_000_000])
            times.append(now)
        one, two = (switch.process_many(port, frames, times) for switch in switches)
        assert one == two
        sent += count
    compare_state(switches[0], switches[1], now)
    for switch in switches:
        switch.close()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("case", _CASES)
def test_both_back_ends_do_the_same(case, seed):
    program, frame_of = _CASES[case]
    run(program(), frame_of, seed)


def counting_pair(chooser: Chooser) -> list[Switch]:
    """The product's program with counting stages in use."""
    switches = [Switch(sdnator(), maker=maker) for maker in MAKERS]
    tables = switches[0].tables
    chosen = counting_traffic.defaults(chooser.random)
    filled = list(counting_traffic.entries(chooser.random, tables, _WINDOW_US))
    for switch in switches:
        switch.set_clone_session(1, [Replica(510, 1)])
        for name, action, params in chosen:
            switch.tables[name].set_default(action, params)
        for name, entry in filled:
            switch.tables[name].insert(entry)
    return switches


@pytest.mark.parametrize("seed", range(6))
def test_both_back_ends_count_the_same(seed):
    """Differences over several windows, swept by frames and by packet-outs."""
    chooser = Chooser(seed)
    random, now, sent = chooser.random, 1000, 0
    one, two = counting_pair(chooser)
    while sent < _COUNTING_FRAMES:
        frames = [network_frame(random) for _ in range(random.choice([1, 9, 40]))]
        times = []
        for _ in frames:
            now += random.choice([0, 1, 100, 900, 7000])
            times.append(now)
        port = random.choice([1, 2, 3, 510])
        if port == 510:
            asked = [
                counting_traffic.question(random, random.choice([0, time, now + _WINDOW_US]))
                for time in times
            ]
            frames = [counting_traffic.packet_out(one.program, each) + b"question" for each in asked]
        assert one.process_many(port, frames, times) == two.process_many(port, frames, times)
        sent += len(frames)
    compare_state(one, two, now)
    for switch in (one, two):
        switch.close()


@pytest.mark.parametrize("maker", MAKERS)
@pytest.mark.parametrize("case", ["features", "sketch", "sdnator"])
def test_bad_frames_are_survived_and_counted(case, maker):
    """Random bytes of 0 to 9,216, and real frames mutilated: every frame gets its verdict."""
    program, frame_of = _CASES[case]
    switch = Switch(program(), maker=maker)
    random = Random(7)
    frames = [random.randbytes(random.choice([0, 1, 13, 14, 60, 1514, 9216])) for _ in range(300)]
    for _ in range(700):
        data = bytearray(frame_of(random))
        for _ in range(random.randint(1, 8)):
            data[random.randrange(len(data))] = random.getrandbits(8)
        frames.append(
            bytes(data[: random.randint(0, len(data))]) + random.randbytes(random.choice([0, 0, 2000]))
        )
    for port in (1, 510):
        result = switch.process_many(port, frames, [0] * len(frames))
        assert len(result.verdicts) == len(frames)
    assert switch.statistics()["frames"] == 2 * len(frames)
    assert switch.statistics()["parser_errors"] > 0
    if case != "features":
        assert switch.out_of_range() == {}
    switch.close()
