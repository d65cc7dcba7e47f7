"""Only who has the token may act, and guessing is slow."""

import pytest

from sdnator.dashboard.sign_in import Sessions, Throttle, WeakToken, token_from

TOKEN = "a long enough token"  # noqa: S105
HERE = "127.0.0.1"


def test_the_token_signs_this_browser_in_and_out():
    sessions = Sessions(TOKEN)
    assert not sessions.may_act("one")
    assert sessions.sign_in("one", f" {TOKEN}\n", HERE) == ""
    assert sessions.may_act("one")
    assert not sessions.may_act("two")
    sessions.sign_out("one")
    assert not sessions.may_act("one")


def test_wrong_tokens_bar_nobody_who_has_the_right_one():
    """Neither from elsewhere nor from the same address, which all users of a machine share."""
    sessions = Sessions(TOKEN)
    for second in range(1_000):
        sessions.delay_s(HERE, second / 1_000)
        assert sessions.sign_in("guesser", "x" * 20, HERE) == "this is not the token"
    assert sessions.delay_s("192.0.2.1", 1.0) == 0
    assert 0 < sessions.delay_s(HERE, 1.0) <= 4
    assert sessions.sign_in("owner", TOKEN, HERE) == ""
    assert sessions.delay_s(HERE, 1.0) == 0, "somebody there has the token"


def test_guessing_becomes_slow_for_the_address_it_comes_from():
    """Also many guesses at once: each counts from its beginning."""
    throttle = Throttle()
    delays = [throttle.delay_s(HERE, 0.0) for _ in range(8)]
    assert delays == [0, 0, 0.5, 1, 2, 4, 4, 4]
    assert throttle.delay_s(HERE, 61.0) == 0


def test_addresses_that_are_remembered_are_bounded():
    throttle = Throttle()
    for number in range(1_000):
        throttle.delay_s(str(number), 0.0)
    assert len(throttle._tries) == 256


def test_without_a_token_nobody_signs_in():
    sessions = Sessions("")
    assert sessions.sign_in("one", "", HERE).startswith("there is no token")
    assert not sessions.may_act("one")


def test_sessions_are_bounded():
    sessions = Sessions(TOKEN)
    for number in range(100):
        sessions.sign_in(str(number), TOKEN, HERE)
    assert sessions.may_act("99")
    assert not sessions.may_act("0")


def test_environment_goes_before_file_and_short_tokens_are_refused(tmp_path):
    file = tmp_path / "token"
    file.write_text(TOKEN + "\n")
    assert token_from(str(file), {}) == TOKEN
    assert token_from(str(file), {"SDNATOR_DASHBOARD_TOKEN": "another long token"}) == "another long token"
    assert token_from("", {}) == ""
    file.write_text("short")
    with pytest.raises(WeakToken, match="at least 16"):
        token_from(str(file), {})
    with pytest.raises(OSError, match="none"):
        token_from(str(tmp_path / "none"), {})
