"""Users of the page: hashes in a file of its owner's, names and passwords within bounds, a link that works once."""

import pytest

from sdnator.errors import BadInput
from sdnator.rights.sign_in_link import FILE, new_link, used_up
from sdnator.rights.users import Users

PASSWORD = "correct horse battery"  # noqa: S105


def test_a_password_is_known_and_stands_nowhere(tmp_path):
    Users(tmp_path).add("ada", "viewer", PASSWORD)
    users = Users(tmp_path)
    assert users.path.stat().st_mode & 0o777 == 0o600
    assert PASSWORD not in users.path.read_text()
    assert users.verified("ada", PASSWORD) == users.all["ada"]
    assert users.verified("ada", PASSWORD + "!") is None
    assert users.verified("nobody", PASSWORD) is None
    assert users.verified("nobody", "") is None


def test_two_users_of_one_password_have_nothing_in_common(tmp_path):
    users = Users(tmp_path)
    for name in ("ada", "bob"):
        users.add(name, "viewer", PASSWORD)
    assert len({one.digest for one in users.all.values()} | {one.salt for one in users.all.values()}) == 4


def test_what_others_change_is_taken_up(tmp_path):
    mine, other = Users(tmp_path), Users(tmp_path)
    other.add("ada", "operator", PASSWORD)
    mine.reread()
    before = mine.all["ada"]
    other.change_password("ada", "another password")
    mine.reread()
    assert mine.all["ada"] != before
    assert mine.verified("ada", PASSWORD) is None
    other.remove("ada")
    mine.reread()
    assert not mine.all


@pytest.mark.parametrize("name", ["", "a b", "../x", "x" * 65, "owner", "a\n"])
def test_names_that_cannot_be(tmp_path, name):
    with pytest.raises(BadInput, match="64 letters"):
        Users(tmp_path).add(name, "viewer", PASSWORD)


@pytest.mark.parametrize("password", ["", "short", "x" * 257])
def test_passwords_that_cannot_be(tmp_path, password):
    with pytest.raises(BadInput, match="10 to 256"):
        Users(tmp_path).add("ada", "viewer", password)


def test_what_is_not_there_or_there_already_is_said(tmp_path):
    users = Users(tmp_path)
    users.add("ada", "viewer", PASSWORD)
    with pytest.raises(BadInput, match="passwd ada"):
        users.add("ada", "viewer", PASSWORD)
    for deed in (lambda: users.remove("bob"), lambda: users.change_password("bob", PASSWORD)):
        with pytest.raises(BadInput, match="no user bob"):
            deed()


@pytest.mark.parametrize("text", ["{", "[]", '{"ada": {"role": "king"}}', "\xff"])
def test_a_damaged_file_is_named_and_kept(tmp_path, text):
    (tmp_path / "users.json").write_text(text)
    with pytest.raises(BadInput, match=r"users\.json"):
        Users(tmp_path)
    assert (tmp_path / "users.json").read_text() == text


def test_a_link_signs_in_once_and_the_newest_only(tmp_path):
    old, new = (new_link(tmp_path, "http://127.0.0.1:1/") for _ in range(2))
    assert (tmp_path / FILE).stat().st_mode & 0o777 == 0o600
    secret = new.partition("/link/")[2]
    assert not used_up(tmp_path / FILE, old.partition("/link/")[2])
    assert not used_up(tmp_path / FILE, "")
    assert used_up(tmp_path / FILE, secret)
    assert not used_up(tmp_path / FILE, secret)
