"""The app as a process: batches in, one score item each and the published scores out, an orderly end."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from apps.kitsune.model_instructions import ANSWER
from apps.kitsune.service import (
    ALERT,
    CAPABILITIES,
    DRIFT_KEY,
    EVIDENCE_KEY,
    INTERESTS,
    PACKETS,
    SCORE,
    TALKERS_KEY,
    TRAINING_KEY,
)
from due import CONSUMER, NO_WAIT, PRODUCER, Capability, Engine, Interest
from due.drivers.embedded_redis import EmbeddedServer
from sdnator.testing.packet_rows import blank, part
from tests.apps.kitsune.real_packets import real
from tests.apps.kitsune.test_afterimage import require_reference_arithmetic
from tests.requirements import shared_data

KEY = "network.packets.p4runtime_ctrl.s1.all"
DEADLINE_S = 60.0


def wait_for(condition):
    end = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.01)


@pytest.fixture
def server(tmp_path):
    with EmbeddedServer(tmp_path / "server") as running:
        yield running


def start(server, tmp_path, **settings):
    (tmp_path / "settings.json").write_text(json.dumps(settings))
    command = [sys.executable, "-m", "apps.kitsune.service", "--updates", server.url]
    command += [
        "--archive",
        f"sqlite:///{tmp_path}/archive.db",
        "--settings",
        str(tmp_path / "settings.json"),
    ]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ
    )


@pytest.fixture
def controller(server, tmp_path):
    engine = Engine()
    engine.set_pubsub(server.url)
    engine.set_db(f"sqlite:///{tmp_path}/archive.db")
    engine.init(
        "p4runtime_ctrl",
        PRODUCER | CONSUMER,
        interests=(Interest(SCORE), Interest(ALERT)),
        capabilities=(Capability(KEY, delivery="reliable"),),
    )
    yield engine
    engine.close()


def test_scores_and_alerts_of_a_stream(server, controller, tmp_path):
    require_reference_arithmetic()
    batch, extra = real(3_000), 40
    wanted = np.load(shared_data("kitsune/scores.npz"))["first3000_fm500_ad1500_m10"]
    process = start(
        server,
        tmp_path,
        fm_grace=500,
        ad_grace=1500,
        mode="reference",
        threshold=1e-9,
        save_model=str(tmp_path / "model.npz"),
    )
    try:
        assert json.loads(process.stdout.readline())["app"] == "kitsune"
        scores, alerts = [], []
        controller.observe(SCORE).subscribe(lambda item: scores.append(item.value))
        controller.observe(ALERT).subscribe(lambda item: alerts.append(item.value))
        wait_for(lambda: controller.wanted(KEY))
        for at in range(0, 3_000, 250):
            controller.write(KEY, part(batch, at, at + 250), [NO_WAIT])
        controller.write(KEY, blank(extra, time_us=batch["time_us"][-1:].repeat(extra)), [NO_WAIT])
        wait_for(lambda: sum(item["count"] for item in scores) == 3_000 + extra)
        assert [item["count"] for item in scores] == [250] * 12 + [extra]
        assert [item["trained"] for item in scores][-1] == 2_001
        assert {item["switch"] for item in scores} == {"s1"}
        found = np.concatenate([item["score"] for item in scores])[:3_000]
        state = np.concatenate([item["state"] for item in scores])[:3_000]
        assert np.array_equal(np.flatnonzero(state), np.arange(2_001, 3_000))
        assert np.allclose(found[2_001:], wanted[2_001:], rtol=1e-12, atol=0)
        open_until = (int(batch["time_us"][-1]) // 1_000_000 + 1) * 10**9
        assert open_until not in [alert["event_time"] for alert in alerts]
        process.send_signal(signal.SIGTERM)
        assert process.wait(DEADLINE_S) == 0
        archived = [item.value for item in controller.get(ALERT)]
        assert archived[-1]["event_time"] == open_until, "the open second is closed at the stop"
        wait_for(lambda: len(alerts) == len(archived))
        assert [alert["id"] for alert in alerts] == [alert["id"] for alert in archived]
        assert len(controller.get(SCORE)) == 13
        assert (tmp_path / "model.npz").exists()
    finally:
        process.kill()
        process.communicate()


def test_scores_are_published_only_where_the_settings_say_so(server, controller, tmp_path):
    process = start(server, tmp_path, archive_scores=False)
    try:
        assert json.loads(process.stdout.readline())["app"] == "kitsune"
        scores = []
        controller.observe(SCORE).subscribe(lambda item: scores.append(item.value))
        wait_for(lambda: controller.wanted(KEY))
        controller.write(KEY, blank(10), [NO_WAIT])
        wait_for(lambda: sum(item["count"] for item in scores) == 10)
        process.send_signal(signal.SIGTERM)
        assert process.wait(DEADLINE_S) == 0
        assert not controller.get(SCORE)
        assert controller.get(TRAINING_KEY), "what is told of training is archived"
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize(
    ("settings", "text"),
    [({"no_such_option": 1}, "no_such_option"), ({"load_model": "/nowhere/model.npz"}, "no such model")],
)
def test_wrong_settings_end_with_a_sentence(server, tmp_path, settings, text):
    process = start(server, tmp_path, **settings)
    out, errors = process.communicate(timeout=DEADLINE_S)
    assert process.returncode != 0
    assert out == ""
    assert text in errors
    assert "Traceback" not in errors


def test_declares_what_it_does():
    assert Interest(PACKETS) in INTERESTS
    assert {each.key for each in CAPABILITIES} == {
        *(SCORE, ALERT, f"{EVIDENCE_KEY}.*", TRAINING_KEY),
        *(DRIFT_KEY, ANSWER, f"{TALKERS_KEY}.*"),
    }
    kept = [c for c in CAPABILITIES if c.key != f"{TALKERS_KEY}.*"]
    assert all(c.delivery == "reliable" and c.archive == "always" for c in kept)
