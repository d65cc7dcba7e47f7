"""The spool keeps frames in order and within its size, over crashes, and says what did not fit."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from due.codec import pack
from due.drivers.spool import DiskSpool
from due.errors import BackendError
from due.messages import Item, PackedFrame


def frame(n: int, size: int = 10, count: int = 2) -> PackedFrame:
    return pack([Item("a", bytes(size), n, n, "app", "i", n * count + k) for k in range(count)])


def test_first_in_first_out(tmp_path: Path) -> None:
    spool = DiskSpool(tmp_path, 1 << 20)
    frames = [frame(n) for n in range(5)]
    assert spool.put(frames[:3]) == 0
    assert spool.put(frames[3:]) == 0
    assert len(spool) == 5
    assert spool.take(2) == frames[:2]
    assert spool.take(2) == frames[:2], "taking does not remove"
    spool.done(2)
    assert spool.take(10) == frames[2:]
    spool.done(3)
    assert (spool.take(1), len(spool)) == ([], 0)
    spool.close()
    spool.close()


def test_what_does_not_fit_is_told_in_items(tmp_path: Path) -> None:
    spool = DiskSpool(tmp_path, 10_000)
    assert spool.put([frame(n, 1000) for n in range(10)]) == 12
    kept = len(spool)
    assert kept == 4
    spool.done(2)
    assert spool.put([frame(99, 1000)]) == 0
    assert spool.take(9)[-1].first_timestamp == 99
    spool.close()


def test_it_outlives_its_process(tmp_path: Path) -> None:
    program = """
import os, signal, sys
from pathlib import Path
from tests.due.drivers.test_spool import frame
from due.drivers.spool import DiskSpool
spool = DiskSpool(Path(sys.argv[1]), 1 << 20)
spool.put([frame(n) for n in range(7)])
spool.done(3)
os.kill(os.getpid(), signal.SIGKILL)
"""
    root = Path(__file__).parents[3]
    environment = os.environ | {"PYTHONPATH": str(root)}
    ended = subprocess.run([sys.executable, "-c", program, str(tmp_path)], env=environment, check=False)
    assert ended.returncode == -signal.SIGKILL
    spool = DiskSpool(tmp_path, 1 << 20)
    assert spool.take(10) == [frame(n) for n in range(3, 7)]
    spool.close()


def test_a_file_that_is_no_spool_is_refused(tmp_path: Path) -> None:
    (tmp_path / "spool.db").write_bytes(b"something else" * 100)
    with pytest.raises(BackendError, match=r"spool\.db"):
        DiskSpool(tmp_path, 1 << 20)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.lists(st.tuples(st.sampled_from(["put", "take", "done", "reopen"]), st.integers(0, 4)), max_size=20)
)
def test_it_behaves_like_a_list(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, int]]
) -> None:
    folder = tmp_path_factory.mktemp("spool")
    spool, model = DiskSpool(folder, 1 << 20), list[PackedFrame]()
    for number, (step, count) in enumerate(steps):
        if step == "put":
            frames = [frame(number * 10 + n) for n in range(count)]
            assert spool.put(frames) == 0
            model += frames
        elif step == "take":
            assert spool.take(count) == model[:count]
        elif step == "done":
            spool.done(count)
            del model[:count]
        else:
            spool.close()
            spool = DiskSpool(folder, 1 << 20)
        assert len(spool) == len(model)
    spool.close()
