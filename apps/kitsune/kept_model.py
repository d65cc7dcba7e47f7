"""The model that `sdnator up` keeps: taken up where it belongs, set aside where it does not.  I/O.

start ─► is there a file? ─► was it trained for these switches, ports and settings? ─► taken up
              │ no                    │ no: the reason in one line, the file is kept beside
              └───────────────────────┴─► train again, write the file when training ends and at the stop
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from apps.kitsune.afterimage import WIDTH
from apps.kitsune.behaviour.behaviour import Behaviour
from apps.kitsune.detector import Detector, DetectorSettings
from apps.kitsune.kernel import LAMBDAS, Kernel
from apps.kitsune.model_file import Model, ModelFileError, load_model

SCHEMA: Final = 1
"""Version of what training yields besides the network; a model of another version is trained again."""
MOST_ASIDE: Final = 5
"""Older models that are kept beside."""
_OF_TRAINING: Final = ("fm_grace", "ad_grace", "max_ae", "mode", "max_streams", "max_links", "horizon")
"""Settings that a model depends on."""


def trained_for(settings: DetectorSettings, switches: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    """What a model belongs to, as plain values.

    Args:
        settings: of the detector.
        switches: by name, what is known of each and its ports: `embedded`, `1=veth:eth1`, …
    """
    return {
        "schema": SCHEMA,
        "features": WIDTH,
        "lambdas": list(LAMBDAS),
        "statistics": sorted(Behaviour(1).to_state()["baselines"]),
        "settings": {name: getattr(settings, name) for name in _OF_TRAINING},
        "switches": {name: list(ports) for name, ports in sorted(switches.items())},
    }


def differences(model: Mapping[str, Any], here: Mapping[str, Any]) -> Iterator[str]:
    """Why a model does not belong here; nothing if it does.

    Args:
        model: what it was trained for.
        here: what it should have been.
    """
    if not model:
        yield "it does not say what it was trained for"
        return
    for name in ("schema", "features", "lambdas", "statistics"):
        if model.get(name) != here[name]:
            yield (
                f"its {name} are those of another version"
                if name != "schema"
                else (f"its schema is {model.get(name)}, this program's is {here[name]}")
            )
    for name, value in here["settings"].items():
        was = _part(model, "settings").get(name)
        if was != value:
            yield f"it was trained with {name}={was}, not {value}"
    before, now = _part(model, "switches"), here["switches"]
    for name in sorted(before.keys() | now.keys()):
        if before.get(name) != now.get(name):
            yield f"switch {name} was {_place(before.get(name))} and is {_place(now.get(name))}"


def _part(model: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    part = model.get(name)
    return part if isinstance(part, dict) else {}


def _place(ports: object) -> str:
    return ", ".join(map(str, ports)) if isinstance(ports, list) and ports else "not there"


class KeptModel:
    """A model's file.

    Args:
        path: of the file.
        here: what a model must have been trained for.
    """

    def __init__(self, path: Path, here: Mapping[str, Any]) -> None:
        self.path = path
        self._here = dict(here)
        self.text = ""
        """What happened to the file at the start, in one line."""

    def detector(self, settings: DetectorSettings, kernel: Kernel) -> Detector | None:
        """A detector with the kept model; None where there is none of use, and `text` says why."""
        if not self.path.exists():
            self.text = f"no model is kept yet; it will be in {self.path}"
            return None
        try:
            model = load_model(self.path, clip=settings.scale_limit, kernel=kernel)
            why = "; ".join(differences(_trained_for(model), self._here))
            found = None if why else Detector(settings, model=model, kernel=kernel)
        except ModelFileError as error:
            found, why = None, str(error)
        if found is not None:
            self.text = f"using the kept model of {day(found.trained_at_us)} from {self.path}"
            return found
        aside = self.set_aside()
        self.text = f"training again: {why}; the old model is kept as {aside}"
        return None

    def set_aside(self) -> Path | None:
        """Rename the file, so that the next start trains; returns its new name, None if there is no file."""
        return set_aside(self.path)

    def keep(self, detector: Detector) -> None:
        """Write a trained model; raises `ModelFileError`."""
        detector.trained_for = self._here
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        detector.save(self.path)


def set_aside(path: Path) -> Path | None:
    """Rename a kept model, and delete the oldest of those set aside before; None if there is none.

    Raises:
        OSError: it cannot be renamed.
    """
    stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime())
    aside = path.with_name(f"{path.stem}.old-{stamp}{path.suffix}")
    number = 1
    while aside.exists():
        number += 1
        aside = path.with_name(f"{path.stem}.old-{stamp}-{number}{path.suffix}")
    try:
        path.rename(aside)
    except FileNotFoundError:
        return None
    for old in models_aside(path)[MOST_ASIDE:]:
        old.unlink(missing_ok=True)
    return aside


def models_aside(path: Path) -> list[Path]:
    """Models that were set aside, the newest first."""
    found = [each for each in path.parent.glob(f"{path.stem}.old-*{path.suffix}") if each.is_file()]
    return sorted(found, key=lambda each: (each.stat().st_mtime_ns, each.name), reverse=True)


def _trained_for(model: Model) -> Mapping[str, Any]:
    found = model.notes.get("trained_for")
    return found if isinstance(found, dict) else {}


def day(time_us: int) -> str:
    """A capture time in words, to the minute."""
    return time.strftime("%Y-%m-%d %H:%MZ", time.gmtime(time_us / 1e6))
