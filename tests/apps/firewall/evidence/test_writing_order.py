"""Numbered pieces are passed on in their writer's order, and none is kept for ever."""

from hypothesis import given
from hypothesis import strategies as st

from apps.firewall.evidence.writing_order import MOST_WAITING, MOST_WRITERS, PATIENCE_S, WritingOrder


@given(st.permutations(range(1, 9)))
def test_any_arrival_ends_in_the_order_of_writing(numbers):
    order = WritingOrder()
    assert [piece for number in numbers for piece in order.take("a", number, number, 0.0)] == list(
        range(1, 9)
    )
    assert order.missed == 0


def test_pieces_without_a_number_and_other_writers_wait_for_nobody():
    order = WritingOrder()
    assert order.take("a", 2, "second", 0.0) == []
    assert order.take("a", 0, "none", 0.0) == ["none"]
    assert order.take("b", 1, "first of b", 0.0) == ["first of b"]


def test_a_missing_number_is_given_up_in_time_and_passed_on_when_it_comes_later():
    order = WritingOrder()
    assert order.take("a", 3, "third", 0.0) == order.take("a", 5, "fifth", 0.1) == []
    assert order.overdue(PATIENCE_S - 0.01) == []
    assert order.overdue(PATIENCE_S) == ["third"]
    assert order.take("a", 4, "fourth", PATIENCE_S) == ["fourth", "fifth"]
    assert order.take("a", 1, "first", PATIENCE_S) == ["first"]
    assert order.missed == 2


def test_a_writer_whose_numbers_make_no_sense_is_bounded():
    order = WritingOrder()
    passed = [
        piece for number in range(MOST_WAITING + 9) for piece in order.take("a", 2 * number + 2, number, 0.0)
    ]
    assert passed == list(range(9))


def test_a_writer_that_is_forgotten_leaves_nothing_behind():
    order = WritingOrder()
    for number in range(MOST_WRITERS):
        assert order.take(f"writer {number}", 2, number, 0.0) == []
    assert order.take("one more", 1, "more", 0.0) == [0, "more"]
