"""Positions on Kafka: nothing is committed before its work is done, and nothing is kept for ever."""

from hypothesis import given
from hypothesis import strategies as st

from due.drivers.kafka_progress import PartitionProgress, PathWindow


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
