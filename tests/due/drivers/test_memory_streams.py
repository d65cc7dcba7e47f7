"""A stream in memory keeps what was read for replay, up to a size and for a time."""

from due.drivers.memory_streams import MemoryStream

_MINUTE_MS = 60_000


def _kept(*, retain: int, retain_s: float) -> list[int]:
    """The minutes of which an entry is left, after three hours with one a minute and nobody who reads."""
    stream = MemoryStream(1 << 20, retain, 30.0, retain_s)
    for minute in range(180):
        stream.append(bytes(100), minute * _MINUTE_MS, 60.0 * minute)
    return [entry.id[0] // _MINUTE_MS for entry in stream.after((-1, 0), 1000)]


def test_entries_are_kept_up_to_a_size() -> None:
    assert _kept(retain=1000, retain_s=1e9) == list(range(170, 180))


def test_entries_are_kept_for_a_time() -> None:
    assert _kept(retain=1 << 20, retain_s=3600.0) == list(range(119, 180))
