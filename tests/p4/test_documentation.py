"""docs/dataplane.md explains every table, register, counter, meter and digest of the program, and no other."""

import re
from pathlib import Path

import pytest

from apps.sonata_adapter.planner.placement import SwitchLimits
from sdnator import p4_program
from sdnator.testing.p4runtime_client import program_config
from tests.contract.differences import markdown

_DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "dataplane.md"
_STAGES = SwitchLimits().stages


def section(title):
    """The names in the first column of a section's table."""
    text = _DOCUMENT.read_text(encoding="utf-8").split(f"### {title}\n")[1].split("\n#")[0]
    rows = re.findall(r"^\| `([^`]+)` \|(.*)\|$", text, re.MULTILINE)
    assert all(explanation.split("|")[-1].strip() for _, explanation in rows)
    names = [name for name, _ in rows]
    stages = [name.replace("count_N", f"count_{n}") for name in names for n in range(_STAGES) if "N" in name]
    return sorted([name for name in names if "count_N" not in name] + stages)


def named(*kinds):
    info = program_config(p4_program.find().bmv2_json.with_suffix("")).p4info
    return sorted(
        thing.preamble.name.removeprefix("ingress.") for kind in kinds for thing in getattr(info, kind)
    )


@pytest.mark.parametrize(
    ("title", "kinds"),
    [
        ("Tables", ["tables"]),
        ("Registers", ["registers"]),
        ("Counters, meters, digests", ["counters", "meters", "digests"]),
    ],
)
def test_all_of_the_program_is_explained(title, kinds):
    assert section(title) == named(*kinds)


def test_marks_of_tables_are_true():
    """● a direct counter, ◐ a direct meter too, ⏲ idle time-outs."""
    info = program_config(p4_program.find().bmv2_json.with_suffix("")).p4info
    counted = {counter.direct_table_id for counter in info.direct_counters}
    metered = {meter.direct_table_id for meter in info.direct_meters}
    text = _DOCUMENT.read_text(encoding="utf-8")
    for table in info.tables:
        name = re.sub(r"count_\d+", "count_N", table.preamble.name.removeprefix("ingress."))
        marks = re.search(rf"^\| `{re.escape(name)}` \|([^|]*)\|", text, re.MULTILINE).group(1).split()
        number = table.preamble.id
        mark = "◐" if number in metered else "●" if number in counted else ""
        timed = "⏲" if table.idle_timeout_behavior else ""
        assert marks == [found for found in (mark, timed) if found], name


def test_differences_from_bmv2_are_listed():
    assert markdown() in _DOCUMENT.read_text(encoding="utf-8")
