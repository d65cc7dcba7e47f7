"""What is backed up comes back, what was there is kept, and what cannot be read changes nothing."""

import io
import json
import resource
import sqlite3
import tarfile
import time
from contextlib import closing
from urllib.parse import quote

import pytest
from typer.testing import CliRunner

from due import Item
from due.backends import open_archive
from sdnator.cli.main import app
from sdnator.errors import BadInput, PipelineError
from sdnator.up import running
from sdnator.up.running import claimed


@pytest.fixture
def home(tmp_path, monkeypatch):
    for name in ("STATE", "DATA", "CONFIG"):
        monkeypatch.setenv(f"XDG_{name}_HOME", str(tmp_path / name.lower()))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def fill(home, value):
    driver = open_archive(f"sqlite://{home}/data/sdnator/archive.db")
    now = time.time_ns()
    driver.insert([Item("a.b.c.d", value, now, now, "app", "instance", value)])
    driver.close()


def values(home):
    driver = open_archive(f"sqlite://{home}/data/sdnator/archive.db")
    try:
        return [item.value for item in driver.find({"dataKey": "a.b.c.d"})]
    finally:
        driver.close()


def run(*words):
    return CliRunner().invoke(app, [*map(str, words)], catch_exceptions=False)


def test_archive_configuration_and_model_come_back(home):
    fill(home, 1)
    config = home / "config" / "sdnator" / "sdnator.toml"
    config.parent.mkdir(parents=True)
    model = home / "home.model"
    model.write_bytes(b"trained")
    config.write_text(f'[kitsune]\nload_model = "{model}"\n')
    kept = running.model_file(running.state_folder())
    kept.parent.mkdir(parents=True)
    kept.write_bytes(b"kept")
    done = run("backup", home / "b.tar.gz", "--json")
    names = ["archive.db", "kept/kitsune.npz", "models/home.model", "sdnator.toml"]
    assert json.loads(done.stdout)["files"] == names
    kept.unlink()
    assert (home / "b.tar.gz").stat().st_mode & 0o077 == 0
    fill(home, 2)
    config.write_text("# another\n")
    found = json.loads(run("restore", home / "b.tar.gz", "--json").stdout)
    assert values(home) == [1]
    assert "load_model" in config.read_text()
    assert (home / "data" / "sdnator" / "models" / "home.model").read_bytes() == b"trained"
    assert kept.read_bytes() == b"kept"
    assert (config.parent / "sdnator.toml.before-restore").read_text() == "# another\n"
    assert len(found["kept"]) == 2


def test_a_backup_of_nothing_is_said_to_be_one(home):
    assert "there was nothing" in run("backup", home / "b.tar.gz").stdout


def test_nothing_is_written_over(home):
    (home / "b.tar.gz").write_text("mine")
    with pytest.raises(BadInput, match="already exists"):
        run("backup", home / "b.tar.gz")


def test_no_restoring_under_a_running_pipeline(home):
    with claimed(home / "state" / "sdnator"), pytest.raises(PipelineError, match="sdnator down"):
        run("restore", home / "b.tar.gz")


def packed(path, manifest, **files):
    with tarfile.open(path, "w:gz") as tar:
        for name, content in {"manifest.json": json.dumps(manifest).encode(), **files}.items():
            about = tarfile.TarInfo(name)
            about.size = len(content)
            tar.addfile(about, io.BytesIO(content))


def archive_of_version(home, version):
    connection = sqlite3.connect(home / "x.db")
    connection.execute(f"PRAGMA user_version = {version}")
    connection.execute("CREATE TABLE t(a)")
    connection.commit()
    connection.close()
    return (home / "x.db").read_bytes()


@pytest.mark.parametrize(
    ("manifest", "word"),
    [
        ({"schema": 99, "version": "9.9"}, "newer"),
        ({}, "not a backup"),
        ({"schema": 1, "files": ["archive.db"]}, "damaged"),
    ],
)
def test_what_is_no_backup_of_ours_is_refused(home, manifest, word):
    packed(home / "b.tar.gz", manifest)
    with pytest.raises(BadInput, match=word):
        run("restore", home / "b.tar.gz")


def test_an_archive_of_a_newer_version_is_refused_and_the_old_one_stays(home):
    fill(home, 1)
    content = archive_of_version(home, 99)
    packed(home / "b.tar.gz", {"schema": 1, "files": ["archive.db"], "made": ""}, **{"archive.db": content})
    with pytest.raises(BadInput, match="newer version"):
        run("restore", home / "b.tar.gz")
    assert values(home) == [1]


def test_a_file_that_wants_out_of_its_folder_is_left_alone(home):
    """Whoever made the file: only what a backup holds is taken from it."""
    manifest = {"schema": 1, "files": ["../../evil", "models/../../evil", "models/.."], "made": ""}
    packed(home / "b.tar.gz", manifest, **{"../../evil": b"x", "models/../../evil": b"x"})
    run("restore", home / "b.tar.gz")
    assert not list(home.rglob("evil"))


def test_a_link_is_no_file_of_a_backup(home):
    """Otherwise a file of the machine would be copied to where an operator shares models."""
    (home / "secret").write_text("x")
    manifest = json.dumps({"schema": 1, "files": ["models/a"], "made": ""}).encode()
    with tarfile.open(home / "b.tar.gz", "w:gz") as tar:
        about, link = tarfile.TarInfo("manifest.json"), tarfile.TarInfo("models/a")
        about.size, link.type, link.linkname = len(manifest), tarfile.SYMTYPE, str(home / "secret")
        tar.addfile(about, io.BytesIO(manifest))
        tar.addfile(link)
    with pytest.raises(BadInput, match="models/a is not a regular file"):
        run("restore", home / "b.tar.gz")


@pytest.mark.parametrize("files", [None, 5, "archive.db", {"a": 1}], ids=str)
def test_a_manifest_that_names_no_files_restores_none(home, files):
    packed(home / "b.tar.gz", {"schema": 1, "files": files})
    assert json.loads(run("restore", home / "b.tar.gz", "--json").stdout)["files"] == {}


def test_damaged_files_are_named(home):
    (home / "b.tar.gz").write_bytes(b"\x1f\x8b\x08garbage")
    with pytest.raises(BadInput, match=r"b\.tar\.gz"):
        run("restore", home / "b.tar.gz")
    with pytest.raises(BadInput, match=r"none\.tar\.gz"):
        run("restore", home / "none.tar.gz")


def test_restoring_twice_keeps_what_was_there_at_first(home):
    """The operator's own archive, which the first time has set aside."""
    fill(home, 1)
    run("backup", home / "b.tar.gz")
    fill(home, 2)
    for _ in range(2):
        run("restore", home / "b.tar.gz")
    assert values(home) == [1]
    kept = home / "data" / "sdnator" / "archive.db.before-restore"
    with closing(open_archive(f"sqlite://{kept}")) as driver:
        assert [item.value for item in driver.find({"dataKey": "a.b.c.d"})] == [1, 2]
    assert kept.with_name("archive.db.before-restore-2").exists()


def test_a_restore_that_fails_changes_nothing(home):
    """One file of two cannot be written: the other stays as it was, too, and nothing is left behind."""
    fill(home, 1)
    config = home / "config" / "sdnator" / "sdnator.toml"
    config.parent.mkdir(parents=True)
    config.write_text("")
    run("backup", home / "b.tar.gz")
    fill(home, 2)
    before = sorted(path.name for path in (home / "data" / "sdnator").iterdir())
    config.unlink()
    config.parent.rmdir()
    config.parent.write_text("in the way")
    with pytest.raises(PipelineError, match=r"sdnator\.toml"):
        run("restore", home / "b.tar.gz")
    assert sorted(path.name for path in (home / "data" / "sdnator").iterdir()) == before
    assert values(home) == [1, 2]


def test_what_belongs_to_the_old_archive_is_set_aside_even_without_it(home):
    """A -wal that stays would be taken for the new archive's."""
    fill(home, 1)
    run("backup", home / "b.tar.gz")
    archive = home / "data" / "sdnator" / "archive.db"
    archive.unlink()
    archive.with_name("archive.db-wal").write_bytes(b"old")
    run("restore", home / "b.tar.gz")
    assert archive.with_name("archive.db.before-restore-wal").read_bytes() == b"old"
    assert values(home) == [1]


def test_no_room_to_unpack_is_told_as_such(home):
    """A limit on the size of files stands for a full disk."""
    fill(home, 1)
    run("backup", home / "b.tar.gz")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(PipelineError, match=r"no room to unpack .* TMPDIR"):
            run("restore", home / "b.tar.gz")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("name", ["a#b", "a?b", "a%20b"])
def test_an_archive_in_a_folder_with_a_strange_name_is_backed_up(home, monkeypatch, name):
    """What has a meaning in a URL has none in a path."""
    monkeypatch.setenv("XDG_DATA_HOME", str(home / name))
    archive = home / name / "sdnator" / "archive.db"
    with closing(open_archive(f"sqlite://{quote(str(archive))}")) as driver:
        now = time.time_ns()
        driver.insert([Item("a.b.c.d", 1, now, now, "app", "instance", 1)])
    run("backup", home / "b.tar.gz")
    archive.unlink()
    run("restore", home / "b.tar.gz")
    with closing(open_archive(f"sqlite://{quote(str(archive))}")) as driver:
        assert [item.value for item in driver.find({"dataKey": "a.b.c.d"})] == [1]
