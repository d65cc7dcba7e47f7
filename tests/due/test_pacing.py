"""A pacer lets at most one item a period leave; the latest wins, or all leave in order."""

from hypothesis import given
from hypothesis import strategies as st

from due.backoff import Backoff
from due.pacing import Pacer

gaps = st.lists(st.integers(0, 300), max_size=60)


def _run(pacer: Pacer[int], gaps: list[int]) -> list[tuple[int, int]]:
    """Offer an item after each gap (ms), look every ms; returns (time, item) of what left."""
    left, now = [], 0
    for number, gap in enumerate(gaps):
        for _ in range(gap):
            now += 1_000_000
            if (item := pacer.release(now)) is not None:
                left.append((now, item))
        if (item := pacer.offer(number, now)) is not None:
            left.append((now, item))
    while pacer.due() is not None:
        now += 1_000_000
        if (item := pacer.release(now)) is not None:
            left.append((now, item))
    return left


@given(gaps)
def test_the_latest_wins_and_the_last_always_leaves(gaps):
    pacer: Pacer[int] = Pacer(10.0)
    left = _run(pacer, gaps)
    items = [item for _, item in left]
    assert items == sorted(set(items))
    assert items[-1:] == [len(gaps) - 1] * bool(gaps)
    assert len(items) + pacer.replaced == len(gaps)


@given(gaps)
def test_a_queue_loses_nothing_and_keeps_order(gaps):
    assert [item for _, item in _run(Pacer(10.0, queue=True), gaps)] == list(range(len(gaps)))


@given(gaps)
def test_the_rate_is_kept(gaps):
    for queue in (False, True):
        times = [at for at, _ in _run(Pacer(10.0, queue=queue), gaps)]
        for start in times:
            assert sum(start <= at < start + 1_000_000_000 for at in times) <= 11


def test_back_off_grows_and_begins_anew():
    backoff = Backoff(0.1, 1.0)
    delays = [backoff.failed(0.0) for _ in range(8)]
    assert all(0.5 * 0.1 * 2**n <= d <= 0.1 * 2**n or 0.5 <= d <= 1.0 for n, d in enumerate(delays))
    assert not backoff.due(0.0)
    assert backoff.due(1.1)
    backoff.succeeded()
    assert backoff.due(0.0)
    assert backoff.failed(5.0) <= 0.1
