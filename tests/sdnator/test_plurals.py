"""One is singular, nothing and many are plural."""

import pytest

from sdnator.plurals import counted


@pytest.mark.parametrize(
    ("number", "noun", "text"),
    [
        (0, "block", "0 blocks"),
        (1, "block", "1 block"),
        (1_234, "packet", "1,234 packets"),
        (2, "entry", "2 entries"),
        (2, "address", "2 addresses"),
    ],
)
def test_numbers_and_nouns(number, noun, text):
    """The noun follows the number."""
    assert counted(number, noun) == text
