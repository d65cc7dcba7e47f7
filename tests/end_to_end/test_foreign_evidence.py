"""A detector of a library becomes a source of evidence: the operator's line admits it, and a block follows."""

import json
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from apps.evidence import TrainingState
from apps.firewall.settings import Settings
from due import CONSUMER, PRODUCER, PUB_ONLY, Capability, Engine, Options
from due.drivers.embedded_redis import EmbeddedServer
from sdnator.config import config_file
from sdnator.supervisor import Child
from sdnator.testing.packet_rows import blank
from sdnator.testing.waiting import wait_for

ROOT = Path(__file__).parents[2]
PACKETS = "network.packets.p4runtime_ctrl.s1.all"
TRAINING = "network.training.kitsune"
FOUND = "network.evidence.half_space_trees.odd_packets"
START_US = 1_700_000_000_000_000
LAPTOP, CAMERA = 0x5CCF7F000001, 0x5CCF7F000002


def packets(first_s, seconds, mac, length, port):
    """Three packets a second."""
    count = 3 * seconds
    return blank(
        count,
        time_us=START_US + first_s * 1_000_000 + np.arange(count) * 333_333,
        arrival=np.arange(count) + 3 * first_s,
        port=np.full(count, 1),
        eth_src=np.full(count, mac),
        length=np.resize(length, count),
        tcp_dport=np.full(count, port),
    )


@pytest.fixture
def backends(tmp_path):
    with EmbeddedServer(tmp_path / "updates") as server:
        yield server.url, f"sqlite:///{tmp_path / 'archive.db'}"


def engine(backends, app, *keys):
    made = Engine(Options(coordinated=False))
    made.set_pubsub(backends[0])
    made.set_db(backends[1])
    said = [Capability(key, delivery="reliable") for key in keys]
    made.init(app, PRODUCER | CONSUMER, capabilities=said)
    return made


def firewall_with(toml, backends, tmp_path):
    """The firewall with the section of an operator's `sdnator.toml`."""
    (tmp_path / "sdnator.toml").write_text(toml)
    section = config_file.load(tmp_path / "sdnator.toml").section("firewall")
    msgspec.convert(section, Settings)
    (tmp_path / "firewall.json").write_text(json.dumps(section))
    places = ("--updates", backends[0], "--archive", backends[1])
    command = ["apps.firewall.service", *places, "--settings", str(tmp_path / "firewall.json")]
    return Child("firewall", command, tmp_path)


@pytest.mark.parametrize(
    ("toml", "blocked"),
    [('[firewall]\nevidence_apps = ["half_space_trees"]\n', ["5c:cf:7f:00:00:02"]), ("[firewall]\n", [])],
    ids=["admitted", "not admitted"],
)
def test_an_app_that_the_operator_admits_leads_to_a_block(toml, blocked, backends, tmp_path):
    """Ten minutes of learning, then a camera sends what nobody has sent: it is blocked, the laptop is not."""
    places = {"DUE_UPDATES": backends[0], "DUE_ARCHIVE": backends[1], "DUE_DIRECTORY": str(tmp_path)}
    firewall = firewall_with(toml, backends, tmp_path)
    example = [sys.executable, str(ROOT / "examples" / "river_evidence.py"), "600"]
    process = subprocess.Popen(
        example,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=places | {"PYTHONPATH": str(ROOT)},
    )
    controller, kitsune = engine(backends, "p4runtime_ctrl"), engine(backends, "kitsune", TRAINING)
    decisions, found = [], []
    controller.observe("network.block.firewall.*").subscribe(lambda item: decisions.append(item.value))
    controller.observe(FOUND).subscribe(lambda item: found.append(item.value))
    try:
        firewall.wait_ready()
        assert process.stdout is not None
        assert process.stdout.readline().startswith("Enter")
        state = TrainingState(
            packets=9, wanted=9, done=True, seconds=3_600.0, senders=20, event_time=START_US * 1_000
        )
        kitsune.write(TRAINING, state.to_value())
        kitsune.flush()
        controller.write(PACKETS, packets(0, 600, LAPTOP, [60, 80, 90], 443), [PUB_ONLY])
        controller.write(PACKETS, packets(600, 10, LAPTOP, [60, 80, 90], 443), [PUB_ONLY])
        controller.write(PACKETS, packets(610, 5, CAMERA, [1_500], 23), [PUB_ONLY])
        controller.flush()
        wait_for(lambda: len(found) == 5)
        assert {each["sender"]["mac"] for each in found} == {"5c:cf:7f:00:00:02"}
        if blocked:
            wait_for(lambda: decisions)
            assert "half_space_trees" in decisions[0]["evidence"][0]["key"]
            assert [each["source"] for each in decisions[0]["grounds"]] == ["half_space_trees.odd_packets"]
        process.communicate("\n", timeout=60)
    finally:
        firewall.stop()
        process.kill()
        process.wait()
        controller.close()
        kitsune.close()
    # all that a firewall has decided is archived when it has stopped
    archive = engine(backends, "reader")
    stored = [item.value["target"]["address"] for item in archive.get("network.block.firewall.*")]
    archive.close()
    assert stored == blocked
