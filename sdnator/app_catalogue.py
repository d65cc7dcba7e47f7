"""The apps that a pipeline runs, found by the entry-point group `sdnator.apps`.

    [project.entry-points."sdnator.apps"]
    my_detector = "my_package.service"        # app id = module

The module holds what every app's `service.py` holds: INTERESTS, CAPABILITIES, Settings (a msgspec Struct), one
class with `start`, `tick`, `stop` and `health`, and `main(argv)`, which hands all of them to `due.service.run`.
Installing a package is enough: its app gets a section in `sdnator.toml`, is started, watched and shown.
"""

import inspect
import re
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from types import FunctionType, ModuleType
from typing import TYPE_CHECKING, Any

from sdnator.errors import BadInput

if TYPE_CHECKING:
    import msgspec

    from due.messages import Capability, Interest

GROUP = "sdnator.apps"
OURS = ("p4runtime_ctrl", "kitsune", "sonata_adapter", "firewall")
"""In the order in which they are started and shown; others follow by name."""
ENFORCERS = ("nftables", "webhook_enforcer")
"""Of the product, but run only where the firewall's setting `enforcers` names them."""
RESERVED = frozenset(
    {"up", "switches", "dashboard", "log", "metrics", "due", "coordinator", "supervisor", "grants", "updates"}
)
"""Names of parts and sections that no app may take."""
_APP_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")
_METHODS = ("start", "tick", "stop", "health")


@dataclass(frozen=True)
class CataloguedApp:
    """One installed app; its module is imported when something of it is asked for."""

    name: str
    """App id, section of the configuration, name of the part."""
    module: str
    distribution: str
    """The package that provides it."""

    @property
    def ours(self) -> bool:
        """Whether it belongs to the product."""
        return self.name in OURS

    @property
    def interests(self) -> "tuple[Interest, ...]":
        """Its interests.  Raises BadInput, like all of these."""
        return tuple(self._held("INTERESTS", Iterable))

    @property
    def capabilities(self) -> "tuple[Capability, ...]":
        """Its capabilities."""
        return tuple(self._held("CAPABILITIES", Iterable))

    @property
    def settings(self) -> "type[msgspec.Struct]":
        """The model of its section in `sdnator.toml`."""
        import msgspec

        found: type = self._held("Settings", type)
        if not issubclass(found, msgspec.Struct):
            raise BadInput(f"{self._place()}: Settings is not a msgspec.Struct")
        return found

    @property
    def service(self) -> type:
        """The class that `due.service.run` drives."""
        return service_class(self._loaded())

    def main(self, argv: Sequence[str]) -> int:
        """Run it in this process until a signal ends it; returns the exit code."""
        run: Callable[[Sequence[str]], int] = self._held("main", FunctionType)
        return int(run(argv))

    def _held(self, name: str, kind: type) -> Any:
        module = self._loaded()
        found = getattr(module, name, None)
        if not isinstance(found, kind):
            raise BadInput(f"{self._place()}: the module has no {name}; see docs/onboarding.md")
        return found

    def _loaded(self) -> ModuleType:
        try:
            return import_module(self.module)
        except ImportError as error:
            raise BadInput(f"{self._place()}: {error}; reinstall {self.distribution}") from None

    def _place(self) -> str:
        return f"app {self.name} ({self.module} of {self.distribution})"


def names() -> tuple[str, ...]:
    """Ids of all installed apps, ours first; raises BadInput as `apps`."""
    return tuple(app.name for app in apps())


def to_run(enforcers: Collection[str]) -> tuple[str, ...]:
    """Ids of the apps that a pipeline runs.

    Args:
        enforcers: those that the firewall's settings name.

    Raises:
        BadInput: an enforcer is not installed; otherwise as `apps`.
    """
    installed = names()
    for name in enforcers:
        if name not in installed:
            known = ", ".join((OURS[0], *ENFORCERS))
            raise BadInput(f"firewall.enforcers: no app {name!r} is installed; the product has {known}")
    return tuple(name for name in installed if name not in ENFORCERS or name in enforcers)


def of(name: str) -> CataloguedApp:
    """The installed app of this id; raises BadInput."""
    found = next((app for app in apps() if app.name == name), None)
    if found is None:
        raise BadInput(f"no app {name!r} is installed; there are {', '.join(names())}")
    return found


@cache
def apps() -> tuple[CataloguedApp, ...]:
    """All installed apps, ours first.

    Raises:
        BadInput: two packages provide the same app, or a name is malformed or reserved.
    """
    return catalogued(entry_points(group=GROUP))


def catalogued(found: Iterable[EntryPoint]) -> tuple[CataloguedApp, ...]:
    """The apps of these entry points, checked, in order; raises BadInput as `apps`."""
    known: dict[str, CataloguedApp] = {}
    for entry in found:
        brought = entry.dist.name if entry.dist is not None else "an unknown package"
        one = CataloguedApp(entry.name, entry.value.partition(":")[0], brought)
        if not _APP_ID.fullmatch(entry.name):
            raise BadInput(f"{brought} brings an app {entry.name!r}: app ids are letters, digits, _ and -")
        if entry.name in RESERVED or (entry.name in (*OURS, *ENFORCERS) and brought != "sdnator"):
            raise BadInput(
                f"{brought} brings an app {entry.name!r}, a name of the product: uninstall {brought}"
            )
        before = known.get(entry.name)
        if before is not None and before != one:
            raise BadInput(
                f"{brought} and {before.distribution} both bring an app {entry.name!r}: uninstall one"
            )
        known[entry.name] = one
    order = {name: place for place, name in enumerate(OURS)}
    return tuple(sorted(known.values(), key=lambda app: (order.get(app.name, len(order)), app.name)))


def service_class(module: ModuleType) -> type:
    """The one class of an app's module with `start`, `tick`, `stop` and `health`; raises BadInput."""
    found = [
        kind
        for kind in vars(module).values()
        if inspect.isclass(kind)
        and kind.__module__ == module.__name__
        and all(callable(getattr(kind, name, None)) for name in _METHODS)
    ]
    if len(found) != 1:
        names = ", ".join(kind.__name__ for kind in found) or "none"
        raise BadInput(f"{module.__name__}: one class with {', '.join(_METHODS)} is needed; there is {names}")
    return found[0]
