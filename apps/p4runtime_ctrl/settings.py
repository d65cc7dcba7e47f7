"""Options of the controller, each with its default and its text."""

from typing import Literal

import msgspec

from apps.p4runtime_ctrl.guard import GuardSettings
from apps.p4runtime_ctrl.stations import LearnSettings


class SwitchSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One switch."""

    name: str
    """As it stands in keys."""
    address: str
    """Of its P4Runtime server, HOST:PORT."""
    device_id: int = 1
    base_us: int = 0
    """Absolute time of the switch's clock zero: integer microseconds since the epoch."""
    forward: dict[str, int] = {}
    """Wires: ingress port to egress port."""
    learn: LearnSettings | None = None
    """Switch by learnt MAC addresses where there is no wire; off unless ports are named."""
    fail: Literal["open", "closed"] = "open"
    """While it is not under control: open keeps the wires, closed takes them out, and puts them in last."""
    target: str = ""
    """What kind of switch it is, for people."""


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the controller."""

    switches: tuple[SwitchSettings, ...]
    program: str
    """The compiled program, BMv2 JSON."""
    p4info: str
    """Its p4info in protobuf text format."""
    telemetry: Literal["packet-in", "digest"] = "packet-in"
    """Where record batches of packets come from: copied frames, or digests of the switch's parser."""
    batch: int = 1024
    """Most packets in one record batch."""
    linger_ms: float = 2.0
    """How long the first packet of a batch waits for others."""
    rank: int = 1
    """The controller of the highest rank is primary, the others are backups."""
    copy_session: int = 1
    """Clone session that the program copies frames to."""
    cpu_port: int = 510
    tls_ca: str = ""
    """File of the certificate that signed the switches'; empty: no TLS."""
    tls_certificate: str = ""
    """Files of the controller's own certificate and key, where switches ask for them."""
    tls_key: str = ""
    timeout_s: float = 5.0
    """A switch that does not answer a call for this long is given up and connected again."""
    counters_ms: int = 20
    """Least wall time between two readings of block counters."""
    restore: bool = True
    """Take up the decisions and commands in Data Archives at start."""
    restore_since: int = 0
    """... those written after this time only (ns since the epoch)."""
    guard: GuardSettings = GuardSettings()
