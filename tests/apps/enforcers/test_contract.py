"""One contract, every enforcer: add, list back, confirm, remove, end; told by messages, each a process of its own."""

import time
from contextlib import ExitStack, contextmanager
from functools import partial

import pytest
from msgspec import structs

from apps.firewall.enforcement.switch_entries import KEPT, is_prefix, prefix_update
from apps.messages import Confirmation, TableCommand
from due import Capability
from sdnator.testing.controller_run import ControllerRun, Heard
from sdnator.testing.enforcer_run import EnforcerRun
from sdnator.testing.routed_lab import RoutedLab
from sdnator.testing.waiting import wait_for
from sdnator.testing.webhook_server import SECRET, WebhookServer
from tests.requirements import require_netns, require_program

ADDRESSES = ("192.0.2.1", "2001:db8::1", "02:00:00:00:00:07", "192.0.2.0/24", "2001:db8:1::/48")


class Switches:
    """The controller and a switch, spoken to as the firewall does: prefixes are commands of its own."""

    ends_by_itself = False
    """Blocks in a switch end by the firewall's word."""

    def __init__(self, stage):
        self._stage = stage
        kept = [Capability(f"{KEPT}.*", delivery="reliable", archive="always")]
        kept += [Capability("network.block.firewall.*", delivery="reliable", archive="always")]
        self._engine = stage.engine("firewall", capabilities=kept)
        keys = ("network.confirmation.p4runtime_ctrl.*", "network.switch.p4runtime_ctrl.s1")
        self._heard = Heard(stage.engine("listener"), *keys)
        self._maker = EnforcerRun(stage.folder, "x.p4runtime_ctrl.x", {})
        self._process = None

    block = property(lambda self: self._maker.block)

    def start(self):
        self._process = self._stage.controller()

    def kill(self):
        self._stage.kill(self._process)

    def decide(self, decision):
        if is_prefix(decision.target):
            kind = "insert" if decision.action == "block" else "delete"
            update = prefix_update(kind, decision.target.address)
            command = TableCommand(id=decision.id, updates=(update,))
            if not decision.dry_run:  # the firewall writes none for a dry run
                self._engine.write(f"{KEPT}.s1", command.to_value())
        else:
            self._engine.write("network.block.firewall.any", decision.to_value())
        self._engine.flush()
        return decision

    def lift(self, decision):
        self.decide(structs.replace(decision, action="unblock", event_time=time.time_ns()))

    def states(self, decision):
        said = [Confirmation.from_value(value) for value in self._heard.values("confirmation")]
        return [each.state for each in said if each.id == decision.id]

    def wait_for(self, decision, *states):
        wait_for(lambda: (self.states(decision) or [""])[-1] in states, why=self._stage.log)

    def stands(self, decision):
        state = (self._heard.values("network.switch") or [{"blocks": []}])[-1]
        return decision.id in {each["id"] for each in state["blocks"]}

    def is_gone(self, decision):
        return not self.stands(decision)


class Others(EnforcerRun):
    """An enforcer beside the switches."""

    ends_by_itself = True

    def stands(self, decision):
        return decision.id in self.held()

    def is_gone(self, decision):
        return not self.stands(decision)


@contextmanager
def switches(folder):
    with ControllerRun(folder) as stage:
        yield Switches(stage)


@contextmanager
def nftables(folder):
    require_netns()
    require_program("nft")
    with RoutedLab() as lab:
        settings = {"place": "gateway", "check_s": 0.2}
        inside = partial(lab.inside, "gateway")
        with Others(folder, "apps.enforcers.nftables.service", settings, inside) as run:
            yield run


@contextmanager
def webhook(folder):
    secret = folder / "secret"
    secret.write_bytes(SECRET)
    secret.chmod(0o600)
    with WebhookServer() as server:
        settings = {"url": server.url, "secret_file": str(secret), "place": "edge", "check_s": 0.2}
        with Others(folder, "apps.enforcers.webhook_enforcer.service", settings) as run:
            yield run


@pytest.fixture(params=[switches, nftables, webhook], ids=lambda made: made.__name__)
def enforcer(request, tmp_path):
    """One that has started."""
    with ExitStack() as stack:
        made = stack.enter_context(request.param(tmp_path))
        made.start()
        yield made


def test_blocks_are_added_confirmed_listed_and_removed(enforcer):
    """IPv4, IPv6, MAC and prefixes, side by side."""
    for address in ADDRESSES:
        block = enforcer.decide(enforcer.block(address))
        enforcer.wait_for(block, "installed")
        wait_for(partial(enforcer.stands, block))
        enforcer.lift(block)
        enforcer.wait_for(block, "removed")
        wait_for(partial(enforcer.is_gone, block))
        assert enforcer.states(block) == ["installed", "removed"]


def test_a_decision_that_comes_again_is_carried_out_once(enforcer):
    block = enforcer.block("192.0.2.1")
    enforcer.decide(block)
    enforcer.wait_for(block, "installed")
    enforcer.decide(block)
    enforcer.wait_for(block, "exists")
    enforcer.lift(block)
    enforcer.wait_for(block, "removed")


def test_a_dry_run_is_neither_carried_out_nor_confirmed(enforcer):
    dry = enforcer.decide(enforcer.block("192.0.2.1", dry_run=True))
    real = enforcer.decide(enforcer.block("192.0.2.2"))
    enforcer.wait_for(real, "installed")
    wait_for(lambda: enforcer.stands(real))
    assert not enforcer.states(dry)
    assert not enforcer.stands(dry)


def test_a_killed_one_takes_up_what_is_in_force(enforcer):
    """What was lifted meanwhile does not come back."""
    stays, lifted = enforcer.decide(enforcer.block("192.0.2.1")), enforcer.decide(enforcer.block("192.0.2.2"))
    for each in (stays, lifted):
        enforcer.wait_for(each, "installed")
    enforcer.kill()
    enforcer.lift(lifted)
    enforcer.start()
    wait_for(lambda: enforcer.stands(stays) and not enforcer.stands(lifted))


def test_a_block_ends_with_its_time(enforcer):
    """By itself; in a switch by the firewall's word."""
    block = enforcer.decide(enforcer.block("192.0.2.1", seconds=2))
    enforcer.wait_for(block, "installed", "expired")
    if not enforcer.ends_by_itself:
        enforcer.lift(block)
    enforcer.wait_for(block, "removed", "expired")
    wait_for(lambda: not enforcer.stands(block))
