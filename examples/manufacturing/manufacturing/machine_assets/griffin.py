"""The header of a print file, as slicers write it for these printers (flavour Griffin), and job names.

The printer learns from it what it has to print: material (a GUID for each kind), volume and printing time.
"""

import re
from typing import Final
from uuid import UUID, uuid5

from manufacturing.core import process
from manufacturing.core.orders import ALL_SETUP_S, Task

_NAMESPACE: Final = UUID("6f6f2b1e-3c56-4e0c-9a37-5d3f9cb2a7a1")
MATERIALS: Final = tuple(str(uuid5(_NAMESPACE, f"kind-{kind}")) for kind in range(len(ALL_SETUP_S)))
"""GUID of the material and profile of each kind."""
_KINDS: Final = {guid: kind for kind, guid in enumerate(MATERIALS)}
_NAME: Final = re.compile(r"o(\d{1,6})-j(\d{1,6})-a(\d{1,6})")
_LINE: Final = re.compile(r";([A-Z0-9_.]+):(.*)")
_MOST_LINES: Final = 100


class BadPrintFile(ValueError):
    """A print file or job name is not understood; the text says what is wrong."""


def print_file(task: Task) -> str:
    """The file that prints a task; the moves themselves are left out."""
    seconds = process.planned_printing_s(task.volume)
    return "\n".join(
        (
            ";START_OF_HEADER",
            ";HEADER_VERSION:0.1",
            ";FLAVOR:Griffin",
            ";TARGET_MACHINE.NAME:Ultimaker 3",
            f";PRINT.TIME:{seconds:.0f}",
            f";EXTRUDER_TRAIN.0.MATERIAL.GUID:{MATERIALS[task.kind]}",
            f";EXTRUDER_TRAIN.0.MATERIAL.VOLUME_USED:{task.volume * 1_000:.2f}",
            f";SDNATOR.PRIORITY:{int(task.priority)}",
            ";END_OF_HEADER",
            "",
        )
    )


def read_task(name: str, text: str) -> Task:
    """The task of a job's name and its print file; raises BadPrintFile."""
    found = _NAME.fullmatch(name)
    if found is None:
        raise BadPrintFile(f"job name {name[:64]!r}: o<order>-j<number>-a<attempt>, such as o012-j003-a0")
    fields = _header(text)
    try:
        kind = _KINDS[fields["EXTRUDER_TRAIN.0.MATERIAL.GUID"].strip()]
        volume = round(float(fields["EXTRUDER_TRAIN.0.MATERIAL.VOLUME_USED"]) / 1_000, 5)
    except KeyError as error:
        raise BadPrintFile(f"the print file's header has no known {error.args[0]!r}") from None
    except ValueError:
        raise BadPrintFile("the print file's MATERIAL.VOLUME_USED is no number of mm³") from None
    if not 0 < volume <= 10_000:
        raise BadPrintFile(f"a part of {volume:g} cm³: above 0, up to 10,000")
    order, number, attempt = (int(part) for part in found.groups())
    return Task(order, number, attempt, kind, volume, fields.get("SDNATOR.PRIORITY") == "1")


def kind_of(guid: str) -> int:
    """The kind of a material; -1 for none.  Raises BadPrintFile."""
    if not guid:
        return -1
    if guid not in _KINDS:
        raise BadPrintFile(f"material {guid[:64]!r} is not known")
    return _KINDS[guid]


def _header(text: str) -> dict[str, str]:
    lines = text.splitlines()[:_MOST_LINES]
    if not lines or lines[0] != ";START_OF_HEADER" or ";END_OF_HEADER" not in lines:
        raise BadPrintFile("the print file has no header from ;START_OF_HEADER to ;END_OF_HEADER")
    matches = (_LINE.fullmatch(line) for line in lines[: lines.index(";END_OF_HEADER")])
    return {match[1]: match[2] for match in matches if match is not None}
