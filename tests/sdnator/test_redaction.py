"""No password of a URL is shown, wherever the URL stands."""

import pytest

from sdnator.redaction import redacted, redacted_values


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("redis://:secret@10.0.0.5:6379/0", "redis://…@10.0.0.5:6379/0"),
        ("rediss://me:s@e'c:ret@h/0", "rediss://…@h/0"),
        ("unix://:secret@/run/v.sock", "unix://…@/run/v.sock"),
        ("redis+sentinel://u:secret@a:1,b:2/due", "redis+sentinel://…@a:1,b:2/due"),
        ("at 'mongodb://me:secret@a,b/db?x=1': refused", "at 'mongodb://…@a,b/db?x=1': refused"),
        ("sqlite:////home/a@b/archive.db", "sqlite:////home/a@b/archive.db"),
        ("http://127.0.0.1:1/ and mail to a@b", "http://127.0.0.1:1/ and mail to a@b"),
    ],
)
def test_user_and_password_are_left_out_and_nothing_else(text, shown):
    assert redacted(text) == shown


def test_values_are_looked_through():
    values = {"parts": {"x": ["redis://:secret@h/0", 7]}, "pid": 1}
    assert redacted_values(values) == {"parts": {"x": ["redis://…@h/0", 7]}, "pid": 1}
