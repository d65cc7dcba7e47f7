"""What cannot be set aside now is kept within bounds and stored later, and what is lost is counted."""

import pytest

from due.drivers.aside_queue import AsidePayload, AsideQueue
from due.errors import BackendError, UpdatesUnavailable

LONG_AFTER = 1000.0


class Store:
    """Takes payloads while it is there; refuses those that say so."""

    def __init__(self):
        self.away = True
        self.taken = []

    def __call__(self, one):
        if self.away:
            raise UpdatesUnavailable("away")
        if one.payload.startswith(b"refused"):
            raise BackendError("refused")
        self.taken.append(one.payload)


@pytest.fixture
def store():
    return Store()


def put(queue, *payloads):
    for payload in payloads:
        queue.put(AsidePayload("a.b", payload, "why", len(payload)), 0.0)


def test_what_waits_is_stored_in_order_when_the_server_is_back(store):
    queue = AsideQueue(store)
    put(queue, b"1", b"2")
    store.away = False
    put(queue, b"3")
    assert store.taken == [], "not before those that came first"
    queue.care(LONG_AFTER)
    assert store.taken == [b"1", b"2", b"3"]
    assert (len(queue), queue.lost) == (0, 0)


def test_a_server_that_is_away_is_asked_again_after_a_while(store):
    queue = AsideQueue(store)
    assert queue.patience(0.0) == float("inf")
    put(queue, b"1")
    assert 0 < queue.patience(0.0) < LONG_AFTER
    store.away = False
    queue.care(0.0)
    assert store.taken == []
    queue.care(LONG_AFTER)
    assert store.taken == [b"1"]


def test_what_is_refused_is_lost_and_holds_nothing_up(store, caplog):
    queue = AsideQueue(store)
    put(queue, b"1", b"refused", b"2")
    store.away = False
    queue.care(LONG_AFTER)
    assert store.taken == [b"1", b"2"]
    assert (len(queue), queue.lost) == (0, 1)
    assert "is lost: refused" in caplog.text


@pytest.mark.parametrize(("size", "fit"), [(0, 1000), (1 << 20, 16)], ids=["entries", "bytes"])
def test_the_queue_is_bounded(store, size, fit):
    queue = AsideQueue(store)
    put(queue, *(b"%04d" % number + bytes(max(0, size - 4)) for number in range(fit + 3)))
    assert (len(queue), queue.lost) == (fit, 3)
    store.away = False
    queue.care(LONG_AFTER)
    assert [int(payload[:4]) for payload in store.taken] == list(range(fit))
    put(queue, b"next")
    assert store.taken[-1] == b"next"


@pytest.mark.parametrize("away", [False, True])
def test_at_the_end_it_is_tried_once_more(store, away):
    queue = AsideQueue(store)
    put(queue, b"1", b"2")
    store.away = away
    queue.close(0.0)
    assert store.taken == ([] if away else [b"1", b"2"])
    assert (len(queue), queue.lost) == (0, 2 if away else 0)
