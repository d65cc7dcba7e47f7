"""Real Coordinator processes: they know all again after kill -9, one of two is active, standby instances take over."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from coordinator.service import Settings
from due import CONSUMER, PRODUCER, Capability, Engine, Item, Options
from due.drivers.embedded_redis import EmbeddedServer

WATCHDOG_S = 60
ROOT = Path(__file__).parents[2]

INSTANCE = """
import json, sys, time
from due import *
engine = Engine(Options(heartbeat=0.5, **json.loads(sys.argv[1])))
engine.init("twin", PRODUCER, capabilities=[Capability("twin.life.twin.beat")])
print(engine.instance_id, flush=True)
while True:
    engine.write("twin.life.twin.beat", time.monotonic(), [PUB_ONLY, NO_WAIT])
    time.sleep(0.02)
"""


def until(condition: Callable[[], Any]) -> Any:
    """The first true answer; fails when it does not come for long."""
    deadline = time.monotonic() + WATCHDOG_S
    while time.monotonic() < deadline:
        answer = condition()
        if answer:
            return answer
        time.sleep(0.02)
    raise AssertionError(f"did not come about in {WATCHDOG_S} s")


class Site:
    """One Data Updates server, one archive, and the processes that use them."""

    def __init__(self, folder: Path, updates: str) -> None:
        self.folder = folder
        self.updates = updates
        self.archive = f"sqlite://{folder}/archive.db"
        self.processes: list[subprocess.Popen[str]] = []
        self.engines: list[Engine] = []

    def start(self, *arguments: str) -> "subprocess.Popen[str]":
        process = subprocess.Popen([sys.executable, *arguments], cwd=ROOT, stdout=subprocess.PIPE, text=True)
        self.processes.append(process)
        return process

    def coordinator(self, name: str, **settings: Any) -> "tuple[subprocess.Popen[str], httpx.Client]":
        address, file = self.folder / f"{name}.url", self.folder / f"{name}.json"
        address.unlink(missing_ok=True)
        file.write_text(json.dumps({"address_file": str(address), "selection": "oldest", **settings}))
        places = [
            "--updates",
            self.updates,
            "--archive",
            self.archive,
            "--directory",
            str(self.folder / name),
        ]
        process = self.start("-m", "coordinator.service", *places, "--settings", str(file))
        assert process.stdout is not None
        ready = json.loads(process.stdout.readline())
        assert ready["ready"] is True
        assert address.read_text().endswith(ready["http"].removeprefix("http://"))
        return process, httpx.Client(base_url=ready["http"], trust_env=False, timeout=WATCHDOG_S)

    def options(self) -> dict[str, Any]:
        where = self.folder / str(len(self.engines) + len(self.processes))
        return {"updates": self.updates, "archive": self.archive, "directory": str(where)}

    def engine(self) -> Engine:
        """Of this process, which does not take itself for stopped where cores are short."""
        self.engines.append(Engine(Options(heartbeat=0.1, pause_limit=WATCHDOG_S, **self.options())))
        return self.engines[-1]

    def instance(self) -> "tuple[str, subprocess.Popen[str]]":
        process = self.start("-c", INSTANCE, json.dumps(self.options()))
        assert process.stdout is not None
        return process.stdout.readline().strip(), process

    def close(self) -> None:
        for engine in self.engines:
            engine.close()
        for process in self.processes:
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with EmbeddedServer(tmp_path / "updates") as server:
        site = Site(tmp_path, server.url)
        yield site
        site.close()


def states(client: httpx.Client, app: str) -> dict[str, str]:
    shown = client.get("/instances").json()
    return {one["instance_id"]: one["state"] for one in shown if one["app_id"] == app}


def test_what_is_wanted_follows_who_is_there(site: Site) -> None:
    process, client = site.coordinator("one")
    producer, consumer = site.engine(), site.engine()
    producer.init("producer", PRODUCER, capabilities=[Capability("a.b.producer.*", 100.0)])
    until(lambda: producer.health()["phase"] == "coordinated")
    assert producer.write("a.b.producer.x", 1) is False, "nobody wants it"
    consumer.init("consumer", CONSUMER)
    got: list[Item] = []
    subscription = consumer.observe("a.*.producer.x", frequency=10.0).subscribe(got.append)
    (assignment,) = until(producer.assignments)
    assert assignment.frequency == 10.0
    until(lambda: producer.write("a.b.producer.x", 2) and got)
    until(lambda: "consumer" in {flow["consumer"] for flow in client.get("/flow").json()})
    subscription.dispose()
    until(lambda: not producer.assignments())
    consumer.close()
    until(lambda: "offline" in states(client, "consumer").values())
    events = until(lambda: client.get("/apps/consumer/history").json()["items"])
    assert events[0]["value"]["event"] == "joined"
    process.send_signal(signal.SIGTERM)
    assert process.wait(WATCHDOG_S) == 0


def test_after_kill_9_it_knows_all_again_and_data_flows_meanwhile(site: Site) -> None:
    process, _ = site.coordinator("one")
    producer, consumer = site.engine(), site.engine()
    producer.init("producer", PRODUCER, capabilities=[Capability("a.b.producer")])
    consumer.init("consumer", CONSUMER)
    got: list[Item] = []
    consumer.observe("a.b.producer").subscribe(got.append)
    until(producer.assignments)
    epoch = producer.health()["epoch"]
    until(
        lambda: any(len(one.value["registrations"]) > 1 for one in producer.get("due.checkpoint.coordinator"))
    )
    process.kill()
    process.wait()
    before = len(got)
    until(lambda: producer.write("a.b.producer", "meanwhile") and len(got) > before)
    _, client = site.coordinator("again")
    until(
        lambda: (
            set(states(client, "producer").values()) == set(states(client, "consumer").values()) == {"active"}
        )
    )
    until(
        lambda: (
            [flow["interest"] for flow in client.get("/flow").json() if flow["consumer"] == "consumer"]
            == ["a.b.producer"]
        )
    )
    # the first word of the new Coordinator may come before it knows the consumer
    until(lambda: producer.health()["epoch"] > epoch and producer.assignments())
    assert producer.assignments()[0].key == "a.b.producer"


def test_of_two_coordinators_one_is_active_and_the_other_takes_over(site: Site) -> None:
    # an interval so long that the first does not become a standby by getting no core for a moment
    first, one = site.coordinator("one", announce_interval_s=0.6)
    until(lambda: one.get("/health").json()["active"])
    _, two = site.coordinator("two", announce_interval_s=0.6)
    active = one.get("/health").json()["active_instance"]
    until(lambda: two.get("/health").json()["active_instance"] == active)
    assert two.get("/health").json()["active"] is False
    producer = site.engine()
    producer.init("producer", PRODUCER, capabilities=[Capability("a")])
    until(lambda: states(two, "producer"))
    first.kill()
    until(lambda: two.get("/health").json()["active"])
    until(lambda: states(two, "producer") == {producer.instance_id: "active"})


def test_a_killed_instance_is_replaced_and_a_stopped_one_does_not_speak_twice(site: Site) -> None:
    _, client = site.coordinator("one")
    consumer = site.engine()
    consumer.init("consumer", CONSUMER)
    got: list[Item] = []
    consumer.observe("twin.life.twin.beat").subscribe(got.append)
    twins = dict(site.instance() for _ in range(3))
    until(lambda: sorted(states(client, "twin").values()) == ["active", "idle", "idle"])

    def active() -> str:
        return next((name for name, state in states(client, "twin").items() if state == "active"), "")

    first = until(active)
    until(lambda: got and got[-1].instance_id == first)
    twins[first].kill()
    second = until(lambda: active() not in ("", first) and active())
    until(lambda: got[-1].instance_id == second)
    twins[second].send_signal(signal.SIGSTOP)
    third = until(lambda: active() not in ("", first, second) and active())
    until(lambda: got[-1].instance_id == third)
    mark = len(got)
    twins[second].send_signal(signal.SIGCONT)
    until(lambda: states(client, "twin")[second] == "idle")
    until(lambda: len(got) > mark + 20)
    assert {item.instance_id for item in got[mark:]} == {third}
    assert active() == third


def test_settings_are_checked() -> None:
    assert Settings().http_host == "127.0.0.1"
    with pytest.raises(ValueError, match="alphabetical"):
        Settings(selection="alphabetical")
    with pytest.raises(ValueError, match="http_port"):
        Settings(http_port=70000)


def test_a_token_of_the_environment_is_asked_for(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DUE_COORDINATOR_TOKEN", "a-token-of-the-operator")
    _, client = site.coordinator("one")
    assert client.get("/apps").status_code == 401
    given = {"Authorization": "Bearer a-token-of-the-operator"}
    assert client.get("/apps", headers=given).status_code == 200


def test_who_came_before_the_coordinator_was_active_is_in_its_history_too(site: Site) -> None:
    early = site.engine()
    early.init("early", PRODUCER)
    _, client = site.coordinator("one")

    def joined() -> list[Any]:
        events = client.get("/apps/early/history").json()["items"]
        return [event for event in events if event["value"]["event"] == "joined"]

    until(joined)
