"""What is backed up comes back, what was there is kept, and what cannot be read changes nothing."""

import io
import json
import sqlite3
import tarfile
import time

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
