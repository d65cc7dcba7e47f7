"""Positions on Kafka: nothing is committed before its work is done, and nothing is kept for ever."""

from hypothesis import given
from hypothesis import strategies as st

from due.drivers.kafka_progress import AwaitedGroups, PartitionProgress, PathWindow


@given(wanted=st.lists(st.booleans(), max_size=40), order=st.randoms(use_true_random=False))
def test_the_position_stops_at_the_first_entry_whose_work_is_not_done(wanted, order) -> None:
    """Entries may be acknowledged in any order."""
    progress = PartitionProgress(5)
    for offset, wants in enumerate(wanted, 5):
        if wants:
            progress.deliver(offset)
        else:
            progress.pass_over(offset)
    unfinished = {offset for offset, wants in enumerate(wanted, 5) if wants}
    for offset in order.sample(sorted(unfinished), len(unfinished)):
        assert progress.position == min(unfinished)
        progress.acknowledge(offset)
        unfinished.discard(offset)
    assert progress.position == 5 + len(wanted)
    assert progress.unfinished == 0


def test_the_next_reader_knows_what_was_delivered_before() -> None:
    """The commit's metadata carries it; what nobody has seen counts as new."""
    first = PartitionProgress(0)
    for offset in range(3):
        first.deliver(offset)
    first.acknowledge(0)
    commit = first.commit()
    assert commit is not None
    assert first.commit() is None, "nothing has changed"
    second = PartitionProgress(*commit)
    assert [second.deliver(offset) for offset in (1, 2, 3)] == [2, 2, 1]
    third_commit = second.commit()
    assert third_commit is not None
    assert PartitionProgress(*third_commit).deliver(1) == 3


@given(note=st.text(max_size=60))
def test_metadata_of_other_programs_means_nothing(note: str) -> None:
    """Anybody who may commit can write anything there."""
    assert PartitionProgress(7, note).deliver(7) >= 1


def test_a_window_keeps_what_the_slowest_group_has_not_committed() -> None:
    """Without any group, what the brokers have is enough."""
    window = PathWindow("r.x.y", "due.r.r.x.y", 1000)
    records = [window.add(100) for _ in range(3)]
    assert not window.has_room(500)
    window.release([])
    assert window.kept_bytes == 900, "the brokers have none of it yet"
    for offset, record in enumerate(records):
        record.place = (1, offset)
    place = ("due.r.r.x.y", 1)
    window.release([{place: 2}, {place: 1}])
    assert len(window.kept) == 2
    window.release([{place: 3}, {}])
    assert len(window.kept) == 2, "a group without a position has read nothing"
    window.release([])
    assert window.kept_bytes == 0
    assert window.has_room(5000), "an empty window takes any payload"


def test_a_group_that_never_gets_a_position_is_not_waited_for_for_ever() -> None:
    """One without the right to read a topic would hold back its producers as long as it runs."""
    place = ("due.r.r.x.y", 0)
    window, awaited = PathWindow("r.x.y", place[0], 1000), AwaitedGroups(30.0)

    def release(now: float) -> int:
        groups = {"reads": {place: 1}, "denied": {("due.r.r.x.z", 0): 7}}
        window.release(awaited.of(place[0], groups, now))
        return len(window.kept)

    for offset in range(2):
        window.add(100).place = (0, offset)
    assert release(100.0) == 2, "it may be about to begin"
    assert release(130.0) == 2
    assert release(131.0) == 1, "the other one is still waited for"
    window.add(100).place = (0, 2)
    assert release(1000.0) == 2, "and the first one is not waited for again"


def test_a_group_that_begins_late_is_waited_for_from_then_on() -> None:
    """As slow as it may be, and also where its position cannot be told for a while."""
    place = ("due.r.r.x.y", 0)
    awaited = AwaitedGroups(30.0)
    assert awaited.of(place[0], {"slow": {}}, 100.0) == [{}]
    assert awaited.of(place[0], {"slow": {}}, 200.0) == []
    for now, offset in ((201.0, 0), (900.0, -1), (1800.0, 0)):
        assert awaited.of(place[0], {"slow": {place: offset}}, now) == [{place: offset}]
    assert awaited.of(place[0], {}, 2000.0) == []
    assert awaited.of(place[0], {"slow": {}}, 3000.0) == [{}], "a new reader of that name"
