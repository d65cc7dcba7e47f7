"""Target list for Prometheus, in the format of `file_sd_configs`."""

import json
from collections.abc import Mapping
from pathlib import Path

from sdnator.errors import BadInput


def targets(endpoints: Mapping[str, str]) -> list[dict[str, object]]:
    """One group per part, labelled with its name."""
    return [
        {"targets": [address], "labels": {"job": "sdnator", "part": part}}
        for part, address in sorted(endpoints.items())
        if address
    ]


def write_targets(path: str, endpoints: Mapping[str, str]) -> None:
    """Replace the file atomically, since Prometheus may read it at any time; an empty path writes nothing."""
    if not path:
        return
    file = Path(path)
    new = file.with_name(file.name + ".new")
    try:
        new.write_text(json.dumps(targets(endpoints), indent=2) + "\n", encoding="utf-8")
        new.replace(file)
    except OSError as error:
        raise BadInput(f"metrics.targets {path}: {error.strerror}; give a file that can be written") from None
