"""Gates of the counting stages: copies from the frame on that opens them, and of keys without a cell."""

import pytest

from tests.p4.counting_switch import (
    ADDRESS,
    ADDS,
    ANSWERS,
    SUBTRACTS,
    clear_cells,
    install,
    send,
    want_by_port,
)

_SECOND = 1_000_000
_OPENS, _UNCOUNTED = 1 << 40, 1 << 41


@pytest.fixture(autouse=True)
def _empty(switch):
    clear_cells(switch)


def gates(switch, threshold, *, size=1024):
    """Frames of a host open its gate; those to it on port ANSWERS only look, those on SUBTRACTS do not belong."""
    want_by_port(switch)
    common = {"threshold": threshold, "reciprocal": -(-(1 << 64) // _SECOND), "size": size}
    common |= {"source_mask": ADDRESS, "opens": _OPENS, "uncounted": _UNCOUNTED}
    install(switch, "gate", ADDS - 1, **common)
    install(switch, "gate", ANSWERS - 1, answers=1, looks=1, **common)


def copied(result):
    """Queries of the copies, but for those that the classifier found."""
    assert not result.digests
    maps = [int.from_bytes(packet[20:52], "big") for packet in result.packet_ins]
    return [each & (_OPENS | _UNCOUNTED) for each in maps]


def test_frames_are_copied_from_the_one_on_that_opens(switch):
    gates(switch, 3)
    found = [copied(send(switch, ADDS, 7, at)) for at in range(5)]
    assert found == [[], [], [_OPENS], [_OPENS], [_OPENS]]


def test_who_looks_passes_when_others_have_opened_and_counts_nothing(switch):
    gates(switch, 2)
    assert [copied(send(switch, ANSWERS, 7, at)) for at in range(3)] == [[], [], []]
    assert copied(send(switch, ADDS, 7, 4)) == []
    assert copied(send(switch, ADDS, 7, 5)) == [_OPENS]
    assert copied(send(switch, ANSWERS, 7, 6)) == [_OPENS]
    assert copied(send(switch, SUBTRACTS, 7, 7)) == []
    assert copied(send(switch, ANSWERS, 8, 8)) == [], "another host"


def test_a_window_closes_the_gate(switch):
    gates(switch, 2)
    assert [copied(send(switch, ADDS, 7, at)) for at in (5, 6)] == [[], [_OPENS]]
    assert copied(send(switch, ADDS, 7, _SECOND + 5)) == []
    assert copied(send(switch, ANSWERS, 7, 2 * _SECOND + 5)) == []


def test_a_key_without_a_cell_is_copied_at_once(switch):
    """Whoever gets it must count it; the key that has the cell goes on."""
    gates(switch, 2, size=1)
    assert copied(send(switch, ADDS, 7, 5)) == []
    assert copied(send(switch, ADDS, 8, 6)) == [_UNCOUNTED]
    assert copied(send(switch, ANSWERS, 8, 7)) == [_UNCOUNTED]
    assert copied(send(switch, ADDS, 7, 8)) == [_OPENS]


def test_cells_outside_their_bank_are_none(switch):
    gates(switch, 1, size=40_000)
    assert copied(send(switch, ADDS, 7, 5)) == [_UNCOUNTED]
