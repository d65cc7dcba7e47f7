"""Compiling: once for each text, in a private place, and what happens where it cannot be done."""

import os
import re
import tempfile
from pathlib import Path

import pytest

from dataplane.compiler import c_build, sandboxed_cc
from dataplane.errors import CompilerError, DataplaneError
from dataplane.v1model.switch import Switch
from sdnator.testing.switch_traffic import frame
from tests.dataplane.loading import features

_TEXT = "int answer(void) { return 42; }\n"


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "sdnator" / "dataplane"


def test_a_text_is_compiled_once(cache):
    _, first = c_build.compiled_library(_TEXT, "int answer(void);")
    assert first.answer() == 42
    files = list(cache.iterdir())
    assert [f.suffix for f in files] == [".so"], "nothing else is left"
    made = files[0].stat().st_mtime_ns
    c_build.compiled_library(_TEXT, "int answer(void);")
    assert files[0].stat().st_mtime_ns == made
    assert cache.stat().st_mode & 0o077 == 0


def test_an_open_cache_is_closed_to_others(cache):
    cache.mkdir(parents=True)
    cache.chmod(0o777)
    c_build.compiled_library(_TEXT, "int answer(void);")
    assert cache.stat().st_mode & 0o077 == 0


def test_without_a_place_to_keep_it_the_library_still_runs(monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/no-such-place")
    _, made = c_build.compiled_library(_TEXT, "int answer(void);")
    assert made.answer() == 42


@pytest.mark.usefixtures("cache")
def test_refused_text_is_reported():
    with pytest.raises(CompilerError, match="refused the generated C"):
        c_build.compiled_library("no C at all", "int answer(void);")


def recorded(tmp_path, monkeypatch, script):
    """A compiler that says what it is and may do, and then compiles, or does `script` instead."""
    said, real = tmp_path / "said", c_build.compiler()
    said.touch()
    tmp_path.chmod(0o711)
    said.chmod(0o666)
    made = tmp_path / "cc"
    report = f'(id -u; pwd; stat -c %a .; env; ulimit -a; cat /proc/net/route; echo "$@") > {said}'
    script = script or f'exec {real} "$@"'
    made.write_text(f"#!/bin/sh\n{report}\n{script}\n")
    made.chmod(0o755)
    monkeypatch.setenv("CC", str(made))
    return said


@pytest.fixture
def reachable():
    """A folder that other users get to: pytest's own are closed."""
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def test_the_compiler_has_no_rights_or_secrets_of_ours(cache, reachable, monkeypatch):
    monkeypatch.setenv("A_SECRET", "of ours")
    said = recorded(reachable, monkeypatch, "")
    _, made = c_build.compiled_library(_TEXT, "int answer(void);")
    assert made.answer() == 42
    text = said.read_text()
    user, folder, mode = text.splitlines()[:3]
    assert ("of ours" in text, mode, Path(folder).exists()) == (False, "700", False)
    assert int(user) != 0
    assert (int(user) == os.getuid()) == (os.getuid() != 0)
    for name, most in (("time", sandboxed_cc.CPU_S), ("memory", sandboxed_cc.MEMORY_BYTES >> 10)):
        assert re.search(rf"{name}\b.*\b{most}\n", text), text
    assert [f.stat().st_mode & 0o777 for f in cache.iterdir()] == [0o600]


@pytest.mark.usefixtures("cache")
@pytest.mark.parametrize(
    ("script", "text"),
    [
        ("ln -s /etc/passwd switch.so", "no switch.so"),
        ("mkfifo switch.so", "no plain file|not a plain file"),
        ("echo nonsense > switch.so", "is not a library"),
        ("true", "no switch.so"),
    ],
)
def test_what_is_no_library_is_not_loaded(reachable, monkeypatch, script, text):
    recorded(reachable, monkeypatch, script)
    with pytest.raises(CompilerError, match=text):
        c_build.compiled_library(_TEXT, "int answer(void);")


@pytest.mark.usefixtures("cache")
def test_a_compiler_that_does_not_end_is_ended(reachable, monkeypatch):
    recorded(reachable, monkeypatch, "sleep 1000")
    monkeypatch.setattr(sandboxed_cc, "TIMEOUT_S", 0.5)
    with pytest.raises(CompilerError, match="did not finish within"):
        c_build.compiled_library(_TEXT, "int answer(void);")


def test_a_library_that_others_could_have_written_is_made_again(cache):
    c_build.compiled_library(_TEXT, "int answer(void);")
    (file,) = cache.iterdir()
    file.chmod(0o666)
    before = file.stat().st_mtime_ns
    c_build.compiled_library(_TEXT, "int answer(void);")
    assert file.stat().st_mode & 0o777 == 0o600
    assert file.stat().st_mtime_ns > before


def test_a_link_in_place_of_the_cache_is_not_followed(tmp_path, cache):
    cache.parent.mkdir()
    (tmp_path / "elsewhere").mkdir()
    cache.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="not a folder"):
        c_build.cache_directory()


def test_without_a_compiler_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setenv("CC", "/no/such/compiler")
    monkeypatch.setenv("PATH", "/no/such/directory")
    assert c_build.compiler() is None
    with pytest.raises(CompilerError, match=r"no C compiler found .* install gcc"):
        Switch(features())


def test_a_compiler_that_fails_is_an_error(cache, monkeypatch):
    del cache
    monkeypatch.setenv("CC", "false")
    with pytest.raises(CompilerError):
        Switch(features())


def test_closed_switch_raises_instead_of_touching_freed_memory():
    switch = Switch(features())
    switch.close()
    switch.close()
    with pytest.raises(DataplaneError, match="closed"):
        switch.process(1, frame(0), 0)
    with pytest.raises(DataplaneError, match="closed"):
        switch.registers["I.cells"].read(0)
    with pytest.raises(DataplaneError, match="closed"):
        switch.tables["I.ports"].set_default("NoAction")
