"""The latest documents come in the order of their last items, and no more are read than that takes."""

import math
import random
from collections.abc import Callable, Generator
from typing import Any

import pytest

from due.drivers.mongodb_latest import batch_size, latest_to_end, named_keys

Document = dict[str, Any]


def document(begin: Any, end: Any, key: str = "a") -> Document:
    return {"dataKey": key, "timestamp": begin, "lastTimestamp": end}


def reader(
    documents: dict[str, list[Document]], taken: list[Document]
) -> Callable[[str], Generator[Document, None, None]]:
    """Reads what is there of a key, in the order of the server, and notes it."""

    def read(key: str) -> Generator[Document, None, None]:
        for one in sorted(documents[key], key=lambda each: each["timestamp"], reverse=True):
            taken.append(one)
            yield one

    return read


@pytest.mark.parametrize("span", [0, 7, 10_000])
def test_documents_come_in_the_order_of_their_last_items(span: int) -> None:
    chance = random.Random(span)
    documents = {
        key: [
            document(begin, begin + chance.randrange(span + 1), key)
            for begin in chance.choices(range(1000), k=100)
        ]
        for key in "abc"
    }
    found = list(latest_to_end("abc", reader(documents, []), span))
    assert [end for end, _ in found] == [one["lastTimestamp"] for _, one in found]
    assert [end for end, _ in found] == sorted((end for end, _ in found), reverse=True)
    everything = [one for key in "abc" for one in documents[key]]
    assert sorted(map(str, (one for _, one in found))) == sorted(map(str, everything))


def test_no_more_is_read_than_may_end_later() -> None:
    documents = {key: [document(begin, begin, key) for begin in range(1000)] for key in "abc"}
    taken: list[Document] = []
    found = latest_to_end("abc", reader(documents, taken), 5)
    assert next(found)[0] == 999
    assert len(taken) <= 3 * 7


@pytest.mark.parametrize(
    ("begin", "first"), [(None, False), (math.nan, False), ("yesterday", True), (True, True), (10.0, True)]
)
def test_a_damaged_time_hides_nothing_else(begin: Any, *, first: bool) -> None:
    """The server has put the damaged document where BSON's order has it."""
    sound = [document(begin, begin) for begin in (9, 8, 7)]
    damaged = document(begin, 3)
    stored = {"a": [damaged, *sound] if first else [*sound, damaged], "b": [document(8, 8, "b")]}

    def read(key: str) -> Generator[Document, None, None]:
        yield from stored[key]

    assert [end for end, _ in latest_to_end("ab", read, 0)] == [9, 8, 8, 7, 3]


def test_reads_are_closed_when_enough_was_taken() -> None:
    closed: list[str] = []

    def read(key: str) -> Generator[Document, None, None]:
        try:
            yield from (document(begin, begin, key) for begin in range(9, 0, -1))
        finally:
            closed.append(key)

    found = latest_to_end("ab", read, 0)
    next(found)
    found.close()
    assert sorted(closed) == ["a", "b"]


@pytest.mark.parametrize(
    ("criteria", "keys"),
    [
        ({}, None),
        ({"dataKey": {"$eq": "a"}}, ["a"]),
        ({"dataKey": {"$in": ["a", "b", "a"]}, "timestamp": {"$gte": 5}}, ["a", "b"]),
        ({"dataKey": {"$in": []}}, []),
        ({"dataKey": {"$in": ["a"], "$eq": "b"}}, None),
        ({"dataKey": {"$in": [str(n) for n in range(1000)]}}, None),
        ({"$or": [{"dataKey": {"$eq": "a"}}, {"timestamp": {"$gte": 5}}]}, None),
    ],
)
def test_keys_are_asked_for_one_by_one_where_a_filter_names_a_few(
    criteria: Document, keys: list[str] | None
) -> None:
    assert named_keys(criteria) == keys


def test_batches_grow_with_the_limit_and_shrink_with_the_keys() -> None:
    assert batch_size(1, 1) == 100
    assert batch_size(500, 1) == 516
    assert batch_size(10**6, 1) == 1000
    assert batch_size(10**6, 200) == 100
    assert batch_size(1, 10**6) == 2
