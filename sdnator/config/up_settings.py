"""Options of `sdnator up` itself; those of the apps are in their own Settings."""

from typing import Literal

import msgspec

_MOST_PROCESSES = 64


class UpSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the pipeline keeps and shares its data."""

    updates: str = ""
    """Data Updates, redis://, rediss://, redis+sentinel://, unix:// or kafka://; empty: an embedded server."""
    archive: str = ""
    """Data Archives, mongodb:// or sqlite:///; empty: a file in the data folder."""
    quota: float = 10.0
    """Size limit of the embedded archive, GiB; the oldest items are deleted first, what is in force last."""
    keep_model: bool = True
    """Keep Kitsune's model in the state folder, and use it again at the next start if switches, ports and settings
    are the same; off: train at every start, unless `kitsune.load_model` or `--model` names a model."""

    processes: dict[str, int] = {}
    """How many processes to run of an app whose instances divide the switches (`instances = "sharded"`), by its name;
    one of each that is not named."""

    def __post_init__(self) -> None:
        if not self.quota >= 0.01:
            raise ValueError(f"quota={self.quota}: must be at least 0.01 GiB")
        for name, count in self.processes.items():
            if not 1 <= count <= _MOST_PROCESSES:
                raise ValueError(f"processes={{{name}: {count}}}: must be 1 to {_MOST_PROCESSES} of each app")


class GrantPlan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Rights of one app beyond what it declares; a table for each app. Dangerous keys, which command
    switches and apps, are granted to apps that are not the product's only if they are named here."""

    app: str = ""
    """Id of the app."""
    publish: tuple[str, ...] = ()
    """Key patterns that it may publish."""
    observe: tuple[str, ...] = ()
    """Key patterns that it may observe."""
    read: tuple[str, ...] = ()
    """Key patterns that it may read from Data Archives, where these know apps; what it wrote itself it may always."""
    declared: bool = True
    """It may also publish and observe what it declares, except the dangerous keys."""

    def __post_init__(self) -> None:
        from due.errors import InvalidKey  # here, because `sdnator --help` needs none of it
        from due.keys import Key

        for name in ("publish", "observe", "read"):
            for pattern in getattr(self, name):
                try:
                    Key.parse(pattern)
                except InvalidKey as error:
                    raise ValueError(f"{name}={pattern}: {error}") from None


class LearnPlan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """MAC learning by the controller; off without ports."""

    ports: tuple[int, ...] = ()
    """Ports between which frames are switched by learnt MAC addresses, unless `wires` joins them; empty: off."""
    age_s: float = 300.0
    """Seconds without a frame after which a learnt MAC address is removed."""
    limit: int = 8192
    """Maximum number of MAC addresses to learn; frames to others are flooded to all of the ports."""

    def __post_init__(self) -> None:
        if len(self.ports) == 1 or len(set(self.ports)) < len(self.ports):
            raise ValueError(f"learn.ports={list(self.ports)}: must name two or more, each once")
        if not self.age_s >= 1:
            raise ValueError(f"learn.age_s={self.age_s}: must be at least 1 s")
        if self.limit < 1:
            raise ValueError(f"learn.limit={self.limit}: must be at least 1")


class SwitchPlan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A switch that is started with the pipeline, or an external one."""

    name: str = "s1"
    """Name of the switch in keys."""
    kind: str = "embedded"
    """embedded, bmv2, or HOST:PORT of a P4Runtime switch."""
    device_id: int = 1
    """P4Runtime device id."""
    ports: tuple[str, ...] = ()
    """Ports of a switch that `sdnator up` starts: N=veth:INTERFACE or N=null."""
    wires: tuple[str, ...] = ()
    """Port forwarding in both directions, N-M; default: two ports are joined unless they learn; "none": no
    forwarding."""
    learn: LearnPlan = LearnPlan()
    fail: Literal["open", "closed"] = "open"
    """Without a controller: open keeps port forwarding, closed removes it."""
    mirror: bool = False
    """The switch sees copies only, as behind a mirror (SPAN) port or a tap: decisions about it are dry runs."""
    listen: str = ""
    """HOST:PORT on which a switch that `sdnator up` starts serves P4Runtime; empty: a Unix socket that only its
    user can reach (embedded), or 127.0.0.1 (BMv2). The embedded switch needs TLS there, or `insecure`."""
    insecure: bool = False
    """P4Runtime over TCP without TLS: anyone who reaches the port controls the switch. For a stock BMv2 in a lab."""
    tls_certificate: str = ""
    """File of the certificate with which an embedded switch listens on HOST:PORT; clients need one that
    `p4runtime_ctrl.tls_ca` signed."""
    tls_key: str = ""
    """File of its key."""

    def __post_init__(self) -> None:
        if not self.name or not self.name.replace("-", "").replace("_", "").isalnum():
            raise ValueError(f"name={self.name!r}: must be letters, digits, - and _")
        if self.device_id < 1:
            raise ValueError(f"device_id={self.device_id}: must be at least 1")


class LogSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The logs of all parts."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    """Lowest level that is logged."""
    format: Literal["console", "json"] = "console"
    """console: plain lines; json: one object per line, for log collectors."""


class MetricsSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Prometheus endpoints of the apps."""

    host: str = "127.0.0.1"
    """Address on which each app serves its metrics; empty: none."""
    token_file: str = ""
    """File with the token that requests for metrics must send as `Authorization: Bearer …`, 16 characters or more; empty:
    anyone who reaches the endpoints can read them."""
    targets: str = ""
    """File to which the endpoints are written for Prometheus (file_sd_configs); empty: none."""
