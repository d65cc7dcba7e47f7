"""Hashes against published check values, meters against a bucket that is refilled step by step."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataplane.errors import DataplaneError, InvalidIndex
from dataplane.v1model.externs import CounterValue, MeterConfig
from dataplane.v1model.switch import Switch
from sdnator.testing.switch_traffic import frame
from tests.dataplane.loading import MAKERS, features, fields
from tests.naive.p4.hashes import HASHES
from tests.naive.p4.meter import GREEN, RED, YELLOW, Meter

_CHECK = b"123456789"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("crc32", 0xCBF43926),
        ("crc32_custom", 0xCBF43926),
        ("crc16", 0xBB3D),
        ("crc16_custom", 0xBB3D),
        ("crcCCITT", 0x29B1),
        ("identity", 0x3132333435363738),
        ("xor16", 0x3132 ^ 0x3334 ^ 0x3536 ^ 0x3738 ^ 0x3900),
        ("xor32", 0x31323334 ^ 0x35363738 ^ 0x39000000),
    ],
)
def test_check_values(name, value):
    assert HASHES[name](_CHECK) == value


@given(st.binary(max_size=100))
def test_internet_checksum_equals_the_sum_by_hand(data):
    total = 0
    for i in range(0, len(data), 2):
        total += int.from_bytes(data[i : i + 2].ljust(2, b"\0"), "big")
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    assert HASHES["csum16"](data) == ~total & 0xFFFF


def test_two_rates_three_colours():
    meter = Meter(per_byte=False)
    assert meter.execute(1, 0) == GREEN, "unconfigured"
    meter.configure((2, 2, 4, 3))
    assert [meter.execute(1, 0) for _ in range(4)] == [GREEN, GREEN, YELLOW, RED]
    assert [meter.execute(1, 500_000) for _ in range(3)] == [GREEN, YELLOW, RED]
    assert meter.execute(1, 0) == RED, "time that runs backwards gives nothing"


def test_bytes_are_counted_where_the_program_says_so():
    meter = Meter(per_byte=True)
    meter.configure((1000, 100, 1000, 100))
    assert [meter.execute(60, t) for t in (0, 1000, 20_000)] == [GREEN, RED, GREEN]


@given(
    rate=st.integers(1, 5000),
    burst=st.integers(1, 50),
    gaps=st.lists(st.integers(0, 100_000), max_size=40),
)
def test_meter_equals_a_bucket_filled_microsecond_by_microsecond(rate, burst, gaps):
    """Tokens in millionths, one addition per packet; the meter's floor never drifts from it."""
    meter = Meter(per_byte=False)
    meter.configure((rate, burst, rate, burst))
    now, level, gained = 0, burst, 0
    for gap in gaps:
        now += gap
        total = now * rate // 1_000_000
        level = min(level + total - gained, burst)
        gained = total
        passes = level >= 1
        level -= passes
        assert (meter.execute(1, now) == GREEN) == passes


@pytest.mark.parametrize("maker", MAKERS)
def test_arrays_read_what_was_written(maker):
    switch = Switch(features(), maker=maker)
    seen, rate, wide = switch.counters["I.seen"], switch.meters["I.rate"], switch.registers["I.wide_cells"]
    seen.write(3, CounterValue(5, 700))
    assert seen.read(3) == CounterValue(5, 700)
    assert rate.config(2) is None
    rate.configure(2, MeterConfig(1, 2, 3, 4))
    assert rate.config(2) == MeterConfig(1, 2, 3, 4)
    rate.configure(2, None)
    assert rate.config(2) is None
    wide.write(1, 2**200 - 1)
    assert (wide.read(1), wide.read(0), wide.read(2)) == (2**200 - 1, 0, 0)
    with pytest.raises(DataplaneError, match="does not fit the 200 bits"):
        wide.write(1, 2**200)
    for array in (seen, wide):
        with pytest.raises(InvalidIndex, match="has no index"):
            array.read(99)
    with pytest.raises(InvalidIndex):
        rate.configure(-1, None)
    with pytest.raises(DataplaneError, match="negative"):
        rate.configure(1, MeterConfig(-1, 0, 0, 0))
    switch.close()


@pytest.mark.parametrize("maker", MAKERS)
def test_accesses_beyond_an_array_are_counted_and_change_nothing(maker):
    """features.p4: 21 reads and writes its arrays at d without a look at their sizes."""
    switch = Switch(features(), maker=maker)
    switch.registers["I.cells"].write(7, 5)
    assert switch.process(1, frame(21, d=3), 0).outputs
    assert switch.out_of_range() == {}
    result = switch.process_many(1, [frame(21, d=4), frame(21, d=8, e=9), frame(21, d=2**32 - 1)], [0] * 3)
    assert [fields(data)["e"] for _, data in result.outputs] == [0, 9, 0]
    assert switch.out_of_range() == {"I.seen": 1, "I.rate": 1, "I.cells": 4, "I.wide_cells": 2 + 1}
    assert switch.registers["I.cells"].written() == [(7, 5)]
    switch.close()
