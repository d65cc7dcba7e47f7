"""Times that no archive can hold are refused in words."""

import pytest

from sdnator.errors import BadInput
from sdnator.notation import duration_ns, instant_ns, period_ns

DAY = 86_400 * 10**9


@pytest.mark.parametrize("text", ["0001-01-01", "0001-01-01T00:00+00:00", "9999-12-31T23:59:59"])
def test_a_year_far_away_is_refused(text):
    """Python cannot turn it into seconds, or 64 bits cannot hold its nanoseconds."""
    with pytest.raises(BadInput, match=r"--since \d{4}-.*: give a year from 1900 to 2200"):
        period_ns(text, "")


@pytest.mark.parametrize("digits", [6, 30, 400], ids=str)
def test_a_duration_beyond_all_measure_is_refused(digits):
    """However many digits it has."""
    for ask in (lambda text: duration_ns(text, "--for"), lambda text: instant_ns(text, 0, "--for")):
        with pytest.raises(BadInput, match="at most 36500d"):
            ask("9" * digits + "d")


def test_a_hundred_years_are_a_duration():
    """The limit itself is allowed."""
    assert duration_ns("36500d", "--for") == 36_500 * DAY
    assert instant_ns("36500d", 0, "--since") == -36_500 * DAY
