"""Only who has the token may act, and guessing is slow."""

import pytest

from sdnator.dashboard.sign_in import Sessions, WeakToken, token_from

TOKEN = "a long enough token"  # noqa: S105


def test_the_token_signs_this_browser_in_and_out():
    sessions = Sessions(TOKEN)
    assert not sessions.may_act("one")
    assert sessions.sign_in("one", f" {TOKEN}\n", 0.0) == ""
    assert sessions.may_act("one")
    assert not sessions.may_act("two")
    sessions.sign_out("one")
    assert not sessions.may_act("one")


def test_after_some_wrong_tokens_even_the_right_one_must_wait():
    sessions = Sessions(TOKEN)
    for second in range(5):
        assert sessions.sign_in("one", "x" * 20, float(second)) == "this is not the token"
    assert sessions.sign_in("one", TOKEN, 5.0) == "too many wrong tokens: wait a minute"
    assert sessions.sign_in("one", TOKEN, 66.0) == ""


def test_without_a_token_nobody_signs_in():
    sessions = Sessions("")
    assert sessions.sign_in("one", "", 0.0).startswith("there is no token")
    assert not sessions.may_act("one")


def test_sessions_are_bounded():
    sessions = Sessions(TOKEN)
    for number in range(100):
        sessions.sign_in(str(number), TOKEN, 0.0)
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
