"""Whatever is killed, real processes end up with a switch that holds what it should, and nothing else."""

from apps.p4runtime_ctrl.southbound.session import Address, CompiledProgram, P4RuntimeSession
from due import Capability
from p4rt import INSECURE, P4RuntimeStub
from sdnator.testing.controller_run import ControllerRun, Heard, block
from sdnator.testing.product_program import program
from sdnator.testing.waiting import wait_for
from tests.requirements import optional_program

DECISIONS = Capability("network.block.firewall.*", delivery="reliable", archive="always")
SECONDS = 90


def entries_of(address):
    """What a switch holds in the tables of blocks and wires; reading needs no rights over it."""
    where = Address(address, 1, 0, security=INSECURE)
    with where.channel() as channel:
        session = P4RuntimeSession(
            P4RuntimeStub(channel), where, CompiledProgram(b"", program().message), None
        )
        try:
            found = [program().describe(entry) for entry in session.read_entries() if not entry.is_const]
        except Exception as error:  # noqa: BLE001 - the switch may be starting; the wait goes on
            return [str(error)]
    return sorted(name for name in found if name.startswith(("ingress.block", "ingress.forward_port")))


def expected(*blocked, wire=True):
    blocks = [f"ingress.block_src[is_ipv4=1,src=10.0.0.{number}]" for number in blocked]
    return blocks + (["ingress.forward_port[ingress_port=1]"] if wire else [])


class Firewall:
    """Makes decisions, and hears what became of them."""

    def __init__(self, stage):
        self.engine = stage.engine(capabilities=(DECISIONS,))
        self.heard = Heard(self.engine, "network.confirmation.p4runtime_ctrl.*", "network.switch.**")
        self.number = 0
        wait_for(lambda: self.engine.wanted("network.block.firewall.ipv4"), SECONDS, why=stage.log)

    def decide(self, source, action="block"):
        self.number += 1
        decision = block(self.number, source, action)
        self.engine.write("network.block.firewall.ipv4", decision.to_value(), event_time=self.number)
        self.engine.flush()
        return decision.id

    def said(self, number, state):
        return (number, state) in [(v["id"], v["state"]) for v in self.heard.values("confirmation")]

    def state(self):
        return (self.heard.values("network.switch") or [{}])[-1]


def holds(stage, firewall, *blocked, wire=True):
    """Waits until the switch holds these and no others."""
    want = expected(*blocked, wire=wire)
    # BMv2 may end where it is read while it is given its program
    wait_for(lambda: firewall.state().get("connected"), SECONDS, why=stage.log)
    wait_for(
        lambda: entries_of(stage.target.address) == want,
        SECONDS,
        why=lambda: (entries_of(stage.target.address), want, stage.log()[-3000:]),
    )


def test_bmv2_and_controller_are_killed_while_decisions_go_on(tmp_path):
    """What tests/apps/p4runtime_ctrl/faults shows with the embedded switch."""
    optional_program("simple_switch_grpc")
    with ControllerRun(tmp_path, kind="bmv2") as stage:
        controller = stage.controller()
        firewall = Firewall(stage)
        for source in (1, 2, 3):
            firewall.decide(source)
        holds(stage, firewall, 1, 2, 3)
        stage.target.kill()
        wait_for(lambda: firewall.state().get("connected") is False, SECONDS, why=stage.log)
        late = firewall.decide(4)
        firewall.decide(2, "unblock")
        stage.target.start()
        holds(stage, firewall, 1, 3, 4)
        wait_for(lambda: firewall.said(late, "installed"), SECONDS, why=stage.log)
        stage.kill(controller)
        firewall.decide(3, "unblock")
        firewall.decide(5)
        holds(stage, firewall, 1, 3, 4)
        stage.controller()
        holds(stage, firewall, 1, 4, 5)


def test_a_killed_controller_leaves_its_switch_closed_where_that_is_configured(tmp_path):
    """That it stays open otherwise is shown in tests/apps/p4runtime_ctrl/faults."""
    with ControllerRun(tmp_path, fail="closed") as stage:
        controller = stage.controller()
        firewall = Firewall(stage)
        firewall.decide(1)
        holds(stage, firewall, 1)
        stage.kill(controller)
        holds(stage, firewall, 1, wire=False)
        wait_for(lambda: "fail closed, port forwarding is removed" in stage.log(), SECONDS, why=stage.log)
        stage.controller()
        holds(stage, firewall, 1)
        wait_for(lambda: firewall.state().get("primary") and firewall.state()["fail"] == "closed", SECONDS)


def test_an_earlier_run_in_the_same_archive_can_be_left_behind(tmp_path):
    with ControllerRun(tmp_path) as stage:
        first = stage.controller()
        firewall = Firewall(stage)
        firewall.decide(1)
        holds(stage, firewall, 1)
        stage.kill(first)
        stage.target.kill()
        stage.target.start()
        (old,) = firewall.engine.get("network.block.firewall.*")
        second = stage.controller(restore_since=old.timestamp)
        holds(stage, firewall)
        firewall.decide(2)
        holds(stage, firewall, 2)
        stage.kill(second)
        stage.controller(restore_since=old.timestamp)
        holds(stage, firewall, 2)
