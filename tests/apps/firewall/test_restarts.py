"""Real processes: what is decided stays decided over restarts of firewall, controller and switch."""

import json
import time
from contextlib import redirect_stdout
from io import StringIO
from itertools import count

import pytest
from typer.testing import CliRunner

from apps.messages import Instruction
from due import Capability
from due.errors import UpdatesUnavailable
from sdnator.cli.blocks_commands import blocks
from sdnator.cli.switch_commands import tables
from sdnator.errors import PipelineError
from sdnator.testing.controller_run import ControllerRun
from sdnator.testing.waiting import wait_for

SECONDS = 120.0
INSTRUCTION = "network.instruction.operator.firewall"
SETTINGS = {"guard": ["10.0.0.1:80"], "rules": {"allow": ["10.0.0.9"]}, "detect": False}
EVERYTHING = {"allow": 1, "block": 1, "block_mac": 1, "block_src": 1, "known_sources": 1, "protect": 1}
LEFT = {"allow": 1, "known_sources": 1, "protect": 1}


@pytest.fixture
def stage(tmp_path):
    with ControllerRun(tmp_path) as made:
        yield made


def entries(stage) -> dict[str, int]:
    """Entries by table; empty while the switch or its program is away."""
    text = StringIO()
    try:
        with redirect_stdout(text):
            tables(stage.target.address, insecure=True, as_json=True)
    except PipelineError:
        return {}
    names = [
        row["table"].removeprefix("ingress.")
        for row in json.loads(text.getvalue())["entries"]
        if not row["default"]
    ]
    return {name: names.count(name) for name in sorted(EVERYTHING) if name in names}


def reaches(stage, wanted: dict[str, int]) -> None:
    wait_for(lambda: entries(stage) == wanted, SECONDS, lambda: f"{entries(stage)}\n{stage.log()[-2000:]}")


def decide(engine) -> None:
    """A block of each kind by hand."""
    for subject in ("192.0.2.66", "198.51.100.0/24", "02:00:00:00:00:66@1"):
        said = Instruction(id=subject, verb="block", subject=subject, seconds=36_000)
        engine.write(INSTRUCTION, said.to_value())
    engine.flush(SECONDS)


def shake_hands(adapter) -> None:
    """A client becomes known."""
    handshake = {"source": "10.3.0.1", "service": "10.0.0.1", "port": 80, "at": 1}
    adapter.write("network.handshake.sonata.tcp", handshake)
    adapter.flush(SECONDS)


def panic_without_redis(stage) -> None:
    """The switch is clear, and stays so when its controller has taken its place again."""
    stage.server.kill()
    taken = stage.log().count("primary;")
    arguments = [
        "panic",
        "--direct",
        "--archive",
        stage.archive,
        "--switch",
        stage.target.address,
        "--insecure",
    ]
    done = CliRunner().invoke(blocks, arguments)
    assert done.exception is None, done.output
    wait_for(lambda: stage.log().count("primary;") > taken, SECONDS, stage.log)
    reaches(stage, LEFT)


def redis_starts(stage) -> bool:
    """A busy machine may need a second attempt."""
    try:
        stage.server.start()
    except UpdatesUnavailable:
        stage.server.kill()
        return False
    return True


def firewall_knows(engine) -> None:
    """Redis is back, and the firewall has read of the panic in the archive."""
    answers: list[str] = []
    tries = count()
    key = "network.answer.firewall.operator"
    engine.observe(key).subscribe(lambda item: answers.append(item.value["text"]))

    def is_lifted() -> bool:
        again = Instruction(id=f"again{next(tries)}", verb="unblock", subject="02:00:00:00:00:66")
        engine.write(INSTRUCTION, again.to_value())
        time.sleep(0.2)
        return any("no block, guard or rate limit has" in text for text in answers)

    wait_for(is_lifted, SECONDS, lambda: f"{answers[-3:]}")


def test_what_is_answered_as_done_right_after_a_kill_is_decided(stage):
    """The Coordinator names the dead firewall for 8 s more: the new one's decisions would be refused until then."""
    slow = {"heartbeat": 2.0}
    firewall = stage.run("apps.firewall.service", SETTINGS, slow)
    told = Capability(INSTRUCTION, delivery="reliable", archive="always")
    engine = stage.engine("operator", capabilities=[told])
    answers: list[bool] = []
    engine.observe("network.answer.firewall.operator").subscribe(
        lambda item: answers.append(item.value["done"])
    )
    stage.kill(firewall)
    said = Instruction(id="after", verb="block", subject="192.0.2.77", seconds=36_000)
    engine.write(INSTRUCTION, said.to_value())
    engine.flush(SECONDS)
    stage.run("apps.firewall.service", SETTINGS, slow)
    wait_for(lambda: answers, SECONDS, (stage.folder / "apps.firewall.service.log").read_text)
    assert answers[0]
    found = engine.get("network.block.firewall.ipv4")
    assert [item.value["target"]["address"] for item in found] == ["192.0.2.77"]


def test_decisions_survive_and_panic_ends_them_without_redis(stage):
    """kill -9 of each in turn; then Redis goes away, and panic works all the same."""
    controller = stage.controller()
    firewall = stage.run("apps.firewall.service", SETTINGS)
    told = Capability(INSTRUCTION, delivery="reliable", archive="always")
    shook = Capability("network.handshake.sonata.tcp", delivery="reliable", archive="always")
    engine = stage.engine("operator", capabilities=[told])
    decide(engine)
    shake_hands(stage.engine("sonata_adapter", capabilities=[shook]))
    reaches(stage, EVERYTHING)

    stage.kill(firewall)
    stage.run("apps.firewall.service", SETTINGS)
    reaches(stage, EVERYTHING)

    stage.kill(controller)
    stage.controller()
    reaches(stage, EVERYTHING)

    stage.target.kill()
    stage.target.start()
    reaches(stage, EVERYTHING)

    panic_without_redis(stage)
    wait_for(lambda: redis_starts(stage), SECONDS)
    firewall_knows(engine)
    reaches(stage, LEFT)
