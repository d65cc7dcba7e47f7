"""Hash tables and sketches against dictionaries, with keys that collide on purpose."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from apps.sonata_adapter.host.key_tables import Growing, KeyTable, hashes, zeros
from apps.sonata_adapter.host.sketches import Bloom, CountMin

keys = st.one_of(
    st.integers(1, 20).map(lambda n: n << 20),  # all in one slot
    st.integers(1, 2**64 - 1),
)
rounds = st.lists(st.lists(keys, max_size=60), max_size=6)


@given(rounds)
def test_keys_are_numbered_by_first_occurrence(batches):
    """The same numbers as a dictionary gives, and the rows where new keys stand first."""
    table = KeyTable(1 << 20)
    twin: dict[int, int] = {}
    for batch in batches:
        expected_new = []
        expected = []
        for row, key in enumerate(batch):
            if key not in twin:
                twin[key] = len(twin)
                expected_new.append(row)
            expected.append(twin[key])
        numbers, first = table.number(np.array(batch, dtype=np.uint64))
        assert numbers.tolist() == expected
        assert first.tolist() == expected_new
    assert table.size == len(twin)


@given(rounds, st.integers(1, 30))
def test_a_full_table_keeps_what_it_has(batches, limit):
    """Beyond the limit keys are -1; keys with a number keep it."""
    table = KeyTable(limit)
    known: dict[int, int] = {}
    for batch in batches:
        numbers, first = table.number(np.array(batch, dtype=np.uint64))
        assert table.size <= limit
        for key, number in zip(batch, numbers.tolist(), strict=True):
            if number >= 0:
                assert known.setdefault(key, number) == number
            else:
                assert key not in known
                assert table.size == limit
        assert sorted(numbers[first].tolist()) == sorted(set(numbers[first].tolist()))
    assert sorted(known.values()) == list(range(len(known)))


def test_many_keys_grow_the_table():
    """A hundred thousand keys in batches."""
    table = KeyTable(1 << 20)
    every = np.random.default_rng(1).integers(1, 2**63, 100_000).astype(np.uint64)
    for part in np.array_split(every, 30):
        table.number(part)
    numbers, first = table.number(every)
    assert not len(first)
    assert numbers.tolist() == list(range(100_000))


def test_equal_rows_have_equal_hashes_whatever_their_batch():
    """A constant upper half counts as the zeros that it stands for."""
    low = np.arange(10, dtype=np.uint64)
    assert (hashes([(zeros(10), low)], 10) == hashes([(np.zeros(10, dtype=np.uint64), low)], 10)).all()
    swapped = hashes([(low,), (low[::-1].copy(),)], 10) == hashes([(low[::-1].copy(),), (low,)], 10)
    assert not swapped.any()


def test_keys_of_near_addresses_differ_and_spread():
    """Half a million pairs that differ in few bits: no key twice, and slots as full as chance makes them."""
    for shift in (0, 8, 16, 32, 48):
        near = np.arange(700, dtype=np.uint64) << np.uint64(shift)
        left, right = np.repeat(near, 700), np.tile(near, 700)
        bits = hashes([(zeros(len(left)), left), (zeros(len(right)), right)], len(left))
        assert len(np.unique(bits)) == len(left)
        used = len(np.unique(bits & np.uint64((1 << 19) - 1))) / (1 << 19)
        assert used > 0.55  # chance: 1 - e^(-490000 / 2^19) = 0.61
        alone = hashes([(near,)], 700)
        assert len(np.unique(alone)) == 700
        assert len(np.unique(alone & np.uint64(4095))) > 500


@given(st.lists(keys, max_size=300))
def test_bloom_never_takes_an_old_key_for_a_new_one(batch):
    """What it calls new is new; with room it misses next to nothing."""
    bloom, seen = Bloom(1 << 12), set()
    for start in range(0, len(batch), 50):
        part = batch[start : start + 50]
        for row in bloom.add(np.array(part, dtype=np.uint64)).tolist():
            assert part[row] not in seen
            seen.add(part[row])
    assert 0 <= bloom.missed_share < 1


@given(st.lists(st.tuples(st.integers(1, 40), st.integers(1, 9)), min_size=1, max_size=300))
def test_count_min_never_counts_too_little(rows):
    """An estimate is at least the truth."""
    sketch = CountMin(64)
    truth: dict[int, int] = {}
    for key, amount in rows:
        truth[key] = truth.get(key, 0) + amount
        estimate = sketch.add(np.array([key], dtype=np.uint64), np.array([amount]))
        assert estimate[0] >= truth[key]
    assert sketch.total == sum(truth.values())


def test_growing_keeps_what_is_in_it():
    """Room is made by doubling."""
    growing = Growing(np.int64)
    for start in range(0, 10_000, 700):
        growing.append(np.arange(start, start + 700))
    assert growing.data.tolist() == list(range(10_500))
