"""Command of a DUE app: URLs and settings are in private files, so that arguments hold no secrets."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from due.private_files import write_private_json
from sdnator.app_catalogue import OURS

MODULES: Mapping[str, str] = {
    "coordinator": "coordinator.service",
    "dashboard": "sdnator.dashboard",
    **{name: f"apps.{name}.service" for name in OURS},
}
"""Of the parts that belong to the product; others are run by their id."""


@dataclass(frozen=True, kw_only=True)
class Backends:
    """URLs of both backends; may hold passwords."""

    updates: str
    archive: str
    options: Mapping[str, Any] = field(default_factory=dict)
    """Further options of the DUE engine."""


def app_command(
    name: str,
    folder: Path,
    backends: Backends,
    settings: Mapping[str, Any],
    *,
    directory: Path | None = None,
    part: str = "",
) -> list[str]:
    """The arguments of `python -m`; writes PART.settings.json and PART.engine.json into the folder, mode 0600.

    Args:
        name: of the app.
        folder: for both files.
        backends: of the engine.
        settings: of the app.
        directory: where the engine keeps its spool; None: its default.
        part: name of the process, where an app has several; empty: the app's.
    """
    places = {"updates": backends.updates, "archive": backends.archive}
    if directory is not None:
        places["directory"] = str(directory)
    engine = write_private_json(folder / f"{part or name}.engine.json", {**backends.options, **places})
    chosen = write_private_json(folder / f"{part or name}.settings.json", settings)
    program = [MODULES[name]] if name in MODULES else ["sdnator.run_app", name]
    return [*program, "--engine", engine, "--settings", chosen]
