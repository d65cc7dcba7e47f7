"""Bad input gives one clear line and exit code 2, and no progress bar in front of it."""

import io
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner

from sdnator.cli.late_progress import LateProgress
from sdnator.cli.main import app
from sdnator.datasets.mirai_like import MiraiLikeOptions, make
from sdnator.errors import BadInput

PCAP_HEADER = b"\xd4\xc3\xb2\xa1\x02\x00\x04\x00" + bytes(8) + b"\xff\xff\x00\x00\x01\x00\x00\x00"
CONTENTS: dict[str, tuple[bytes | None, str]] = {
    "missing": (None, "no such file"),
    "empty": (b"", "empty"),
    "script": (b"#!/bin/sh\nexit 0\n" * 10, "not a capture"),
    "without packets": (PCAP_HEADER, "no packets"),
    "truncated header": (PCAP_HEADER[:10], "the file header is incomplete"),
    "truncated packet": (PCAP_HEADER + bytes(8) + b"\x40\0\0\0\x40\0\0\0" + bytes(9), "no complete packet"),
}


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Standard error counts as a terminal, on which bars are drawn."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm-256color")


def told(*words: object) -> str:
    """The text of a command's BadInput; nothing else is printed, which the command line does with exit code 2."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert isinstance(result.exception, BadInput), result.output
    assert result.exception.exit_code == 2
    assert result.output == ""
    text = str(result.exception)
    assert "\n" not in text
    return text


def commands(path: Path, folder: Path) -> dict[str, list[object]]:
    """The commands that read a capture and show progress."""
    return {
        "replay": ["replay", path],
        "detect": ["detect", path, "--out", folder / "out"],
        "splice": ["dataset", "splice", path, path, folder / "both.pcap"],
        "queries run": ["queries", "run", "syn_flood", "--capture", path],
    }


@pytest.mark.parametrize("command", ["detect", "queries run", "replay", "splice"])
@pytest.mark.parametrize("content", sorted(CONTENTS))
def test_a_useless_capture_is_told_without_progress(
    terminal: None, tmp_path: Path, command: str, content: str
) -> None:
    given, words = CONTENTS[content]
    path = tmp_path / "given.pcap"
    if given is not None:
        path.write_bytes(given)
    text = told(*commands(path, tmp_path)[command])
    assert str(path) in text
    assert words in text


@pytest.mark.parametrize("command", ["detect", "queries run", "replay", "splice"])
@pytest.mark.parametrize(
    ("path", "words"), [("/proc/self", "is a folder"), ("/proc/self/mem", "cannot be read")]
)
def test_folders_and_unreadable_files_are_told_without_progress(
    terminal: None, tmp_path: Path, command: str, path: str, words: str
) -> None:
    text = told(*commands(Path(path), tmp_path)[command])
    assert path in text
    assert words in text


@pytest.mark.parametrize("content", sorted(CONTENTS))
def test_a_useless_table_is_told_without_progress(terminal: None, tmp_path: Path, content: str) -> None:
    given, _ = CONTENTS[content]
    path = tmp_path / "given.tsv"
    if given is not None:
        path.write_bytes(given)
    assert str(path) in told("dataset", "rebuild", path, tmp_path / "out.pcap")


@pytest.mark.parametrize("command", ["detect", "replay"])
def test_wrong_labels_are_told_before_the_capture_is_read(
    terminal: None, tmp_path: Path, command: str
) -> None:
    capture = tmp_path / "home.pcap"
    make(MiraiLikeOptions(seed=9, benign_seconds=200, attack_seconds=0), capture)
    missing = tmp_path / "nosuch.csv"
    assert str(missing) in told(*commands(capture, tmp_path)[command], "--labels", missing)


def test_a_short_capture_is_told_without_progress(terminal: None, tmp_path: Path) -> None:
    capture = tmp_path / "home.pcap"
    make(MiraiLikeOptions(seed=9, benign_seconds=20, attack_seconds=0), capture)
    assert "--train" in told("replay", capture)


def test_an_output_that_is_a_folder_is_told_without_progress(terminal: None, tmp_path: Path) -> None:
    capture = tmp_path / "home.pcap"
    make(MiraiLikeOptions(seed=9, benign_seconds=20, attack_seconds=0), capture)
    assert "cannot be written (Is a directory)" in told("dataset", "splice", capture, capture, tmp_path)


@pytest.mark.parametrize(
    "words",
    [
        ("get", "a.b", "--archive"),
        ("blocks", "list", "--archive"),
        ("incidents", "list", "--archive"),
        ("archive", "export", "--parquet", "pq", "--archive"),
    ],
)
@pytest.mark.parametrize("name", ["", "nosuch.db", "x" * 300])
def test_an_archive_that_cannot_be_is_told(tmp_path: Path, words: tuple[str, ...], name: str) -> None:
    assert "there is no" in told(*words, f"sqlite://{tmp_path / name}")


@pytest.mark.parametrize(
    ("words", "told_of"),
    [
        (("restore", "{}"), "no such file; check the path of the backup"),
        (
            ("queries", "add", "{}"),
            "cannot be read (No such file or directory); give a text file with queries",
        ),
        (("queries", "test", "{}", "--capture", "{}"), "cannot be read (No such file or directory)"),
        (("config", "show", "{}"), "`sdnator config example` prints a file to begin with"),
        (("plan", "--pps", "1000", "--costs", "{}"), "`sdnator plan --measure` writes one"),
    ],
)
def test_a_file_that_is_not_there_is_told(tmp_path: Path, words: tuple[str, ...], told_of: str) -> None:
    missing = tmp_path / "nosuch"
    text = told(*(word.format(missing) for word in words))
    assert str(missing) in text
    assert told_of in text


def test_a_report_folder_with_an_impossible_name_is_told(terminal: None, tmp_path: Path) -> None:
    capture = tmp_path / "home.pcap"
    make(MiraiLikeOptions(seed=9, benign_seconds=20, attack_seconds=0), capture)
    assert "--report" in told("replay", capture, "--train", 100, "--report", tmp_path / ("x" * 300))


@pytest.mark.parametrize("terminal", [False, True])
@pytest.mark.parametrize("steps", [0, 3])
def test_bars_go_when_the_input_is_bad(steps: int, *, terminal: bool) -> None:
    console = Console(file=io.StringIO(), force_terminal=terminal, width=60)
    with pytest.raises(BadInput):
        _read_and_fail(LateProgress(console=console), steps)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    if terminal and steps:
        assert text.endswith("\x1b[2K")  # the line of the bar is erased
    else:
        assert text == ""


def test_bars_stay_when_all_is_done() -> None:
    console = Console(file=io.StringIO(), force_terminal=False, width=60)
    with LateProgress(console=console) as bars:
        _read(bars, 3)
    assert "reading" in console.file.getvalue()  # type: ignore[attr-defined]


def _read_and_fail(bars: LateProgress, steps: int) -> None:
    with bars:
        _read(bars, steps)
        raise BadInput("labels of another capture")


def _read(bars: LateProgress, steps: int) -> None:
    task = bars.add_task("reading", total=10)
    for step in range(steps):
        bars.update(task, completed=step)
