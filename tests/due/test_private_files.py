"""Files with secrets are their owner's alone, and one that is right already is left as it is."""

from due.private_files import write_private, write_private_json


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
