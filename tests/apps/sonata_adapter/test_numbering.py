"""Shared numbers and their translation against dictionaries."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from apps.sonata_adapter.numbering import Numbering, Translation

keys = st.integers(1, 60).map(lambda n: n * 0x9E3779B97F4A7C15 % 2**64)
rounds = st.lists(st.lists(keys, min_size=1, max_size=200), max_size=6)


@given(rounds)
def test_a_number_stands_for_one_key(batches):
    """In all batches for which there are numbers."""
    numbering = Numbering()
    known: dict[int, int] = {}
    for batch in batches:
        numbered = numbering.number(np.array(batch, dtype=np.uint64))
        if numbered is None:
            continue
        for key, number in zip(batch, numbered.numbers.tolist(), strict=True):
            assert known.setdefault(key, number) == number
    assert len(set(known.values())) == len(known)


def test_keys_that_come_once_make_it_pause():
    """What is looked up in vain is not looked up for a while; then it is tried again."""
    numbering, rng = Numbering(), np.random.default_rng(1)
    tries = [numbering.number(rng.integers(1, 2**63, 1000).astype(np.uint64)) for _ in range(40)]
    assert [number for number, found in enumerate(tries) if found is not None] == [0, 33]


def test_it_starts_again_when_all_numbers_are_taken():
    """Old translations are forgotten then, so that no number stands for a key of before."""
    numbering, translation = Numbering(), Translation()
    old = np.arange(1, 1001, dtype=np.uint64)
    first = numbering.number(old)
    assert first is not None
    translation.learn(first.numbers[:0], first.numbers[:0])
    assert (translation.own(first) == -1).all()
    translation.learn(first.numbers, np.arange(1000))
    assert translation.own(first).tolist() == list(range(1000))
    many = np.arange(2000, 102_000, dtype=np.uint64)
    found = [numbering.number(many) for _ in range(40)]
    assert all(each is None for each in found)
    second = numbering.number(old)
    while second is None:
        second = numbering.number(old)
    assert (translation.own(second) == -1).all()
