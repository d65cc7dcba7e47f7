"""Options of `sdnator up` itself; those of the apps stand in their own Settings."""

from typing import Literal

import msgspec


class UpSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the pipeline keeps and shares its data."""

    updates: str = ""
    """Data Updates, redis://, rediss:// or unix://; empty: an embedded server."""
    archive: str = ""
    """Data Archives, mongodb:// or sqlite:///; empty: a file in the data folder."""
    quota: float = 10.0
    """GiB that the embedded archive may take; the oldest items go first."""

    def __post_init__(self) -> None:
        if not self.quota >= 0.01:
            raise ValueError(f"quota={self.quota}: at least 0.01 GiB")


class LearnPlan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Switching by learnt MAC addresses, as the controller does it; without ports it does not."""

    ports: tuple[int, ...] = ()
    """Frames are switched between these by learnt MAC addresses, where there is no wire; none: no learning."""
    age_s: float = 300.0
    """A station that has sent nothing for so long is forgotten."""
    limit: int = 8192
    """Most stations; frames to further ones go to all of the ports."""

    def __post_init__(self) -> None:
        if len(self.ports) == 1 or len(set(self.ports)) < len(self.ports):
            raise ValueError(f"learn.ports={list(self.ports)}: give two or more, each once")
        if not self.age_s >= 1:
            raise ValueError(f"learn.age_s={self.age_s}: at least 1 s")
        if self.limit < 1:
            raise ValueError(f"learn.limit={self.limit}: at least 1")


class SwitchPlan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A switch: started with the pipeline, or one that runs already."""

    name: str = "s1"
    """As it stands in keys."""
    kind: str = "embedded"
    """embedded, bmv2, or HOST:PORT of a P4Runtime switch."""
    device_id: int = 1
    """P4Runtime device id."""
    ports: tuple[str, ...] = ()
    """Ports of a switch that we start: N=veth:INTERFACE or N=null."""
    wires: tuple[str, ...] = ()
    """Ports joined both ways, N-M; of exactly two ports by itself, unless it learns; "none": only listen."""
    learn: LearnPlan = LearnPlan()
    fail: Literal["open", "closed"] = "open"
    """While it is not under control: open keeps the wires, closed takes them out."""

    def __post_init__(self) -> None:
        if not self.name or not self.name.replace("-", "").replace("_", "").isalnum():
            raise ValueError(f"name {self.name!r}: letters, digits, - and _")
        if self.device_id < 1:
            raise ValueError(f"device_id={self.device_id}: at least 1")


class LogSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The logs of all parts."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    """The least that is logged."""
    format: Literal["console", "json"] = "console"
    """console: lines for people; json: an object a line, for collectors."""


class MetricsSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Prometheus endpoints of the apps."""

    host: str = "127.0.0.1"
    """Address that each app serves its metrics on; empty: none."""
    targets: str = ""
    """File that takes the endpoints as Prometheus reads them (file_sd_configs); empty: none."""
