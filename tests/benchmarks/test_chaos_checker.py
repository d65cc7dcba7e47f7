"""The judge of runs under faults finds each planted violation, and none where there is none."""

import pytest

from benchmarks.chaos_checker import (
    Asked,
    Decided,
    Passed,
    RunRecord,
    Word,
    check,
    gap_ms,
    in_force,
    longest_gaps,
)

BLOCK = Decided("d1", "block", "20.0.7.9")
LIFT = Decided("d1", "unblock", "20.0.7.9")


def clean():
    """A run in which every kind of promise was made and kept."""
    return RunRecord(
        acknowledged=3,
        delivered=[0, 1, 2, 3],
        archive_acknowledged=2,
        archived=[0, 1, 2],
        asked=[Asked("i1", "block", "20.0.7.9")],
        answers={"i1": True},
        decisions=[BLOCK],
        entries=frozenset({"20.0.7.9"}),
        installed={"20.0.7.9": 10.0},
        words=[Word(0.0, "a"), Word(1.0, "a"), Word(2.0, "b"), Word(3.0, "b"), Word(5.0, "a")],
    )


def kinds(record):
    return [each.kind for each in check(record)]


def test_a_lift_ends_its_block_in_whatever_order_clocks_put_them():
    assert in_force([LIFT, BLOCK]) == in_force([BLOCK, LIFT]) == frozenset()
    assert in_force([LIFT, BLOCK, Decided("d2", "block", "20.0.7.9")]) == {"20.0.7.9"}


def test_a_run_that_kept_every_promise_has_no_violation():
    """Also with numbers that came without having been acknowledged, and with failovers there and back."""
    assert not check(clean())


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({"delivered": [0, 2]}, "acknowledged_not_delivered"),
        ({"delivered": [0, 2, 1]}, "order"),
        ({"delivered": [0, 1, 2, 1]}, "twice_after_acknowledgement"),
        ({"archived": [0]}, "acknowledged_not_archived"),
        ({"archived": [0, 1, 1]}, "archived_twice"),
        ({"answers": {}}, "acknowledged_not_answered"),
        ({"decisions": [], "entries": frozenset()}, "acknowledged_not_decided"),
        ({"entries": frozenset()}, "decision_without_entry"),
        ({"decisions": [BLOCK, LIFT]}, "entry_without_decision"),
        ({"entries": None}, "switch_unreadable"),
        (
            {
                "asked": [Asked("i1", "block", "20.0.7.9"), Asked("i2", "unblock", "20.0.7.9")],
                "answers": {"i1": True, "i2": False},
            },
            "not_lifted",
        ),
        ({"passed": [Passed(11.0, "20.0.7.9")]}, "passed_while_blocked"),
        ({"words": [Word(1.0, "a"), Word(1.1, "b"), Word(1.2, "a")]}, "two_actives"),
        ({"reports": [Word(1.0, "a"), Word(1.6, "b"), Word(2.0, "a")]}, "two_actives"),
        ({"away": ["kitsune"]}, "part_away"),
    ],
)
def test_a_planted_violation_is_found_and_no_other(changes, kind):
    """One promise is broken at a time."""
    record = clean()
    for name, value in changes.items():
        setattr(record, name, value)
    assert kinds(record) == [kind]


def test_what_write_did_not_take_was_promised_to_nobody():
    """`write` says that nobody wants an item; the numbers around it are still owed."""
    record = clean()
    record.unwanted, record.delivered = {1}, [0, 2]
    assert not check(record)
    record.delivered = [0]
    assert kinds(record) == ["acknowledged_not_delivered"]


def test_an_instruction_answered_as_done_needs_its_own_decision():
    """A lift that was answered, and that no decision carries out."""
    record = clean()
    record.asked.append(Asked("i2", "unblock", "20.0.7.9"))
    record.answers["i2"] = True
    assert kinds(record) == ["acknowledged_not_decided"]


@pytest.mark.parametrize(
    "excuse",
    [
        {"installed": {}},
        {"installed": {"20.0.7.9": 12.0}},
        {"lifted": {"20.0.7.9": 10.5}},
        {"switch_faults": [10.2]},
    ],
)
def test_a_frame_may_pass_before_the_entry_after_the_lift_and_while_the_switch_is_restored(excuse):
    """The verdict holds between the confirmation and the instruction that ends it."""
    record = clean()
    record.passed = [Passed(11.0, "20.0.7.9")]
    for name, value in excuse.items():
        setattr(record, name, value)
    assert not check(record)


def test_one_overlap_is_one_violation():
    """However often the two took turns in it; a later one is another."""
    record = clean()
    record.words = [Word(0.1 * n, "ab"[n % 2]) for n in range(20)] + [
        Word(9.0, "a"),
        Word(9.1, "b"),
        Word(9.2, "a"),
    ]
    assert kinds(record) == ["two_actives", "two_actives"]


def test_gaps_are_runs_of_missed_frames():
    """A run lasts until the next frame that came."""
    sent = [0.0, 0.5, 1.0, 1.5, 2.0]
    assert gap_ms(sent, [1, 2, 4]) == [(0.5, 1000.0), (2.0, 500.0)]
    assert gap_ms(sent, []) == []


def test_the_longest_gaps_are_told_in_order_of_time():
    found = longest_gaps([(14.0, 30.04), (11.0, 5.0), (12.5, 800.0)], 10.0, most=2)
    assert found == [{"time": 2.5, "ms": 800.0}, {"time": 4.0, "ms": 30.0}]


def test_what_a_damaged_archive_took_with_it_is_excused():
    """Its numbers, and its decisions with their entries; nothing else is."""
    record = clean()
    record.archived, record.excused = [0], {1}
    record.decisions, record.forgotten = [], {"20.0.7.9"}
    record.passed = [Passed(11.0, "20.0.7.9")]
    assert not check(record)
    record.archive_acknowledged = 3
    record.entries = frozenset({"20.0.7.9", "20.0.7.10"})
    assert kinds(record) == ["acknowledged_not_archived", "entry_without_decision"]
