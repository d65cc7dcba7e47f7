"""Only what is both allowed and wanted crosses, each path is received once, and nothing goes round."""

import pytest

from due.bridge.bridged_keys import BridgedKeys
from due.errors import InvalidKey, InvalidOption


@pytest.mark.parametrize(
    ("allowed", "wanted", "patterns"),
    [
        (["a.**"], ["a.b.*"], {"a.b.*"}),
        (["a.b.*"], ["a.**"], {"a.b.*"}),
        (["a.b.*"], ["**"], {"a.b.*"}),
        (["a.*.c"], ["a.b.*"], {"a.*.c"}),
        (["a.**"], ["a.b.c", "a.b.*", "a.b.c"], {"a.b.*"}),
        (["a.**"], ["a.b.c:rate=1", "a.b.c:rate=2"], {"a.b.c"}),
        (["a.b.*", "x.y"], ["a.b.c", "x.*"], {"a.b.c", "x.y"}),
        (["a.**"], ["b.c"], set()),
        (["a.**"], [], set()),
    ],
)
def test_what_is_received_is_what_is_allowed_and_wanted(allowed, wanted, patterns):
    keys = BridgedKeys(allowed)
    keys.want(wanted)
    assert keys.patterns == patterns


@pytest.mark.parametrize(
    ("path", "crosses"), [("a.b.c", True), ("a.b.d", False), ("a.x.c", False), ("b.b.c", False)]
)
def test_a_path_crosses_that_both_sides_name(path, crosses):
    keys = BridgedKeys(["a.*.c"])
    keys.want(["a.b.*"])
    assert keys.may_cross(path) is crosses
    keys.want([])
    assert not keys.may_cross(path)


def test_what_could_go_round_is_refused():
    with pytest.raises(InvalidOption, match="go round for ever"):
        BridgedKeys(["a.**"]).check_apart(BridgedKeys(["a.b.c"]))
    BridgedKeys(["a.b"]).check_apart(BridgedKeys(["a.c"]))


def test_a_malformed_key_is_named():
    with pytest.raises(InvalidKey):
        BridgedKeys(["a..b"])
