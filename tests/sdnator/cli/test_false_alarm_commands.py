"""`sdnator blocks false-alarm` against a running firewall: undone, taught, explained, taken back."""

import json

import pytest

from apps.evidence import TrainingState
from due import PRODUCER, Capability, Engine
from sdnator.cli.blocks_commands import blocks
from sdnator.errors import BadInput
from sdnator.testing.waiting import wait_for
from tests.apps.firewall.alerts import SECOND
from tests.apps.firewall.policy.test_sequential_test import evidence
from tests.sdnator.cli.test_blocks_commands import firewall as running_firewall
from tests.sdnator.cli.test_blocks_commands import run

firewall = running_firewall
TRAINING, EVIDENCE = "network.training.kitsune", "network.evidence.kitsune.targets"


@pytest.fixture
def kitsune(firewall):
    both, _, _ = firewall
    engine = Engine()
    engine.set_pubsub(both[1])
    engine.set_db(both[3])
    said = [Capability(key, delivery="reliable", archive="always") for key in (TRAINING, EVIDENCE)]
    engine.init("kitsune", PRODUCER, capabilities=said)
    state = TrainingState(packets=9, wanted=9, done=True, seconds=3_600.0, senders=20, event_time=SECOND)
    engine.write(TRAINING, state.to_value())
    yield engine
    engine.close()


def test_a_false_alarm_is_undone_explained_and_taken_back(firewall, kitsune):
    both, archive, _ = firewall
    kitsune.write(EVIDENCE, evidence(20.0, 100, "targets", service="tcp/445").to_value())

    def listed(*options: str):
        return json.loads(run(blocks, "list", "--json", *options, *archive))

    wait_for(listed)
    name = listed()[0]["id"]
    assert f"false alarm: sdnator blocks false-alarm {name}" in run(blocks, "why", name, *archive)
    answer = run(blocks, "false-alarm", name, "--reason", "the new backup", *both)
    assert "1 lifted; kitsune.targets of this sender counts a tenth" in answer
    wait_for(lambda: "the new backup" in run(blocks, "false-alarms", *archive))
    wait_for(lambda: not listed())
    why = run(blocks, "why", name, *archive)
    assert "was called a false alarm" in why
    assert "kitsune.targets of 192.168.2.108 on s1 port 1 about tcp/445 counts 0.1" in why
    with pytest.raises(BadInput, match="already"):
        run(blocks, "false-alarm", name, *both)
    assert "in full again" in run(blocks, "false-alarm", name, "--revoke", *both)
    wait_for(lambda: "no decision was called" in run(blocks, "false-alarms", *archive))
