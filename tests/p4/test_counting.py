"""Cells of the counting stages: counted and read in band; differences, reported when their window is over."""

import pytest

from tests.p4.counting_switch import (
    ADDS,
    ANSWERS,
    SHORT,
    SUBTRACTS,
    ZERO,
    Answer,
    Count,
    Told,
    answer,
    ask,
    clear_cells,
    counts,
    difference,
    install,
    send,
    sweep,
    told,
    want_by_port,
)
from tests.p4.sdnator_switch import PACKET_IN_BYTES, ethernet, mac, udp, want_all

_SECOND = 1_000_000
_NO_ANSWER = None


@pytest.fixture(autouse=True)
def _empty(switch):
    clear_cells(switch)


def counting(switch, *, source_port):
    want_all(switch)
    install(switch, "count", 0, reciprocal=-(-(1 << 64) // _SECOND), size=1024, source_port_mask=source_port)


def differences(switch, threshold=2, **options):
    want_by_port(switch)
    difference(switch, threshold, _SECOND, **options)


def test_each_source_port_has_its_cell(switch):
    counting(switch, source_port=SHORT)
    for port in (1000, 1000, 1001):
        switch.process(1, ethernet(mac(1), mac(2), udp(source_port=port)), 5)
    window = {"source": 0x0A000001, "timestamp": 10}
    assert ask(switch, **window, source_port=1000).count == 2
    assert ask(switch, **window, source_port=1001).count == 1
    assert ask(switch, **window, source_port=1002).count == 0


def test_without_the_mask_ports_share_a_cell(switch):
    counting(switch, source_port=0)
    for port in (1000, 1000, 1001):
        switch.process(1, ethernet(mac(1), mac(2), udp(source_port=port)), 5 * _SECOND)
    window = {"source": 0x0A000001, "timestamp": 5 * _SECOND + 1}
    assert ask(switch, **window).count == 3
    assert ask(switch, **window, source_port=1000).count == 3


def test_written_cells_are_found_among_a_million(switch):
    """The highest cell of the largest array, and a wide one."""
    for name, index, value in (("guard_syns", (1 << 20) - 1, 77), ("cells", 524_287, (1 << 383) + 5)):
        array = switch.registers[f"ingress.{name}"]
        array.write(index, value)
        assert array.written() == [(index, value)]


def test_a_difference_counts_both_sides_of_a_host(switch):
    """Own frames and answers up, acknowledgements down, below zero too."""
    differences(switch, threshold=40)
    for port in (ADDS, ANSWERS, ANSWERS, SUBTRACTS, ADDS):
        assert send(switch, port, 7, 5).digests == []
    for _ in range(2):
        send(switch, SUBTRACTS, 8, 6)
    assert ask(switch, source=0x0A000007, timestamp=10) == Answer(ZERO + 3, 0, False)
    assert ask(switch, source=0x0A000008, timestamp=10).count == ZERO - 2
    assert ask(switch, source=0x0A000009, timestamp=10).count == ZERO


def test_the_next_window_reports_who_is_still_over_one_at_a_time(switch):
    differences(switch)
    for host, ups, downs in ((1, 3, 0), (2, 2, 1), (3, 2, 0)):  # 2 was over for a while
        results = [send(switch, ADDS, host, 5) for _ in range(ups)]
        results += [send(switch, SUBTRACTS, host, 6) for _ in range(downs)]
        assert not any(each.digests for each in results), "nothing within the window"
    found = [counts(send(switch, ADDS, 9, _SECOND + n)) for n in range(4)]
    assert found == [[Count(0, 0, 3, 1)], [], [Count(0, 0, 2, 3)], []]


def test_any_frame_of_the_difference_reports(switch):
    differences(switch)
    for host in (1, 2, 3):
        send(switch, ADDS, host, 5)
        send(switch, ADDS, host, 6)
    found = [counts(send(switch, port, 9, 3 * _SECOND)) for port in (SUBTRACTS, ANSWERS, ADDS)]
    assert found == [[Count(0, 0, 2, host)] for host in (1, 2, 3)]


def test_bytes_are_taken_off_as_they_are_added(switch):
    differences(switch, threshold=50, by_bytes=1)
    send(switch, ADDS, 1, 5, more=30)
    send(switch, SUBTRACTS, 1, 6, more=10)
    send(switch, ADDS, 2, 7, more=58)
    send(switch, SUBTRACTS, 2, 8, more=8)
    assert counts(send(switch, ADDS, 9, _SECOND)) == []
    assert counts(send(switch, ADDS, 9, _SECOND)) == [Count(0, 0, 50, 2)]


def test_packet_outs_empty_the_ring_of_a_query_that_has_no_more_frames(switch):
    differences(switch)
    for host in (1, 2, 3):
        send(switch, ADDS, host, 5)
        send(switch, ADDS, host, 6)
    send(switch, SUBTRACTS, 2, 7)
    assert sweep(switch, 8).packet_ins == [], "their window is not over"
    results = [sweep(switch, _SECOND) for _ in range(4)]
    assert [counts(each) for each in results] == [[Count(0, 0, 2, 1)], [], [Count(0, 0, 2, 3)], []]
    assert [answer(each) for each in results] == [Answer(1, 0, False)] * 2 + [_NO_ANSWER] * 2
    assert answer(sweep(switch, _SECOND, always=True)) == Answer(0, 0, False)


def test_a_sweep_is_as_of_the_time_it_says(switch):
    differences(switch)
    for _ in range(2):
        send(switch, ADDS, 1, 5)
    request = {"operation": 2, "length": 1}
    assert ask(switch, 6, **request) == Answer(0, 0, False)
    assert ask(switch, 6, **request, timestamp=2 * _SECOND) == Answer(0, 0, False)
    assert ask(switch, 7, source=0x0A000001, timestamp=5).count == ZERO + 2, "the count stays"


def test_a_sweep_does_not_need_a_cell_of_its_own(switch):
    """The key of its packet-out would be host 0's; the only cell is another's."""
    differences(switch, size=1)
    for _ in range(2):
        send(switch, ADDS, 1, 5)
    assert counts(sweep(switch, 2 * _SECOND)) == [Count(0, 0, 2, 1)]


def test_reading_a_cell_sweeps_nothing_and_counts_nothing(switch):
    differences(switch)
    for _ in range(2):
        send(switch, ADDS, 1, 5)
    for _ in range(2):
        assert ask(switch, _SECOND, source=0x0A000001, timestamp=5).count == ZERO + 2
    assert counts(send(switch, ADDS, 9, _SECOND)) == [Count(0, 0, 2, 1)]


def test_two_differences_of_one_frame_are_both_swept(switch):
    want_by_port(switch)
    difference(switch, 2, _SECOND)
    difference(switch, 1, _SECOND, stage=1, count_of=5, base=100)
    for _ in range(2):
        send(switch, ADDS, 1, 5)
    found = [counts(send(switch, ADDS, 9, _SECOND)) for _ in range(3)]
    assert sorted(found) == [[], [Count(0, 0, 2, 1)], [Count(5, 0, 2, 1)]]
    assert found[2] == []


def test_a_cell_that_waits_keeps_its_place_and_newcomers_overflow(switch):
    """One cell for each parity: what waits in window 0's is in the way of window 2 until it is swept."""
    differences(switch, size=1)
    for _ in range(2):
        send(switch, ADDS, 1, 5)
    first = send(switch, ADDS, 2, 2 * _SECOND)
    assert (told(first), counts(first)) == ([Told(0, 0, 1)], [])
    again = send(switch, ADDS, 1, 2 * _SECOND)
    assert told(again) == [Told(0, 0, 1)], "its own cell of window 0 is in its way as well"
    assert ask(switch, source=0x0A000002, timestamp=2 * _SECOND) == Answer(ZERO, 2, True)
    assert counts(sweep(switch, 2 * _SECOND)) == [Count(0, 0, 2, 1)]
    assert send(switch, ADDS, 2, 2 * _SECOND).digests == []
    assert ask(switch, source=0x0A000002, timestamp=2 * _SECOND) == Answer(ZERO + 1, 2, False)


def test_a_key_for_which_the_ring_has_no_room_is_reported_at_once(switch):
    differences(switch, threshold=1, size=1)
    assert send(switch, ADDS, 1, 5).digests == []
    full = send(switch, ADDS, 2, _SECOND)
    assert (told(full), counts(full)) == ([Told(0, 1, 0)], [])
    assert counts(sweep(switch, _SECOND)) == [Count(0, 0, 1, 1)]
    assert send(switch, ADDS, 2, _SECOND).digests == [], "now it waits"
    assert counts(send(switch, SUBTRACTS, 9, 2 * _SECOND)) == [Count(0, 1, 2, 2)]


def test_the_ends_of_a_ring_go_round(switch):
    """A key over its threshold in every window is reported in the next one, for longer than the ring."""
    differences(switch, threshold=1, size=2)
    found = [counts(send(switch, ADDS, 1, n * _SECOND)) for n in range(12)]
    assert found == [[]] + [[Count(0, n, 1, 1)] for n in range(11)]


def test_another_generation_forgets_the_ring(switch):
    differences(switch)
    for _ in range(2):
        send(switch, ADDS, 1, 5)
    table = switch.tables["ingress.count_0.queries"]
    table.clear()
    difference(switch, 2, _SECOND, generation=2)
    assert counts(send(switch, ADDS, 9, _SECOND)) == []
    for _ in range(2):
        assert send(switch, ADDS, 1, 2 * _SECOND).digests == [], "the cell that waited waits no longer"
    assert counts(send(switch, ADDS, 9, 3 * _SECOND)) == [Count(0, 2, 2, 1)]


def test_a_learnt_sender_goes_first(switch):
    """A frame that has a digest of its own is not swept."""
    differences(switch)
    for _ in range(2):
        send(switch, ADDS, 1, 5)
    switch.tables["ingress.dmac"].set_default("ingress.flood", (1,))
    switch.tables["ingress.smac"].set_default("ingress.learn", ())
    assert [each.name for each in send(switch, ADDS, 9, _SECOND).digests] == ["learn_digest_t"]
    switch.tables["ingress.smac"].set_default("ingress.ignore", ())
    assert counts(send(switch, ADDS, 9, _SECOND)) == [Count(0, 0, 2, 1)]


def test_whoever_wanted_a_digest_of_a_frame_that_reports_gets_a_copy(switch):
    want_by_port(switch, digests=1)
    difference(switch, 2, _SECOND)
    for _ in range(2):
        assert told(send(switch, ADDS, 1, 5)) == [Told(1, 0, 0)]
    swept = send(switch, ADDS, 9, _SECOND)
    assert [each.name for each in swept.digests] == ["count_digest_t"]
    (copy,) = swept.packet_ins
    assert int.from_bytes(copy[20:PACKET_IN_BYTES], "big") == 1
    after = send(switch, ADDS, 9, _SECOND)
    assert (told(after), after.packet_ins) == ([Told(1, 0, 0)], [])


def test_counts_and_differences_share_a_stage(switch):
    """A query that only counts has cells beside those of a difference."""
    want_by_port(switch)
    common = {"reciprocal": -(-(1 << 64) // _SECOND), "size": 8}
    install(switch, "count", ADDS - 1, query=ADDS - 1, threshold=2, **common)
    install(
        switch, "difference", ANSWERS - 1, count_of=ANSWERS - 1, base=8, threshold=ZERO + 1, answers=1,
        generation=3, **common,
    )  # fmt: skip
    assert [told(send(switch, ADDS, 1, 5)) for _ in range(3)] == [[], [Told(0, 1, 0)], []]
    assert send(switch, ANSWERS, 1, 5).digests == []
    assert counts(send(switch, ADDS, 1, _SECOND)) == [], "not a frame of the difference"
    assert counts(send(switch, ANSWERS, 1, _SECOND)) == [Count(ANSWERS - 1, 0, 1, 1)]
    assert ask(switch, query=ADDS - 1, source=0x0A000001, timestamp=5).count == 3
