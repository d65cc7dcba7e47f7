"""Times of a capture replace a switch's clock; a file that holds none is refused with a sentence."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from apps.p4runtime_ctrl.errors import CaptureTimesError
from apps.p4runtime_ctrl.southbound.capture_times import CaptureTimes

TIMES_US = 1_700_000_000_000_000 + np.array([0, 10, 10, 50, 70])


def test_first_frame_that_comes_is_the_first_of_the_capture():
    """A switch that has run before goes on counting; frames that are missing do not shift the others."""
    times = CaptureTimes(TIMES_US)
    assert times.of(np.array([], ">u4")).tolist() == []
    assert times.of(np.array([1000, 1001], ">u4")).tolist() == TIMES_US[:2].tolist()
    assert times.of(np.array([1004], ">u4")).tolist() == TIMES_US[4:].tolist()


def test_frames_of_others_have_a_time_of_the_capture():
    times = CaptureTimes(TIMES_US)
    assert times.of(np.array([5, 4, 100], np.uint64)).tolist() == TIMES_US[[0, 0, 4]].tolist()


def test_saved_times_are_read_back(tmp_path):
    np.save(tmp_path / "times.npy", TIMES_US)
    found = CaptureTimes.load(tmp_path / "times.npy").of(np.arange(5, dtype=np.uint64))
    assert (found.dtype, found.tolist()) == (np.int64, TIMES_US.tolist())


@pytest.mark.parametrize(
    ("held", "text"),
    [
        (np.array([], np.int64), "holds 0 times; it must hold 1"),
        (TIMES_US.astype(float), "not a list of int64"),
        (TIMES_US.reshape(1, 5), "not a list of int64"),
        (np.array([-1]), "before 1970"),
        (np.array([1 << 62]), "after 2116"),
        (np.array(["x"], object), "cannot be read"),
    ],
)
def test_wrong_times_are_refused(tmp_path, held, text):
    np.save(tmp_path / "times.npy", held, allow_pickle=True)
    with pytest.raises(CaptureTimesError, match=text):
        CaptureTimes.load(tmp_path / "times.npy")


@pytest.mark.parametrize(
    "head", [b"{'descr': ',i8', 'fortran_order': False, 'shape': (5,), }", b"{'descr': '<i8', ((("]
)
def test_a_head_that_is_no_python_is_refused(tmp_path, head):
    """numpy parses it, and lets the parser's own errors out."""
    (tmp_path / "times.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head)
    with pytest.raises(CaptureTimesError, match="cannot be read"):
        CaptureTimes.load(tmp_path / "times.npy")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=300))
def test_any_bytes_are_read_or_refused(tmp_path, data):
    (tmp_path / "times.npy").write_bytes(data)
    with pytest.raises(CaptureTimesError):
        CaptureTimes.load(tmp_path / "times.npy")
