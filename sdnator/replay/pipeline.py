"""The whole pipeline as processes of this machine, for one replay: started in order, watched, stopped in order.

Valkey (Data Updates) ─ coordinator ─┬─ switch ◄─ P4Runtime ─ p4runtime_ctrl
SQLite (Data Archives)               ├─ kitsune
                                     ├─ sonata_adapter
                                     └─ firewall

These are the apps of `sdnator up`; without queries there is no Sonata adapter.

No part is restarted: the results of a disturbed replay are not valid.
"""

import secrets
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataplane.ports.capture_port import CaptureFeed
from due.drivers.embedded_redis import EmbeddedServer
from p4rt import INSECURE, ChannelSecurity
from sdnator import p4_program
from sdnator.app_catalogue import OURS
from sdnator.capture.interfaces import Feed, VethPair, WireFeed
from sdnator.errors import PipelineError
from sdnator.replay.drop_counters import DropCounters
from sdnator.rights.granting import OPERATOR, granted
from sdnator.rights.identities import ADMIN, made, observable
from sdnator.supervisor import Child, PartSpec, Supervisor
from sdnator.supervisor.app_command import Backends, app_command
from sdnator.supervisor.spec import PartProcess
from sdnator.supervisor.switch_program import SwitchProgram
from sdnator.supervisor.updates_server import UpdatesProcess
from sdnator.supervisor.whole_or_none import WholeOrNone

SWITCH_NAME = "s1"
INGRESS_PORT = 1
EGRESS_PORT = 2
_ADAPTER = "sonata_adapter"


@dataclass(frozen=True, kw_only=True)
class PipelinePlan:
    """What to start."""

    folder: Path
    """Empty folder for the archive, settings and logs."""
    switch: str = "embedded"
    """embedded, bmv2, or HOST:PORT of an external P4Runtime switch."""
    security: ChannelSecurity | None = None
    """How channels to an external switch are secured."""
    inject: str | None = None
    """Interface through which frames enter an external switch."""
    device_id: int = 1
    base_us: int = 0
    """Microseconds that the controller adds to the embedded switch's time stamps."""
    times_us: NDArray[np.int64] | None = None
    """Capture time of each frame, us since the epoch, for switches with a clock of their own."""
    first: "Callable[[ReplayPipeline], None] | None" = None
    """Called when Data Updates and the Coordinator run, before any app starts: data is made on demand,
    so a consumer that must not miss any registers its interests here."""
    telemetry: str = "packet-in"
    """How headers come from the switch: packet-in, or digest."""
    linger_ms: float = 2.0
    """How long the controller waits for more headers when it has some: in laps, none come."""
    queries: bool = True
    """Run the Sonata adapter."""
    keeps_archive: bool = True
    """Archive packets and scores, too; False: only what apps read back and what the replay reports."""
    kitsune: Mapping[str, Any] = field(default_factory=dict)
    firewall: Mapping[str, Any] = field(default_factory=dict)


class ReplayPipeline(WholeOrNone):
    """A running pipeline; a context manager.

    Raises:
        PipelineError: from entering and `check`, naming the part, with the end of its log.
    """

    def __init__(self, plan: PipelinePlan) -> None:
        self._plan = plan
        self._logs = plan.folder / "logs"
        self._stack = ExitStack()
        self._guests = ExitStack()
        self._supervisor = Supervisor((), _tell)
        self._begun_ns = time.time_ns()
        self._inject = plan.inject
        self._switch: SwitchProgram | None = None
        self.updates = ""
        """URL of Data Updates."""
        self.archive = f"sqlite:///{plan.folder.absolute() / 'archive.db'}"
        """URL of Data Archives."""
        # Sockets live in a folder of their own: their paths must be short, the plan's may be long.
        self._run = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="sdnator-run-")))
        self._capture_socket = str(self._run / "capture.sock")
        self._coordinator_file = self._run / "coordinator.url"
        self._identities = made(self._run, {name: granted(name).rights for name in ("coordinator", *OURS)})

    def _start(self) -> None:
        self._logs.mkdir(parents=True, exist_ok=True)
        password = secrets.token_urlsafe(24)
        server = EmbeddedServer(
            self._run / "updates",
            users=partial(self._identities.users_file, password),
            admin=(self._identities.prefix + ADMIN, password),
        )
        self._stack.callback(server.stop)
        self.updates = self._identities.url(server.url, OPERATOR)
        self._add("updates", partial(UpdatesProcess, server))
        self._add(
            "coordinator",
            partial(
                self._app,
                "coordinator",
                {"address_file": str(self._coordinator_file), "token": secrets.token_urlsafe(24)},
            ),
            after=("updates",),
        )
        self._add_switch()
        self._supervisor.start()
        if self._plan.first is not None:
            self._plan.first(self)
        settings = {
            "p4runtime_ctrl": self._controller_settings(),
            "kitsune": {"archive_scores": self._plan.keeps_archive, **self._plan.kitsune},
            _ADAPTER: self._adapter_settings(),
            "firewall": self._firewall_settings(),
        }
        for name in OURS:
            if self._plan.queries or name != _ADAPTER:
                self._add(name, partial(self._app, name, settings[name]))
        self._supervisor.start()

    def _add(self, name: str, start: Callable[[], PartProcess], after: tuple[str, ...] = ()) -> None:
        self._supervisor.add(PartSpec(name=name, start=start, after=after, restart=None))

    def _add_switch(self) -> None:
        if self._plan.switch == "embedded":
            self._switch = SwitchProgram(
                "embedded",
                name="switch",
                logs=self._logs,
                ports={INGRESS_PORT: f"capture:{self._capture_socket}", EGRESS_PORT: "null"},
                address=f"unix:{self._run / 'switch.sock'}",
                device_id=self._plan.device_id,
                options=("--state-json", str(self._plan.folder / "switch.json")),
            )
        elif self._plan.switch == "bmv2":
            entry = VethPair.make(self._stack, "in")
            leave = VethPair.make(self._stack, "out")
            self._inject = entry.near
            ports = {INGRESS_PORT: entry.far, EGRESS_PORT: leave.near}
            self._switch = SwitchProgram(
                "bmv2", name="switch", logs=self._logs, ports=ports, device_id=self._plan.device_id
            )
        else:
            return
        self._add("switch", self._switch.start)

    @property
    def _address(self) -> str:
        return self._switch.address if self._switch is not None else self._plan.switch

    @property
    def coordinator(self) -> str:
        """URL of the Coordinator's HTTP API."""
        return self._coordinator_file.read_text(encoding="utf-8").strip()

    @property
    def _security(self) -> ChannelSecurity:
        """BMv2 has no TLS; ours listens on loopback."""
        if self._plan.switch == "bmv2":
            return INSECURE
        return self._plan.security or ChannelSecurity()

    @property
    def gives_verdicts(self) -> bool:
        """Whether the switch gives a verdict on each frame."""
        return self._inject is None

    def drop_counters(self) -> DropCounters:
        """Counters of the switch's block entries, for switches without verdicts."""
        return DropCounters(self._address, self._plan.device_id, self._security)

    def feed(self) -> Feed:
        """The input for frames."""
        return CaptureFeed(self._capture_socket) if self._inject is None else WireFeed(self._inject)

    def _controller_settings(self) -> dict[str, Any]:
        program = p4_program.find()
        return {
            "program": str(program.bmv2_json),
            "p4info": str(program.p4info),
            "telemetry": self._plan.telemetry,
            "archive_packets": self._plan.keeps_archive,
            "linger_ms": self._plan.linger_ms,
            "tls_ca": self._security.ca,
            "tls_certificate": self._security.certificate,
            "tls_key": self._security.key,
            # the archive of a folder that was used before holds an earlier run's blocks
            "restore_since": self._begun_ns,
            "switches": [
                {
                    "name": SWITCH_NAME,
                    "address": self._address,
                    "device_id": self._plan.device_id,
                    "insecure": self._security.insecure,
                    "base_us": self._plan.base_us,
                    "capture_times": self._capture_times(),
                    "target": self._plan.switch,
                    "clock": "packets",
                    "forward": {str(INGRESS_PORT): EGRESS_PORT},
                }
            ],
        }

    def _capture_times(self) -> str:
        """The capture's times drive the embedded switch's clock; for others the controller knows them."""
        if self._plan.switch == "embedded" or self._plan.times_us is None:
            return ""
        path = self._plan.folder.absolute() / "capture-times.npy"
        np.save(path, self._plan.times_us)
        return str(path)

    def _adapter_settings(self) -> dict[str, Any]:
        """What the switch counts must not depend on the speed of the replay.

        Cells would have to be read within a window of capture time, which may be over in a millisecond; and the
        windows of a switch with a clock of its own are not the capture's, so there the host counts everything.
        """
        return {"limits": {"reads": False} if self._plan.switch == "embedded" else {"stages": 0}}

    def _firewall_settings(self) -> dict[str, Any]:
        """All SYNs are copied: a flood may be over in a replay before a sample of it could be asked for."""
        return {
            **self._plan.firewall,
            "syn": {"copies": "all", "grace_ms": 100, **self._plan.firewall.get("syn", {})},
        }

    def _app(self, name: str, settings: Mapping[str, Any]) -> Child:
        options = observable(self._identities.all[name].rights)
        updates = self._identities.url(self.updates, name)
        backends = Backends(updates=updates, archive=self.archive, options=options)
        return Child(name, app_command(name, self._plan.folder, backends, settings), self._logs)

    def check(self) -> None:
        """Raise PipelineError if a part has died."""
        self._supervisor.watch()

    def before_stop(self, leave: Callable[[], None]) -> None:
        """Call `leave` before any part is stopped, even if the start fails: for users of Data Updates."""
        self._guests.callback(leave)

    def stop(self) -> None:
        """Stop all parts, the last started first."""
        try:
            self._guests.close()
        finally:
            try:
                self._supervisor.stop()
            finally:
                self._stack.close()

    def pids(self) -> dict[str, int]:
        """Process ids by name."""
        return self._supervisor.pids()


def _tell(text: str) -> None:
    print(f"sdnator: {text}", file=sys.stderr, flush=True)


__all__ = ["EGRESS_PORT", "INGRESS_PORT", "SWITCH_NAME", "PipelineError", "PipelinePlan", "ReplayPipeline"]
