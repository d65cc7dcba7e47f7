"""Who has neither token nor link nor password gets nothing, who is no operator changes nothing, and guessing is slow."""

import pytest

from sdnator.dashboard.sign_in import IDLE_SECONDS, Sessions, Throttle, WeakToken, token_from
from sdnator.rights.sign_in_link import FILE, new_link
from sdnator.rights.users import Users

TOKEN = "a long enough token"  # noqa: S105
PASSWORD = "correct horse battery"  # noqa: S105
HERE = "127.0.0.1"


def by_token(sessions, now=0.0):
    key, wrong = sessions.sign_in("", TOKEN, HERE, now)
    assert not wrong
    return key


@pytest.fixture
def users(tmp_path):
    made = Users(tmp_path)
    made.add("vera", "viewer", PASSWORD)
    made.add("otto", "operator", PASSWORD)
    return made


def test_the_token_signs_this_browser_in_and_out():
    sessions = Sessions(TOKEN)
    key, wrong = sessions.sign_in("", f" {TOKEN}\n", HERE, 0.0)
    assert (wrong, sessions.name_of(key), sessions.role_of(key)) == ("", "owner", "operator")
    assert sessions.may_act(key, 0.0)
    for other in ("", "two"):
        assert not sessions.may_look(other, 0.0)
        assert (sessions.name_of(other), sessions.role_of(other)) == ("", "")
    sessions.sign_out(key)
    assert not sessions.may_look(key, 0.0)


def test_a_viewer_looks_and_an_operator_acts(users):
    sessions = Sessions(TOKEN, users)
    vera, otto = (sessions.sign_in(name, PASSWORD, HERE, 0.0)[0] for name in ("vera", "otto"))
    assert [sessions.may_look(one, 0.0) for one in (vera, otto)] == [True, True]
    assert [sessions.may_act(one, 0.0) for one in (vera, otto)] == [False, True]
    assert sessions.name_of(vera) == "vera"


def test_a_wrong_name_and_a_wrong_password_are_told_apart_by_nothing(users):
    sessions = Sessions(TOKEN, users)
    said = {
        sessions.sign_in(name, given, HERE, 0.0)
        for name, given in (
            ("vera", "x" * 12),
            ("nobody", PASSWORD),
            ("", "x" * 20),
            ("owner", TOKEN),
            ("vera", TOKEN),
        )
    }
    assert len(said) == 1
    assert said.pop()[0] == ""


@pytest.mark.parametrize("change", ["remove", "password", "role"])
def test_a_change_of_a_user_ends_the_sessions(users, change):
    sessions = Sessions(TOKEN, Users(users.path.parent))
    key = sessions.sign_in("otto", PASSWORD, HERE, 0.0)[0]
    assert sessions.may_act(key, 0.0)
    if change == "password":
        users.change_password("otto", PASSWORD)
    else:
        users.remove("otto")
    if change == "role":
        users.add("otto", "viewer", PASSWORD)
    assert not sessions.may_look(key, 0.0)


def test_a_damaged_file_lets_nobody_in_but_the_owner(users):
    sessions = Sessions(TOKEN, Users(users.path.parent))
    key = sessions.sign_in("otto", PASSWORD, HERE, 0.0)[0]
    users.path.write_text("{")
    assert not sessions.may_look(key, 0.0)
    assert sessions.sign_in("otto", PASSWORD, HERE, 0.0)[1]
    assert sessions.may_act(by_token(sessions), 0.0)


def test_a_damaged_file_that_is_repaired_lets_users_in_again(users, caplog):
    """Without a restart, and those who had signed in need not do so again; the log says once what is wrong."""
    sessions = Sessions(TOKEN, Users(users.path.parent))
    key = sessions.sign_in("otto", PASSWORD, HERE, 0.0)[0]
    good = users.path.read_bytes()
    users.path.write_text("{")
    assert not any(sessions.may_look(key, 0.0) for _ in range(3))
    assert [record.levelname for record in caplog.records] == ["ERROR"]
    users.path.write_bytes(good)
    assert sessions.may_look(key, 0.0)
    assert not sessions.sign_in("vera", PASSWORD, HERE, 0.0)[1]


def test_a_link_signs_one_browser_in(tmp_path):
    sessions = Sessions(TOKEN, None, tmp_path / FILE)
    secret = new_link(tmp_path, "http://127.0.0.1:1/").partition("/link/")[2]
    assert sessions.by_link("x", HERE, 0.0) == ""
    key = sessions.by_link(secret, HERE, 0.0)
    assert sessions.may_act(key, 0.0)
    assert sessions.by_link(secret, HERE, 0.0) == ""
    assert Sessions(TOKEN).by_link(secret, HERE, 0.0) == "", "no state folder"


def test_an_idle_browser_signs_in_again():
    sessions = Sessions(TOKEN)
    key = by_token(sessions)
    assert sessions.may_look(key, IDLE_SECONDS)
    assert sessions.may_look(key, IDLE_SECONDS * 2), "it was not idle"
    assert not sessions.may_look(key, IDLE_SECONDS * 3 + 1)


def test_wrong_tokens_bar_nobody_who_has_the_right_one():
    """Neither from elsewhere nor from the same address, which all users of a machine share."""
    sessions = Sessions(TOKEN)
    for second in range(1_000):
        sessions.delay_s(HERE, "", second / 1_000)
        assert sessions.sign_in("", "x" * 20, HERE, 0.0)[1]
    assert sessions.delay_s("192.0.2.1", "", 1.0) == 0
    assert 0 < sessions.delay_s(HERE, "", 1.0) <= 4
    assert sessions.may_act(by_token(sessions), 0.0)
    assert sessions.delay_s(HERE, "", 1.0) == 0, "somebody there has the token"


def test_guessing_at_an_account_from_everywhere_becomes_slow_and_bars_nobody(users):
    sessions = Sessions(TOKEN, users)
    delays = [sessions.delay_s(f"192.0.2.{number}", "otto", 0.0) for number in range(8)]
    assert delays == [0, 0, 0.5, 1, 2, 4, 4, 4]
    assert sessions.delay_s("192.0.2.99", "vera", 0.0) == 0
    assert not sessions.sign_in("otto", PASSWORD, HERE, 0.0)[1]
    assert sessions.delay_s("192.0.2.99", "otto", 0.0) == 0


def test_guessing_becomes_slow_for_the_address_it_comes_from():
    """Also many guesses at once: each counts from its beginning."""
    throttle = Throttle()
    delays = [throttle.delay_s(HERE, 0.0) for _ in range(8)]
    assert delays == [0, 0, 0.5, 1, 2, 4, 4, 4]
    assert throttle.delay_s(HERE, 61.0) == 0


def test_no_number_of_other_names_makes_guessing_at_one_fast_again(users):
    """Nor do they fill memory; who has the name waits no longer, and no shorter, than for one that nobody has."""
    sessions = Sessions(TOKEN, users)
    for name in ("otto", "nobody"):
        for number in range(5):
            sessions.delay_s(f"192.0.2.{number}", name, 0.0)
    for number in range(10_000):
        sessions.delay_s(f"192.0.2.{number % 256}", f"n{number}", 1.0)
    assert [sessions.delay_s("198.51.100.1", name, 2.0) for name in ("otto", "nobody")] == [4, 4]


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("127.0.0.1", "127.9.8.7", True),
        ("127.0.0.1", "::1", True),
        ("192.0.2.1", "::ffff:192.0.2.1", True),
        ("2001:db8::1", "2001:db8::ffff:2", True),
        ("2001:db8::1", "2001:db8:0:1::1", False),
        ("fe80::1%eth0", "fe80::2", True),
        ("192.0.2.1", "192.0.2.2", False),
        ("", "192.0.2.2", False),
    ],
)
def test_addresses_that_one_guesser_has_count_as_one(one, other, same):
    sessions = Sessions(TOKEN)
    delays = [sessions.delay_s(one, "", 0.0) for _ in range(3)]
    assert delays == [0, 0, 0.5]
    assert sessions.delay_s(other, "", 0.0) == (1 if same else 0)


def test_addresses_that_are_remembered_are_bounded():
    throttle = Throttle()
    for number in range(1_000):
        throttle.delay_s(str(number), 0.0)
    assert len(throttle._tries) == 256


def test_without_a_token_nobody_signs_in():
    sessions = Sessions("")
    assert sessions.sign_in("", "", HERE, 0.0)[1]
    assert not sessions.may_look("", 0.0)


def test_sessions_are_bounded():
    sessions = Sessions(TOKEN)
    keys = [by_token(sessions) for _ in range(100)]
    assert sessions.may_look(keys[99], 0.0)
    assert not sessions.may_look(keys[0], 0.0)


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
