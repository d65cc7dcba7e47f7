"""Channel patterns match at least what the key does; wrong URLs and lost servers are our errors."""

import fnmatch

import pytest
from hypothesis import given
from hypothesis import strategies as st

from due.drivers.redis_wire import Wire, client, glob
from due.errors import InvalidOption, UpdatesUnavailable
from due.keys import Key

paths = st.lists(st.sampled_from(["a", "b-c", "d_"]), min_size=1, max_size=4).map(".".join)
patterns = st.lists(st.sampled_from(["a", "b-c", "*"]), min_size=1, max_size=3).flatmap(
    lambda parts: st.sampled_from([".".join(parts), ".".join([*parts, "**"])])
)


@given(patterns, paths)
def test_a_channel_pattern_misses_nothing(pattern, path):
    if Key(pattern).matches_path(path):
        wild = glob(pattern)
        assert path == pattern if wild is None else fnmatch.fnmatchcase(path, wild)


def test_big_and_small_commands_survive(server):
    wire = Wire(server.url)
    for size in (0, 1, 16383, 16384, 3_000_000):
        assert wire.call("SET", "t.wire", bytes(size)) == b"OK"
        assert len(wire.call("GET", "t.wire")) == size
    wire.close()


@pytest.mark.parametrize("url", ["http://x", "mongodb://x", "", "redis://host:port/0"])
def test_a_wrong_url_is_an_invalid_option(url):
    with pytest.raises(InvalidOption, match="Data Updates URL"):
        client(url)


def test_a_missing_server_is_unavailable(tmp_path):
    with pytest.raises(UpdatesUnavailable, match="cannot be reached"):
        Wire(f"unix://{tmp_path / 'none.sock'}")
