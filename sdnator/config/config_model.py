"""The model of `sdnator.toml`: a section for each part, generated from the Settings of the parts.

Names, types and defaults are those of the Structs; texts are the strings below the declarations.  pydantic
finds all errors of a file at once; checks of values are in the Structs.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any, get_args, get_origin, get_type_hints

import msgspec
from pydantic import BaseModel, ConfigDict, create_model

from sdnator.app_catalogue import apps

SCHEMA = 1
"""Version of the file format; grows when an option changes its meaning."""
SWITCHES = "switches"
GRANTS = "grants"
LISTS = (SWITCHES, GRANTS)
"""Sections of which the file may have several."""


@dataclass(frozen=True)
class Section:
    """One table of the file: its Settings, and the options that the pipeline sets itself."""

    module: str
    struct: str
    hidden: Mapping[str, Any] | None = None
    """Options that the pipeline sets, with a value for checks of the others."""
    defaults: Mapping[str, Any] | None = None
    """Defaults in `sdnator up` that differ from those of the part alone."""

    def kind(self) -> type[msgspec.Struct]:
        """The Struct."""
        found: type[msgspec.Struct] = getattr(import_module(self.module), self.struct)
        return found


PRODUCT_SECTIONS: Mapping[str, Section] = {
    "up": Section("sdnator.config.up_settings", "UpSettings"),
    SWITCHES: Section("sdnator.config.up_settings", "SwitchPlan"),
    GRANTS: Section("sdnator.config.up_settings", "GrantPlan"),
    "dashboard": Section("sdnator.dashboard.settings", "DashboardOptions"),
    "supervisor": Section("sdnator.supervisor.settings", "SupervisorSettings"),
    "log": Section("sdnator.config.up_settings", "LogSettings"),
    "metrics": Section("sdnator.config.up_settings", "MetricsSettings"),
    "due": Section("due.config", "Options", {"updates": "", "archive": "", "directory": ""}),
    "coordinator": Section(
        "coordinator.service", "Settings", {"address_file": "", "token": "", "metrics_token": ""}
    ),
    "p4runtime_ctrl": Section(
        "apps.p4runtime_ctrl.settings", "Settings", {"switches": (), "program": "", "p4info": ""}
    ),
    "kitsune": Section("apps.kitsune.service", "Settings"),
    "sonata_adapter": Section("apps.sonata_adapter.service", "Settings"),
    "firewall": Section("apps.firewall.service", "Settings", defaults={"allow_surroundings": True}),
    "nftables": Section("apps.enforcers.nftables.settings", "Settings"),
    "webhook_enforcer": Section("apps.enforcers.webhook_enforcer.settings", "Settings"),
}


@cache
def sections() -> Mapping[str, Section]:
    """All sections of the file, including one for each installed app."""
    others = {app.name: Section(app.module, "Settings") for app in apps() if app.name not in PRODUCT_SECTIONS}
    return {**PRODUCT_SECTIONS, **others}


def fields(section: str) -> dict[str, msgspec.structs.FieldInfo]:
    """The options of a section that the user may set, by name."""
    hidden = sections()[section].hidden or {}
    return {
        one.name: one for one in msgspec.structs.fields(sections()[section].kind()) if one.name not in hidden
    }


def default(section: str, option: str) -> Any:
    """The defaults, as plain values."""
    own = sections()[section].defaults or {}
    return own[option] if option in own else plain_default(fields(section)[option])


def plain_default(field: msgspec.structs.FieldInfo) -> Any:
    """The default of a Struct's field as plain values; None if it has none."""
    if field.default is not msgspec.NODEFAULT:
        return msgspec.to_builtins(field.default)
    if field.default_factory is not msgspec.NODEFAULT:
        return msgspec.to_builtins(field.default_factory())
    return None


@cache
def model() -> type[BaseModel]:
    """The pydantic model of the whole file."""
    parts: dict[str, Any] = {"schema_": (int, SCHEMA)}
    for name, section in sections().items():
        made = model_of(section.kind(), frozenset(section.hidden or ()))
        parts[name] = (list[made] if name in LISTS else made, None)  # type: ignore[valid-type]
    config = ConfigDict(extra="forbid", strict=True)
    return create_model("SdnatorConfig", __config__=config, **parts)


@cache
def model_of(struct: type[msgspec.Struct], hidden: frozenset[str] = frozenset()) -> type[BaseModel]:
    """A pydantic model with the fields of a Struct; nested Structs become nested models."""
    kinds = get_type_hints(struct)
    parts: dict[str, Any] = {
        one.name: (_kind_of(kinds[one.name]), None)
        for one in msgspec.structs.fields(struct)
        if one.name not in hidden
    }
    config = ConfigDict(extra="forbid", strict=True, protected_namespaces=())
    return create_model(f"{struct.__module__}.{struct.__name__}", __config__=config, **parts)


def _kind_of(kind: Any) -> Any:
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return model_of(kind)
    origin, inner = get_origin(kind), get_args(kind)
    if origin is tuple and inner:
        return tuple[tuple(_kind_of(one) if one is not ... else one for one in inner)]  # type: ignore[misc]
    return kind
