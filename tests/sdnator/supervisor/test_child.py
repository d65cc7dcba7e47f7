"""Child processes: readiness, death, end."""

import json
import os
import signal

import pytest

from sdnator.errors import PipelineError
from sdnator.supervisor import Child


@pytest.fixture
def program(tmp_path, monkeypatch):
    """Write a module that `python -m` finds."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def write(source: str, **options: bool) -> Child:
        (tmp_path / "child_program.py").write_text(source)
        return Child("program", ["child_program"], tmp_path, **options)

    return write


def test_child_has_a_group_of_its_own_in_our_session(program):
    """Ctrl-C does not reach it, and processors are shared out among all parts alike."""
    child = program("import json, signal\nprint(json.dumps({'ready': True}), flush=True)\nsignal.pause()")
    try:
        child.wait_ready()
        assert (os.getpgid(child.pid), os.getsid(child.pid)) == (child.pid, os.getsid(0))
    finally:
        child.stop()


def test_ready_line_is_returned(program):
    """What the program says of itself reaches the caller."""
    child = program(
        "import json, signal\nprint(json.dumps({'ready': True, 'port': 7}), flush=True)\nsignal.pause()"
    )
    try:
        assert child.wait_ready() == {"ready": True, "port": 7}
        child.check()
    finally:
        child.stop()


def test_death_is_told_with_the_last_words(program):
    """An operator sees which part died, how, and why."""
    child = program("import sys\nprint('no such interface veth9', file=sys.stderr)\nsys.exit(3)")
    with pytest.raises(PipelineError, match=r"(?s)program ended with exit code 3.*veth9"):
        child.wait_ready()
    child.stop()


def test_death_by_a_signal_without_a_name_is_told(program):
    """Python knows two of the real-time signals by name; the others are numbers."""
    child = program("import os, signal\nos.kill(os.getpid(), signal.SIGRTMIN + 6)")
    with pytest.raises(PipelineError, match=f"program was killed by signal {signal.SIGRTMIN + 6}"):
        child.wait_ready()
    child.stop()


def test_silent_program_is_given_up(program):
    """A program that never gets ready does not hang the pipeline."""
    child = program("import signal\nsignal.pause()")
    try:
        with pytest.raises(PipelineError, match="not ready within"):
            child.wait_ready(seconds=0.3)
    finally:
        child.stop()
    with pytest.raises(ProcessLookupError):
        os.kill(child.pid, 0)


def test_ready_line_may_come_in_pieces(program):
    """A slow pipe does not break the JSON."""
    text = json.dumps({"ready": True})
    child = program(
        "import sys, time, signal\n"
        f"for c in {text!r}: sys.stdout.write(c); sys.stdout.flush()\n"
        "print(flush=True)\nsignal.pause()"
    )
    try:
        assert child.wait_ready() == {"ready": True}
    finally:
        child.stop()


def test_what_the_beats_tell_is_kept(program):
    child = program(
        "import json, os, signal, sys\nos.write(int(sys.argv[2]), b'..3;.17;.')\n"
        "print(json.dumps({'ready': True}), flush=True)\nsignal.pause()",
        heartbeat=True,
    )
    try:
        child.wait_ready()
        assert child.out_of_range == 0
        assert child.beaten()
        assert child.out_of_range == 17
        assert not child.beaten()
    finally:
        child.stop()
