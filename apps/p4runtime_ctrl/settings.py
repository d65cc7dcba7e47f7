"""Options of the controller, each with its default and its text."""

from typing import Literal

import msgspec

from apps.p4runtime_ctrl.state.guard import GuardSettings
from apps.p4runtime_ctrl.state.mac_learning import LearnSettings


class SwitchSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One switch."""

    name: str
    """Name of the switch in keys."""
    address: str
    """Address of its P4Runtime server, HOST:PORT or unix:/PATH; HOST:PORT needs TLS, or `insecure`."""
    insecure: bool = False
    """Without TLS over TCP, where every user of the machine and the network may command it: BMv2 in a lab."""
    device_id: int = 1
    base_us: int = 0
    """Absolute time of the switch's clock zero: integer microseconds since the epoch."""
    forward: dict[str, int] = {}
    """Port forwarding: ingress port to egress port."""
    learn: LearnSettings | None = None
    """MAC learning on ports without port forwarding; None: off."""
    fail: Literal["open", "closed"] = "open"
    """Without a controller: open keeps port forwarding, closed removes it, and restores it last."""
    clock: Literal["packets", "heard", "own"] = "heard"
    """What moves its time: its packets alone, as in a replay; heard: between packets the controller's clock carries
    it on, once a second; own: also before the first packet, because `base_us` is known."""
    mirror: bool = False
    """It sees copies only, as behind a mirror port: decisions are not carried out."""
    capture_times: str = ""
    """File (.npy, int64) with the time of each frame of a capture, us since the epoch, by arrival number: for replays
    on a switch with a clock of its own; empty: the switch's time stamps hold."""
    target: str = ""
    """Kind of switch: `embedded`, `bmv2`; anything else is for display."""


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the controller."""

    switches: tuple[SwitchSettings, ...]
    program: str
    """The compiled program, BMv2 JSON."""
    p4info: str
    """Its p4info in protobuf text format."""
    telemetry: Literal["auto", "packet-in", "digest"] = "auto"
    """Source of the packets' record batches: copied frames, or digests with the header fields; auto: digests of
    embedded switches, which send them in lists, and copied frames of others."""
    instances: Literal["standby", "sharded"] = "standby"
    """`standby`: one instance has all switches and the others wait; `sharded`: the instances divide the switches, each of
    which has one controller at a time."""
    batch: int = 1024
    """Maximum number of packets in one record batch."""
    linger_ms: float = 2.0
    """How long the first packet of a batch waits for others."""
    rank: int = 1
    """The controller with the highest rank is primary, the others are backups. Pipelines that share a switch need
    different ranks: of one rank, their controllers take it from each other."""
    copy_session: int = 1
    """Clone session to which the program copies frames."""
    cpu_port: int = 510
    """Number of the switch's port to the controller."""
    tls_ca: str = ""
    """CA certificate that signed the switches' certificates, a file; TLS is used unless the address is a Unix
    socket or the switch is `insecure`."""
    tls_certificate: str = ""
    """Controller's own certificate, a file; its name (CN) determines its role at the embedded switch."""
    tls_key: str = ""
    """Key of that certificate, a file."""
    timeout_s: float = 5.0
    """Seconds without an answer to a call after which the connection to a switch is closed and opened again."""
    counters_ms: int = 20
    """Minimum wall time between two reads of the block counters."""
    restore: bool = True
    """Restore decisions and commands from Data Archives at the start."""
    restore_since: int = 0
    """... only those written after this time (ns since the epoch)."""
    archive_packets: bool = True
    """Archive headers, frames and reports of the switch that apps want; False: they are published only, which costs less
    where nobody will read them again."""
    guard: GuardSettings = GuardSettings()

    def by_digest(self, switch: SwitchSettings) -> bool:
        """Whether a switch's packets come as digests.

        Args:
            switch: one of `switches`.

        Returns:
            False: they come as copied frames.
        """
        return self.telemetry == "digest" or (self.telemetry == "auto" and switch.target == "embedded")
