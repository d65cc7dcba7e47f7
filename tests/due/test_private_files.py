"""Files with secrets are their owner's alone, and one that is right already is left as it is."""

import os

import pytest

from due.private_files import locked, private_folder, write_private, write_private_json
from tests.requirements import require_root

SOMEBODY = 65_534


def test_a_file_that_holds_the_text_is_not_written_again(tmp_path):
    """On a full disk a part can be started again with the settings that it had."""
    path = tmp_path / "settings.json"
    write_private_json(path, {"a": 1})
    before = path.stat().st_ino
    write_private_json(path, {"a": 1})
    assert path.stat().st_ino == before
    write_private_json(path, {"a": 2})
    assert path.read_text() == '{\n  "a": 2\n}\n'


def test_a_file_that_others_may_read_is_replaced(tmp_path):
    """The text alone is not enough."""
    path = tmp_path / "secret"
    path.write_text("word")
    path.chmod(0o644)
    write_private(path, "word")
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_link_is_replaced_by_a_file(tmp_path):
    """Whoever could make a link elsewhere does not choose where the text is read from."""
    elsewhere = tmp_path / "elsewhere"
    write_private(elsewhere, "word")
    path = tmp_path / "secret"
    path.symlink_to(elsewhere)
    write_private(path, "word")
    assert not path.is_symlink()


def test_what_root_writes_into_another_users_folder_is_that_users(tmp_path):
    """A service reads what root's commands change for it."""
    require_root()
    os.chown(tmp_path, SOMEBODY, SOMEBODY)
    folder = tmp_path / "state" / "model"
    private_folder(folder)
    write_private(folder / "secret", "word")
    with locked(folder / "file.lock"):
        made = [folder.parent, folder, folder / "secret", folder / "file.lock"]
    assert [(path.stat().st_uid, path.stat().st_mode & 0o077) for path in made] == [(SOMEBODY, 0)] * 4


def test_a_lock_that_is_a_link_is_not_opened(tmp_path):
    """Whoever owns the folder does not choose which file root opens."""
    (tmp_path / "file.lock").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="symbolic links"), locked(tmp_path / "file.lock"):
        pass
    assert not (tmp_path / "elsewhere").exists()
