"""Shared numbers, and operators' own that go on from them, against dictionaries."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from apps.sonata_adapter.host.key_dictionary import KeyDictionary, KeyNumbers

LIMIT = 1 << 20
keys = st.integers(1, 60).map(lambda n: n * 0x9E3779B97F4A7C15 % 2**64)
rounds = st.lists(st.lists(keys, min_size=1, max_size=200), max_size=6)


def numbered(numbering, batch):
    """Numbers of keys that stand for themselves."""
    every = np.array(batch, dtype=np.uint64)
    return numbering.number(every, lambda rows: (every[rows],))


def own(operator, batch, shared=None):
    """An operator's numbers, by the shared ones where there are some."""
    every = np.array(batch, dtype=np.uint64)
    found = operator.share(shared)
    return operator.number(every, lambda rows: [(every[rows],)]) if found is None else found


@given(rounds)
def test_a_number_stands_for_one_key(batches):
    """In all batches for which there are numbers."""
    numbering = KeyDictionary("name")
    known: dict[int, int] = {}
    for batch in batches:
        found = numbered(numbering, batch)
        for key, number in zip(batch, found.numbers.tolist(), strict=True):
            assert known.setdefault(key, number) == number
        assert found.known.columns()[0][0][found.numbers].tolist() == batch
    assert len(set(known.values())) == len(known)


def test_keys_that_come_once_make_it_pause():
    """What is looked up in vain is not looked up for a while; then it is tried again."""
    numbering, rng = KeyDictionary("name"), np.random.default_rng(1)
    tries = [numbered(numbering, rng.integers(1, 2**63, 1 << 14)) for _ in range(40)]
    assert [number for number, found in enumerate(tries) if found is not None] == [0, 33]


@given(rounds, st.integers(0, 6), st.booleans())
def test_operators_keep_their_numbers_when_they_are_on_their_own(batches, alone_from, restarted):
    """A key has one number whether others number it or not, and what it stands for is known."""
    numbering, operator = KeyDictionary("name"), KeyNumbers(("name",), LIMIT, 0)
    known: dict[int, int] = {}
    for place, batch in enumerate(batches):
        if restarted and place == alone_from:
            numbering = KeyDictionary("name")
        shared = None if place == alone_from and not restarted else numbered(numbering, batch)
        for key, number in zip(batch, own(operator, batch, shared).tolist(), strict=True):
            assert known.setdefault(key, number) == number
    numbers = np.array(list(known.values()), dtype=np.int64)
    assert operator.columns(numbers)[0][0].tolist() == list(known)
    assert sorted(known.values()) == list(range(operator.size))


def test_it_starts_again_when_all_numbers_are_taken():
    """Operators that had the old ones go on alone with what they had."""
    numbering, operator = KeyDictionary("name"), KeyNumbers(("name",), LIMIT, 0)
    old = np.arange(1, 1001, dtype=np.uint64)
    first = own(operator, old, numbered(numbering, old))
    many = np.arange(2000, 102_000, dtype=np.uint64)
    assert numbered(numbering, many) is None
    second = numbered(numbering, old)
    while second is None:
        second = numbered(numbering, old)
    assert own(operator, old, second).tolist() == first.tolist()
    assert len(set(own(operator, many, None).tolist()) | set(first.tolist())) == operator.size


def test_an_operator_with_little_room_does_not_fill_it_with_others_keys():
    """It numbers its own keys, up to its limit."""
    numbering, operator = KeyDictionary("name"), KeyNumbers(("name",), 3, 0)
    assert own(operator, [5, 6, 7, 8, 5], numbered(numbering, [5, 6, 7, 8, 5])).tolist() == [0, 1, 2, -1, 0]
    assert operator.full
