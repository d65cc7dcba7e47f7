"""Few blocks are all shown; of many, those whose counters moved."""

from apps.p4runtime_ctrl.state.block_counters import BlockCounters


def reading(number, packets):
    return {"id": f"d{number}", "handle": f"h{number}", "packets": packets, "bytes": 60 * packets}


def test_few_blocks_are_all_shown():
    readings = BlockCounters()
    for _ in range(2):
        readings.take([reading(1, 5), reading(2, 0)])
        assert [each["id"] for each in readings.shown] == ["d1", "d2"]
    readings.take([])
    assert readings.shown == []


def test_of_many_blocks_the_moving_ones_are_shown():
    readings = BlockCounters()
    readings.take([reading(n, 0) for n in range(1000)])
    assert len(readings.shown) == 1000
    readings.take([reading(n, n // 998) for n in range(1000)])
    assert [each["id"] for each in readings.shown] == ["d998", "d999"]
