"""What a replay drops depends on the capture alone: neither the window nor a busy machine changes it."""

import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest

from sdnator.datasets.mirai_like import MiraiLikeOptions, make
from sdnator.replay import run
from sdnator.replay.loop import ReplayOptions
from sdnator.replay.packet_accounting import PacketState

TRAINING = {"fm_grace": 500, "ad_grace": 4_500}


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory):
    """Four minutes of benign traffic, twenty seconds of an attack."""
    path = tmp_path_factory.mktemp("short") / "short.pcap"
    make(MiraiLikeOptions(seed=4, benign_seconds=240, attack_seconds=20), path)
    return run.prepare(path, None, ReplayOptions(**TRAINING))[0]


@contextmanager
def load(processes):
    """Processes that compute beside the replay."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]
    try:
        yield
    finally:
        for each in busy:
            each.kill()
            each.wait()


def replayed(surveyed, window, processes):
    options = ReplayOptions(**TRAINING, window=window, reproducible=True)
    with load(processes):
        outcome = run.run(surveyed, None, options, mitigate=True, both=False)
    result, found = outcome.reported, run.figures(outcome)
    decisions = [(each.id, each.action, each.event_time, each.expires) for each in result.decisions]
    blocks = [(each["id"], each["in_flight"], each["passed_in_flight"]) for each in found["blocks"]]
    return result.flight, decisions, blocks, found["passed_in_flight"]


def test_two_replays_drop_the_same_packets(surveyed):
    """Window 16 on an idle machine, window 4,096 on a busy one."""
    few, decided, blocks, passed = replayed(surveyed, 16, 0)
    many, *same = replayed(surveyed, 4_096, 2)
    assert few.count(PacketState.DROPPED) > 0
    assert same == [decided, blocks, passed]
    np.testing.assert_array_equal(many.state, few.state)
    np.testing.assert_allclose(many.score, few.score, rtol=1e-9)
