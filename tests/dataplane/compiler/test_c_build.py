"""Compiling: once for each text, in a private place, and what happens where it cannot be done."""

import pytest

from dataplane.compiler import c_build
from dataplane.errors import CompilerError, DataplaneError
from dataplane.switch import Switch
from tests.dataplane.loading import features, frame

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


def test_without_a_compiler_auto_takes_python(monkeypatch):
    monkeypatch.setenv("CC", "/no/such/compiler")
    monkeypatch.setenv("PATH", "/no/such/directory")
    assert c_build.compiler() is None
    assert Switch(features(), backend="auto").backend == "python"
    with pytest.raises(CompilerError, match="no C compiler found"):
        Switch(features(), backend="c")


def test_a_compiler_that_fails_makes_auto_take_python(cache, monkeypatch, caplog):
    del cache
    monkeypatch.setenv("CC", "false")
    assert Switch(features(), backend="auto").backend == "python"
    assert "running generated Python" in caplog.text


def test_closed_switch_raises_instead_of_touching_freed_memory():
    switch = Switch(features(), backend="c")
    switch.close()
    switch.close()
    with pytest.raises(DataplaneError, match="closed"):
        switch.process(1, frame(0), 0)
    with pytest.raises(DataplaneError, match="closed"):
        switch.registers["I.cells"].read(0)
    with pytest.raises(DataplaneError, match="closed"):
        switch.tables["I.ports"].set_default("NoAction")
