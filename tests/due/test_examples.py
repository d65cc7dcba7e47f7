"""The examples are as short as promised and do what they say, with real processes."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np

from due import NO_WAIT, PUB_ONLY, Capability, RecordBatch
from tests.due.conftest import wait_for
from tests.requirements import require_program

EXAMPLES = Path(__file__).parents[2] / "examples"


def _lines(name: str, part: str) -> list[str]:
    text = (EXAMPLES / name).read_text()
    body = re.search(rf"# \[{part}\]\n(.*)# \[/{part}\]", text, re.DOTALL)
    assert body is not None
    return [line for line in body[1].splitlines() if line.strip() and not line.strip().startswith("#")]


def test_an_analyser_takes_fewer_than_ten_lines():
    assert len(_lines("analyser.py", "analyser")) < 10


def test_a_foreign_detector_is_wrapped_in_fewer_than_ten_lines():
    assert len(_lines("foreign_detector.py", "wrapper")) < 10


def test_a_detector_of_a_library_is_wrapped_in_at_most_ten_lines():
    assert len(_lines("river_detector.py", "wrapper")) <= 10


def test_the_node_client_has_at_most_150_lines():
    assert len((EXAMPLES / "client.mjs").read_text().splitlines()) <= 150


SAVING_OFTEN = """
import runpy, sys
from due import Engine
Engine.keep_state.__kwdefaults__["every"] = 0.2
runpy.run_path(sys.argv[1], run_name="__main__")
"""
"""Runs an example whose state is saved five times a second, instead of every five seconds."""


def _start(name: str, server, folder: Path, *runner: str) -> subprocess.Popen[str]:
    environment = {
        "DUE_UPDATES": server.url,
        "DUE_ARCHIVE": f"sqlite://{folder / 'a.db'}",
        "DUE_DIRECTORY": str(folder),
        "PYTHONPATH": str(EXAMPLES.parent),
    }
    return subprocess.Popen(
        [sys.executable, *runner, str(EXAMPLES / name)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
        text=True,
    )


def test_the_analyser_sees_alerts(server, make_engine, tmp_path):
    kitsune, received = make_engine("kitsune"), []
    kitsune.observe("due.heartbeat.WorstSenders").subscribe(
        lambda beat: received.append(beat.value["received"])
    )
    with _start("analyser.py", server, tmp_path) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        assert process.stdout.readline().startswith("Enter")
        for ip in ("10.0.0.1", "10.0.0.2", "10.0.0.1"):
            kitsune.write("network.anomaly.kitsune.alert", {"sender": {"ip": ip}}, [NO_WAIT, PUB_ONLY])
        # an item counts as received just before its callback: by the second beat that is done
        wait_for(lambda: received.count(3) >= 2)
        said, _ = process.communicate("\n", timeout=30)
    assert said.strip() == "[('10.0.0.1', 2), ('10.0.0.2', 1)]"


def test_totals_go_on_in_the_next_process(server, make_engine, tmp_path):
    climate = [Capability("house.climate.**", delivery="reliable")]
    thermometer = make_engine("thermometer", init={"capabilities": climate})
    reader = make_engine("reader", archive=f"sqlite://{tmp_path / 'a.db'}")

    def total() -> object:
        found = reader.get("house.total.counter.**", limit=1)
        return found[-1].value["state"] if found else 0

    for rounds in (1, 2):
        with _start("sharded_totals.py", server, tmp_path, "-c", SAVING_OFTEN) as process:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("Enter")
            for _ in range(10):
                thermometer.write("house.climate.thermometer.attic", 21.5, [PUB_ONLY])
            wait_for(lambda rounds=rounds: total() == 10 * rounds)
            process.communicate("\n", timeout=30)


def test_the_foreign_detector_scores(server, make_engine, tmp_path):
    controller = make_engine("p4runtime_ctrl")
    scores = []
    controller.observe("network.anomaly.foreign.score").subscribe(lambda item: scores.append(item.value))
    batch = RecordBatch({"length": np.array([60, 60, 1500])})
    with _start("foreign_detector.py", server, tmp_path) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("Enter")
        controller.write("network.packets.p4runtime_ctrl.s1.all", batch, [PUB_ONLY])
        wait_for(lambda: scores)
        process.communicate("\n", timeout=30)
    assert scores == [[0.0, 0.0, 960.0]]


def test_half_space_trees_score_what_is_unlike_what_they_learnt(server, make_engine, tmp_path):
    controller = make_engine("p4runtime_ctrl")
    scores = []
    controller.observe("network.anomaly.half_space_trees.score").subscribe(
        lambda item: scores.extend(item.value)
    )
    usual = RecordBatch({"length": np.tile([60, 80], 600), "tcp_dport": np.full(1200, 443)})
    odd = RecordBatch({"length": np.array([1500]), "tcp_dport": np.array([23])})
    with _start("river_detector.py", server, tmp_path) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("Enter")
        for batch in (usual, odd):
            controller.write("network.packets.p4runtime_ctrl.s1.all", batch, [PUB_ONLY])
            controller.flush()
        wait_for(lambda: len(scores) == 1201)
        process.communicate("\n", timeout=30)
    assert scores[-1] > 1.1 * max(scores[600:1200])


NODE = """
import { Due, encode, decode } from '%s'
const due = new Due(process.argv[2], 'node')
await due.init({ capabilities: [{ key: 'ex.node.out' }], interests: [{ key: 'ex.py.**' }], heartbeat: 0.1 })
await due.observe('ex.py.**', item => {
  due.write('ex.node.out', { echo: item.value, key: item.key, sequence: item.sequence })
  if (item.value === 'end') setTimeout(() => due.close(), 50)
})
console.log('ready')
"""


def test_a_node_app_registers_beats_observes_and_publishes(server, make_engine, tmp_path):
    node = require_program("node")
    script = tmp_path / "app.mjs"
    script.write_text(NODE % (EXAMPLES / "client.mjs"))
    engine = make_engine("python_side")
    got, registered, beats = [], [], []
    engine.observe("ex.node.*").subscribe(lambda item: got.append(item.value))
    engine.observe("due.registration.node").subscribe(lambda item: registered.append(item.value))
    engine.observe("due.heartbeat.node").subscribe(lambda item: beats.append(item.value))
    values = [None, True, 7, -7, 2**40, 1.5, "täxt", b"\x00\xff", [1, [2]], {"a": {"b": [None]}}, "end"]
    with subprocess.Popen([node, str(script), server.url], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        wait_for(lambda: len(beats) > 2)
        for number, value in enumerate(values):
            engine.write(f"ex.py.x{number}:n={number}", value, [PUB_ONLY])
        wait_for(lambda: len(got) == len(values))
        assert process.wait(20) == 0
    echoed = {item["key"]: item["echo"] for item in got}
    assert [echoed[f"ex.py.x{n}:n={n}"] for n in range(len(values))] == values
    assert registered[0]["capabilities"] == [{"key": "ex.node.out"}]
    wait_for(lambda: beats[-1]["state"] == "offline")
    assert json.dumps(registered[0])
