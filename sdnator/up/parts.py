"""The parts of `sdnator up`, from its plan.

    switches ─────────────────┐
    Valkey, or a given server ┴─ coordinator ─┬─ p4runtime_ctrl
    SQLite, or a given archive                ├─ kitsune
                                              ├─ sonata_adapter
                                              ├─ firewall
                                              └─ dashboard

Switches are started first and stopped last, and no other part's restart touches them.
"""

import os
import secrets
import shutil
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from due.drivers.embedded_redis import EmbeddedServer
from due.errors import InvalidOption
from due.private_files import kept_secret
from due.status_server import metrics_token
from sdnator import p4_program
from sdnator.app_catalogue import OURS
from sdnator.config.planned_switches import PlannedSwitch
from sdnator.config.switch_security import security_of, switch_options
from sdnator.rights.granting import OPERATOR, granted
from sdnator.rights.identities import ADMIN, READERS, made, observable
from sdnator.supervisor import Child, PartSpec, RestartPolicy
from sdnator.supervisor.app_command import Backends, app_command
from sdnator.supervisor.spec import PartProcess
from sdnator.supervisor.switch_program import SwitchProgram, socket_address
from sdnator.supervisor.updates_server import UpdatesProcess
from sdnator.up import running
from sdnator.up.plan import StandingPlan

if TYPE_CHECKING:
    from p4rt import ChannelSecurity

_VITAL = ("coordinator", *OURS)
"""Parts without which the pipeline does not start; other apps are restarted if they fail."""
_SPARK_SECONDS = 60.0
COORDINATOR_TOKEN = "coordinator.token"  # noqa: S105 - a file's name
_SUSPENDED_S = 0.4
"""A suspended switch forwards nothing: it is killed, and its spare takes over."""
_TOKEN = "SDNATOR_DASHBOARD_TOKEN"  # noqa: S105 - a variable's name


class UpParts:
    """Specifications of all parts, and the facts that they share.

    Args:
        plan: what to run.
        stack: resources that end with it.
    """

    def __init__(self, plan: StandingPlan, stack: ExitStack) -> None:
        self.plan = plan
        self.logs = plan.state / "logs"
        self.address_file = plan.state / "coordinator.url"
        self._stack = stack
        self._coordinator_token = kept_secret(plan.state / COORDINATOR_TOKEN)
        self.granted = {name: granted(name, plan.grants) for name in plan.ids()}
        self.identities = made(plan.state, {name: one.rights for name, one in self.granted.items()})
        self.enforced = True
        """Whether the server takes users; otherwise all parts use the given credential."""
        self.archive_of: Callable[[str], str] = lambda _name: plan.archive
        """URL of Data Archives for a part, with its own credential where the server takes users."""
        self._server = None if plan.updates else self._embedded_server()
        self.server = self._server.admin_url if self._server is not None else plan.updates
        """URL of Data Updates with the right to make users there."""
        self.updates = self._operators_url()
        self._programs = {each.name: self._switch(each) for each in plan.switches if _is_ours(each)}
        self._foreign_base_us = 0

    def specs(self) -> tuple[PartSpec, ...]:
        """All parts, in the order in which they are started."""
        return (*self._switch_specs(), *self._updates_specs(), *self._app_specs())

    def switch_part(self, switch: PlannedSwitch) -> str:
        """The name of a switch's part."""
        return "switch" if len(self.plan.switches) == 1 else f"switch-{switch.name}"

    def switch_address(self, switch: PlannedSwitch) -> str:
        """Address of its P4Runtime server."""
        return self._programs[switch.name].address if _is_ours(switch) else switch.kind

    def _operators_url(self) -> str:
        try:
            return self.identities.url(self.server, OPERATOR)
        except InvalidOption:  # reported at the start, which tries it
            return self.server

    def _embedded_server(self) -> EmbeddedServer:
        """Its folder is unique to this run, so that remains of a killed run cannot use it."""
        for old in self.plan.state.glob("updates-*"):
            shutil.rmtree(old, ignore_errors=True)
        password = secrets.token_urlsafe(24)
        server = EmbeddedServer(
            self.plan.state / f"updates-{os.getpid()}",
            users=partial(self.identities.users_file, password),
            admin=(self.identities.prefix + ADMIN, password),
        )
        self._stack.callback(server.stop)
        link = running.updates_link(self.plan.state)
        link.unlink(missing_ok=True)
        link.symlink_to(server.socket)  # where enrolled apps find it, run after run
        self._stack.callback(partial(link.unlink, missing_ok=True))
        return server

    def _switch(self, switch: PlannedSwitch) -> SwitchProgram:
        ports = dict(switch.ports)
        if switch.kind == "bmv2":
            ports = {number: kind.removeprefix("veth:") for number, kind in ports.items()}
        address = switch.listen or "127.0.0.1:0"
        if not switch.listen and switch.kind == "embedded":
            address = socket_address(self.plan.state, switch.name, self._stack)
        return SwitchProgram(
            switch.kind,
            name=self.switch_part(switch),
            logs=self.logs,
            ports=ports,
            address=address,
            device_id=switch.device_id,
            options=switch_options(switch, self.plan.settings_of("p4runtime_ctrl")),
        )

    def security_of(self, switch: PlannedSwitch) -> "ChannelSecurity":
        """How channels to it are secured."""
        return security_of(switch, self.plan.settings_of("p4runtime_ctrl"))

    def _restart(self, *, at_once: bool = False) -> RestartPolicy:
        chosen = self.plan.supervisor
        return RestartPolicy(first_s=chosen.restart_s, longest_s=chosen.restart_longest_s, at_once=at_once)

    def _switch_specs(self) -> tuple[PartSpec, ...]:
        return tuple(
            PartSpec(
                name=self.switch_part(switch),
                start=self._programs[switch.name].start,
                restart=self._restart(at_once=True),
                silence_s=self.plan.supervisor.hung_s,
                suspended_s=_SUSPENDED_S,
                reserve=self._programs[switch.name],
            )
            for switch in self.plan.switches
            if _is_ours(switch)
        )

    def _updates_specs(self) -> tuple[PartSpec, ...]:
        """Producers send again what was published while it was down."""
        if self._server is None:
            return ()
        start = partial(UpdatesProcess, self._server)
        return (
            PartSpec(
                name="updates",
                start=start,
                restart=self._restart(at_once=True),
                silence_s=self.plan.supervisor.hung_s,
            ),
        )

    def _app_specs(self) -> tuple[PartSpec, ...]:
        needs = ("updates",) if self._server is not None else ()
        ours = tuple(self.switch_part(each) for each in self.plan.switches if _is_ours(each))
        # a switch whose clock restarts needs another base in the controller
        follows = tuple(
            self.switch_part(each)
            for each in self.plan.switches
            if _is_ours(each) and not self._programs[each.name].clock_goes_on
        )
        others = tuple(part for part in self.plan.parts() if part != "dashboard")
        after = {"coordinator": ours, "dashboard": others}
        return tuple(
            PartSpec(
                name=name,
                start=partial(self._app, name),
                after=after.get(name, ("coordinator", *ours)),
                needs=needs,
                follows=follows if self.plan.app_of(name) == "p4runtime_ctrl" else (),
                restart=self._restart(),
                vital=self.plan.app_of(name) in _VITAL,
                silence_s=self._silence_s(name),
            )
            for name in self.plan.parts()
        )

    def _silence_s(self, name: str) -> float:
        hung_s = self.plan.supervisor.hung_s
        if hung_s and self.plan.settings_of(self.plan.app_of(name)).get("engine") == "spark":
            # the first query on a slow machine waits for a JVM
            return max(hung_s, _SPARK_SECONDS)
        return hung_s

    def _app(self, part: str) -> PartProcess:
        """Start a process of a DUE app with the current plan."""
        plan = self.plan
        name = plan.app_of(part)
        command = app_command(
            name,
            plan.state,
            self.backends(name),
            self.settings(name),
            directory=plan.state / "due" / part,
            part=part,
        )
        command += ["--log", plan.log_level]
        if plan.log_format != "console":
            command += ["--log-format", plan.log_format]
        if plan.metrics_host and name != "coordinator":
            command += ["--metrics", f"{plan.metrics_host}:0"]
            command += ["--metrics-token", plan.metrics_token_file] if plan.metrics_token_file else []
        environment = {_TOKEN: os.environ[_TOKEN]} if name == "dashboard" and _TOKEN in os.environ else {}
        return Child(part, command, self.logs, heartbeat=True, environment=environment)

    def backends(self, name: str) -> Backends:
        """Places of both backends, with the app's own credential."""
        if not self.enforced:
            return Backends(updates=self.updates, archive=self.archive_of(name), options=self.plan.engine)
        options = {**self.plan.engine, **observable(self.granted[name].rights)}
        updates = self.identities.url(self.updates, name)
        return Backends(updates=updates, archive=self.archive_of(name), options=options)

    def share_credential(self) -> None:
        """All parts use the given credential, for it may make no users."""
        self.enforced, self.updates = False, self.plan.updates

    def settings(self, name: str) -> Mapping[str, Any]:
        """An app's settings, with the addresses of other parts."""
        own = self.plan.settings_of(name)
        if name == "coordinator":
            secrets_of_http = {
                "token": self._coordinator_token,
                "metrics_token": metrics_token(self.plan.metrics_token_file),
            }
            places = {"address_file": str(self.address_file), "readers_file": str(self.plan.state / READERS)}
            return {**own, **places, **secrets_of_http}
        if name == "dashboard":
            return {**(self.plan.dashboard or {}), **self._dashboard_places()}
        if name == "p4runtime_ctrl":
            return {**own, **self._controller_places()}
        if name == "kitsune":
            return _with_trained_model(own)
        return own

    def _controller_places(self) -> Mapping[str, Any]:
        program = p4_program.find()
        # a switch that is no enforcer decides as one that sees copies does
        enforced = "p4runtime_ctrl" in self.plan.settings_of("firewall").get("enforcers", ("p4runtime_ctrl",))
        return {
            "program": str(program.bmv2_json),
            "p4info": str(program.p4info),
            "switches": [
                {
                    "name": switch.name,
                    "address": self.switch_address(switch),
                    "device_id": switch.device_id,
                    "insecure": self.security_of(switch).insecure,
                    "base_us": self._base_us(switch),
                    # the clock zero of an external switch is unknown until its first packet
                    "clock": "own" if _is_ours(switch) else "heard",
                    "target": switch.kind,
                    "forward": {str(number): egress for number, egress in switch.forward.items()},
                    "fail": switch.fail,
                    "mirror": switch.mirror or not enforced,
                    **({"learn": msgspec.to_builtins(switch.learn)} if switch.learn.ports else {}),
                }
                for switch in self.plan.switches
            ],
        }

    def _base_us(self, switch: PlannedSwitch) -> int:
        if _is_ours(switch):
            return self._programs[switch.name].base_us
        # the clock zero of an external switch is unknown
        self._foreign_base_us = self._foreign_base_us or time.time_ns() // 1_000
        return self._foreign_base_us

    def _dashboard_places(self) -> Mapping[str, Any]:
        return {
            "coordinator_file": str(self.address_file),
            "state": str(self.plan.state),
            "run_file": str(self.plan.state / "run.json"),
            "switches": [
                {
                    "name": one.name,
                    "address": self.switch_address(one),
                    "device_id": one.device_id,
                    "security": asdict(self.security_of(one)),
                }
                for one in self.plan.switches
            ],
        }


def _is_ours(switch: PlannedSwitch) -> bool:
    """Whether we start it."""
    return switch.kind in ("embedded", "bmv2")


def _with_trained_model(settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """Use the model of this run after a restart, instead of training again."""
    saved = settings.get("save_model", "")
    if saved and not settings.get("load_model") and Path(saved).exists():
        return {**settings, "save_model": "", "load_model": saved}
    return settings
