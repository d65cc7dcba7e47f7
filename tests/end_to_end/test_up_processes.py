"""`sdnator up` with two controllers that divide two switches: one is killed, and both switches are served on."""

import json
import os
import signal
import subprocess
from contextlib import ExitStack
from pathlib import Path

from sdnator.capture.interfaces import VethPair
from sdnator.cli.status_command import controlled
from sdnator.northbound import ask
from sdnator.up import running
from tests.end_to_end.test_up import Operator, raw, until
from tests.requirements import require_netns

CONFIGURATION = """
[up]
processes = { p4runtime_ctrl = 2 }
[p4runtime_ctrl]
instances = "sharded"
"""
SWITCH = """[[switches]]
name = "{name}"
device_id = {number}
ports = ["1=veth:{one}", "2=veth:{two}"]
"""
FRAME = bytes.fromhex(
    "020000000002020000000001 0800 4500001c00010000401100000a0000010a000002 0035003500080000"
)
SWITCHES = ("s1", "s2")


class Wire:
    """Two interfaces that a switch joins."""

    def __init__(self, stack: ExitStack, name: str) -> None:
        self.left, self.right = VethPair.make(stack, f"{name}l"), VethPair.make(stack, f"{name}r")
        self._send, self._receive = (stack.enter_context(raw(one.near)) for one in (self.left, self.right))
        self._receive.settimeout(0.2)

    def passes(self) -> bool:
        """Whether a frame of one side leaves at the other."""
        self._send.send(FRAME.ljust(60, b"\0"))
        try:
            return self._receive.recv(2048).startswith(FRAME)
        except TimeoutError:
            return False


class Controllers:
    """What the run file and the Coordinator say of them."""

    def __init__(self, operator: Operator) -> None:
        self._state = Path(operator.environment["XDG_STATE_HOME"]) / "sdnator"

    def run(self) -> running.Running:
        found = running.find(self._state)
        assert found is not None
        return found

    def pids(self) -> dict[str, int]:
        """By part."""
        return {part: pid for part, pid in self.run().parts.items() if part.startswith("p4runtime_ctrl")}

    def owners(self) -> dict[str, int]:
        """By switch: the process of the controller that has it."""
        url = self.run().coordinator
        control = controlled(ask(url, "/health")) or {"switches": {}}
        pids = {one["instance_id"]: one["pid"] for one in ask(url, "/instances")}
        return {name: pids.get(one.get("owner"), 0) for name, one in control["switches"].items()}

    def divided(self) -> bool:
        """Whether each has a switch."""
        owners, pids = self.owners(), self.pids()
        return owners.keys() == set(SWITCHES) and sorted(owners.values()) == sorted(pids.values())


def test_a_killed_controllers_switch_is_served_on_and_up_starts_the_controller_again(tmp_path):
    require_netns()
    operator, file = Operator(tmp_path), tmp_path / "sdnator.toml"
    with ExitStack() as stack:
        wires = {name: Wire(stack, f"u{name}") for name in SWITCHES}
        file.write_text(
            CONFIGURATION
            + "".join(
                SWITCH.format(name=name, number=number, one=wire.left.far, two=wire.right.far)
                for number, (name, wire) in enumerate(wires.items(), 1)
            )
        )
        stack.enter_context(operator.up("--config", str(file)))
        controllers = Controllers(operator)
        assert controllers.pids().keys() == {"p4runtime_ctrl", "p4runtime_ctrl-2"}
        until(controllers.divided)
        until(lambda: all(wire.passes() for wire in wires.values()))
        dead = controllers.owners()["s1"]
        part = next(name for name, pid in controllers.pids().items() if pid == dead)
        os.kill(dead, signal.SIGKILL)
        viewers = {
            name: stack.enter_context(
                subprocess.Popen(
                    operator.command(
                        "observe", f"network.packets.p4runtime_ctrl.{name}.all", "--count", "1", "--json"
                    ),
                    env=operator.environment,
                    stdout=subprocess.PIPE,
                    text=True,
                )
            )
            for name in SWITCHES
        }

        def seen(name):
            return wires[name].passes() and viewers[name].poll() is not None

        for name, viewer in viewers.items():
            until(lambda name=name: seen(name))
            assert viewer.stdout is not None
            assert set(json.loads(viewer.stdout.read())["value"]["port"]) == {1}
        until(lambda: controllers.pids()[part] != dead and controllers.divided())
        assert controllers.run().health[part]["restarts"] == 1
