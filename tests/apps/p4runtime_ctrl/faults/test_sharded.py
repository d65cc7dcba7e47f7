"""Controllers that divide the switches: each switch has one that writes, and the next one goes on with what is in force."""

import os
import signal
import threading
import time
from itertools import count

import numpy as np
import pytest
from msgspec import structs

from apps.messages import Target
from dataplane.ports.capture_port import CaptureFeed
from due import Capability
from p4rt import p4runtime
from sdnator.testing.cable import Cable
from sdnator.testing.controller_run import BASE_US, Bystander, ControllerRun, Heard, block, frame
from sdnator.testing.kafka_servers import KafkaMissing, KafkaServers
from sdnator.testing.p4runtime_client import P4RuntimeClient
from sdnator.testing.product_program import program
from sdnator.testing.switch_target import SwitchTarget
from sdnator.testing.waiting import wait_for
from tests.requirements import missing

DECISIONS = Capability("network.block.firewall.*", delivery="reliable", archive="always")
SWITCHES = ("s1", "s2")
FORWARDED = 2
STEADY_NS = 2_000_000_000
"""A primary controller says how its switch is every second."""


class GivenServer:
    """Data Updates that somebody else runs."""

    def __init__(self, url: str) -> None:
        self.url = url

    def __enter__(self) -> "GivenServer":
        return self

    def __exit__(self, *_: object) -> None: ...


class Site:
    """Two embedded switches, a firewall that writes decisions, and controllers as a test starts them."""

    def __init__(self, stage: ControllerRun, folder) -> None:
        self.stage = stage
        self._socket = folder / "in2.sock"
        (folder / "second").mkdir()
        ports = (f"1=capture:{self._socket}", "2=null")
        self.second = SwitchTarget("embedded", folder / "second", ports=ports)
        self.second.start()
        self.targets = {"s1": stage.target, "s2": self.second}
        self.engine = stage.engine(capabilities=(DECISIONS,))
        self.heard = Heard(
            self.engine,
            "due.registration.p4runtime_ctrl",
            "network.packets.p4runtime_ctrl.*.all",
            "network.confirmation.p4runtime_ctrl.*",
            "network.switch.p4runtime_ctrl.*",
        )
        self.decided: dict[str, dict[str, str]] = {name: {} for name in SWITCHES}
        """Addresses of blocks by decision, by switch."""
        self._numbers = count(1)

    def controller(self, addresses=None, *, timeout_s=5.0, **options):
        """A controller of both switches; `addresses` of some, `options` of both in its settings."""
        places = {name: target.address for name, target in self.targets.items()} | (addresses or {})
        switches = [
            {
                "name": name,
                "address": address,
                "insecure": True,
                "base_us": BASE_US,
                "forward": {"1": 2},
                **options,
            }
            for name, address in places.items()
        ]
        return self.stage.controller(switches=switches, instances="sharded", timeout_s=timeout_s)

    def feeds(self):
        return {"s1": self.stage.feed(), "s2": CaptureFeed(str(self._socket))}

    def states(self, switch, since=0):
        """In the order in which they were written: of two controllers on Kafka the older one's may come last."""
        part = f"switch.p4runtime_ctrl.{switch}"
        found = [item for item in list(self.heard.items) if part in item.key and item.timestamp > since]
        return [item.value for item in sorted(found, key=lambda item: item.timestamp)]

    def owner(self, switch):
        """Process of the controller that is primary, as its newest state says; 0: none."""
        state = (self.states(switch) or [{}])[-1]
        pids = {value["instance_id"]: value["pid"] for value in self.heard.values("due.registration")}
        return pids.get(state["owner"], 0) if state.get("primary") else 0

    def sends(self, switch):
        return bool(self.states(switch)) and self.states(switch)[-1]["telemetry"] == ["packets"]

    def divided(self, *pids):
        """Whether each of these processes has a switch, and nobody else, and that for a while.

        A new one claims every switch until it has heard whose they are.
        """
        lately = [self.states(switch, time.time_ns() - STEADY_NS) for switch in SWITCHES]
        steady = all(len({(each["owner"], each["primary"]) for each in states}) == 1 for states in lately)
        owners = [self.owner(switch) for switch in SWITCHES]
        return steady and sorted(set(owners)) == sorted(pids) and all(map(self.sends, SWITCHES))

    def decide(self, switch):
        number = next(self._numbers)
        address = f"10.9.{number >> 8}.{number & 255}"
        target = Target(kind="ip", address=address)
        decision = structs.replace(block(number, 1), switch=switch, target=target)
        self.decided[switch][decision.id] = address
        self.engine.write("network.block.firewall.ipv4", decision.to_value(), event_time=number)

    def lift(self, switch):
        """Lift the block that was decided first of those in force."""
        name = next(iter(self.decided[switch]))
        target = Target(kind="ip", address=self.decided[switch].pop(name))
        number = next(self._numbers)
        decision = structs.replace(block(number, 1, "unblock"), switch=switch, target=target)
        self.engine.write("network.block.firewall.ipv4", decision.to_value(), event_time=number)

    def blocked(self, switch):
        """Addresses of the block entries that the switch holds, read from it."""
        table = program().table("ingress.block_src")
        with P4RuntimeClient(self.targets[switch].address, election_id=None) as client:
            entity = p4runtime.Entity(table_entry=p4runtime.TableEntry(table_id=table.id))
            found = [each.table_entry for each in client.read(entity)]
        return sorted(program().describe(each) for each in found)

    def settled(self, switch):
        """Whether every decision about the switch was confirmed as in force."""
        said = {
            (value["id"], value["state"])
            for value in self.heard.values(f"confirmation.p4runtime_ctrl.{switch}")
        }
        return all(said & {(name, "installed"), (name, "exists")} for name in self.decided[switch])

    def holds(self, switch):
        """Whether the switch holds exactly one entry for each decision."""
        entries = self.blocked(switch)
        wanted = sorted(self.decided[switch].values())
        return len(entries) == len(wanted) and all(
            any(address in entry for entry in entries) for address in wanted
        )

    def arrivals(self, switch):
        """Arrival numbers of the packets of a switch, by the instance that has passed them on."""
        batches = {}
        for item in list(self.heard.items):
            if f".{switch}.all" in item.key:
                batches.setdefault(item.instance_id, []).append(item.value["arrival"])
        return {instance: np.concatenate(found).tolist() for instance, found in batches.items()}

    def why(self):
        return {s: (self.owner(s), self.states(s)[-1:]) for s in SWITCHES}, self.stage.log()[-4_000:]


class Traffic:
    """Until it is left a frame a millisecond to each switch, and decisions about each every few milliseconds."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self._feeds = site.feeds()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self.sent = 0

    def _run(self) -> None:
        while not self._done.wait(0.004):
            for switch, feed in self._feeds.items():
                feed.send([1000 * self.sent + n for n in range(4)], [60] * 4, [frame(1)] * 4)
                if self.sent % 16 == 0 and len(self._site.decided[switch]) < 400:
                    self._site.decide(switch)
                    if self.sent % 48 == 0:
                        self._site.lift(switch)
            self.sent += 4

    def __enter__(self) -> "Traffic":
        self._thread.start()
        return self

    def more(self, frames: int = 400) -> None:
        """Return when so many more frames were sent to each switch."""
        enough = self.sent + frames
        wait_for(lambda: self.sent >= enough)

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()
        for feed in self._feeds.values():
            feed.close()


@pytest.fixture
def updates(request, tmp_path):
    """URL of Data Updates; empty: Valkey of the stage."""
    if request.param == "valkey":
        yield ""
        return
    try:
        servers = KafkaServers(tmp_path / "kafka").start()
    except KafkaMissing as reason:
        missing(str(reason))
    yield servers.url
    servers.stop()


@pytest.fixture
def site(request, tmp_path):
    stage = ControllerRun(tmp_path)
    if "updates" in request.fixturenames and (url := request.getfixturevalue("updates")):
        stage.server = GivenServer(url)
    with stage:
        made = Site(stage, tmp_path)
        try:
            yield made
        finally:
            made.second.stop()


def complete(site, switch):
    """Every decision has its entry, no entry lacks a decision; each controller has passed packets on in order, none twice.

    Returns all their arrival numbers, in order: what a controller had in its hands when it lost the switch comes late.
    """
    wait_for(lambda: site.settled(switch), why=site.why)
    wait_for(lambda: site.holds(switch), why=lambda: (site.blocked(switch), site.why()))
    arrivals = site.arrivals(switch)
    assert all(found == sorted(found) for found in arrivals.values())
    numbers = sorted(number for found in arrivals.values() for number in found)
    assert len(set(numbers)) == len(numbers), "no packet is told twice"
    return numbers


@pytest.mark.parametrize("updates", ["valkey", "kafka"], indirect=True)
def test_after_a_kill_the_other_controller_goes_on_with_the_switch(site, updates):
    controllers = {each.pid: each for each in (site.controller(), site.controller())}
    wait_for(lambda: site.divided(*controllers), why=site.why)
    dead = site.owner("s1")
    other = next(pid for pid in controllers if pid != dead)
    divided = time.time_ns()
    with Traffic(site) as traffic:
        traffic.more()
        site.stage.kill(controllers[dead])
        traffic.more()
        wait_for(lambda: site.owner("s1") == other and site.sends("s1"), why=site.why)
        traffic.more()
    sent = traffic.sent  # its thread has ended
    wait_for(lambda: sum(map(len, site.arrivals("s2").values())) >= sent, why=site.why)
    assert complete(site, "s2") == list(range(sent)), "packets of the other switch are not disturbed"
    taken_over = complete(site, "s1")
    owners = {(state["owner"], state["primary"]) for state in site.states("s2", divided)}
    assert owners == {(site.states("s2")[-1]["owner"], True)}
    state = site.states("s1")[-1]
    missing_here = taken_over[-1] + 1 - len(taken_over)
    assert missing_here <= state["lost"] + state["unaccounted"], "what is missing is counted"


def test_a_controller_that_was_stopped_for_a_while_writes_no_more(site):
    controllers = {each.pid: each for each in (site.controller(), site.controller())}
    wait_for(lambda: site.divided(*controllers), why=site.why)
    paused = site.owner("s1")
    other = next(pid for pid in controllers if pid != paused)
    with Traffic(site) as traffic:
        traffic.more()
        os.kill(paused, signal.SIGSTOP)
        try:
            traffic.more()
            wait_for(lambda: site.owner("s1") == other, why=site.why)
            traffic.more()
        finally:
            os.kill(paused, signal.SIGCONT)
        wait_for(
            lambda: "s1: another controller is primary: this one has stopped writing" in site.stage.log()
        )
        wait_for(lambda: site.divided(*controllers), why=site.why)
        traffic.more()
    for switch in SWITCHES:
        complete(site, switch)
    failed = [value for value in site.heard.values("confirmation") if value["state"] in ("failed", "pending")]
    assert failed == [], "what another controller has carried out is not called a failure"


def test_one_that_ends_in_order_hands_over_and_one_that_comes_gets_its_share(site):
    first = site.controller()
    wait_for(lambda: site.divided(first.pid), why=site.why)
    for switch in SWITCHES:
        site.decide(switch)
    second = site.controller()
    wait_for(lambda: site.divided(first.pid, second.pid), why=site.why)
    with Traffic(site) as traffic:
        traffic.more(200)
        first.stop()
        wait_for(lambda: site.divided(second.pid), why=site.why)
        traffic.more(200)
    for switch in SWITCHES:
        complete(site, switch)


def test_where_a_controller_loses_its_switch_another_one_that_reaches_it_takes_it(site):
    with Cable(site.targets["s1"].address) as one, Cable(site.targets["s1"].address) as other:
        cables = {site.controller({"s1": each.address}, timeout_s=1.0).pid: each for each in (one, other)}
        wait_for(lambda: site.divided(*cables), why=site.why)
        first = site.owner("s1")
        with Traffic(site) as traffic:
            traffic.more()
            cables[first].cut()
            wait_for(lambda: site.owner("s1") not in (0, first) and site.sends("s1"), why=site.why)
            traffic.more()
        for switch in SWITCHES:
            complete(site, switch)
        said = [(value["id"], value["state"]) for value in site.heard.values("confirmation")]
        last = {name: state for name, state in said if name in site.decided["s1"]}
        assert not {"failed", "pending"} & {*last.values()}, (
            "the last word is that of the controller that has the switch"
        )


def test_switches_that_fail_closed_stay_open_while_any_controller_has_them(site):
    controllers = {
        each.pid: each for each in (site.controller(fail="closed"), site.controller(fail="closed"))
    }
    wait_for(lambda: site.divided(*controllers), why=site.why)
    feeds = site.feeds()
    dead = site.owner("s1")
    site.stage.kill(controllers.pop(dead))
    for switch in SWITCHES:
        stays = f"{switch}: another controller is primary; port forwarding stays"
        wait_for(lambda text=stays: text in site.stage.log(), why=site.why)
        assert verdicts(feeds[switch]) == FORWARDED
    site.stage.kill(controllers.popitem()[1])
    for switch in SWITCHES:
        closed = f"{switch}: its controller was killed: fail closed, port forwarding is removed"
        wait_for(lambda text=closed: text in site.stage.log(), why=site.why)
        with Bystander(site.targets[switch].address):
            assert verdicts(feeds[switch]) == 0
        feeds[switch].close()


def verdicts(feed):
    """What a switch does with a frame, but for copying it."""
    feed.send([1], [60], [frame(4)])
    found = []
    wait_for(lambda: found.extend(feed.verdicts()) or found)
    return found[0] & FORWARDED
