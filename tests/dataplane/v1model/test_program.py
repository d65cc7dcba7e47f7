"""What of BMv2 JSON is read, and that the rest is refused by name and place."""

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from dataplane.errors import ProgramError, Unsupported
from dataplane.v1model.program import load
from dataplane.v1model.tree import Const, ExecuteMeter, If, MatchKind
from tests.dataplane.loading import features, sdnator, shared

_FEATURES = Path(__file__).resolve().parents[1] / "programs" / "features.json"


@pytest.fixture(scope="module")
def document():
    return json.loads(_FEATURES.read_text())


def changed(document: dict[str, Any], change) -> str:
    altered = copy.deepcopy(document)
    change(altered)
    return json.dumps(altered)


def test_tables_as_the_control_plane_sees_them():
    tables = features().tables
    assert list(tables) == ["I.ports", "I.route", "I.flows", "I.maybe", "I.fixed"]
    flows = tables["I.flows"]
    assert [(k.name, k.kind, k.width) for k in flows.keys] == [
        ("h.test.c", MatchKind.RANGE, 16),
        ("h.test.d", MatchKind.TERNARY, 32),
        ("h.test.a", MatchKind.EXACT, 8),
    ]
    assert flows.has_meter
    assert flows.needs_priority
    route = tables["I.route"]
    assert (route.size, route.has_counter, route.has_idle_timeout) == (64, True, True)
    assert route.default == ("I.drop", ())
    assert not route.needs_priority
    assert tables["I.fixed"].is_const
    assert [e.action for e in tables["I.fixed"].const_entries] == ["I.label_as", "I.label_as", "I.drop"]


def test_arrays_and_digests():
    program = features()
    assert program.registers["I.wide_cells"].width == 200
    assert program.counters["I.seen"].size == 16
    assert program.meters["I.flow_rate"].table == "I.flows"
    assert {d.name: d.widths for d in program.digests.values()} == {"note_t": (9, 48, 32), "other_t": (8, 8)}


def test_jumps_inside_actions_become_conditions():
    bodies = [a.body for a in shared("sketch").actions]
    assert any(isinstance(s, If) and s.otherwise for body in bodies for s in body)


def test_the_products_own_program_loads():
    assert "ingress.block_src" in sdnator().tables


@pytest.mark.parametrize("text", ["", "[]", "{}", "nonsense", '{"pipelines": []}', '{"pipelines": 5}'])
def test_what_is_no_program_is_an_error(text):
    with pytest.raises(ProgramError):
        load(text)


def _primitive(document: dict[str, Any], op: str) -> dict[str, Any]:
    return next(p for a in document["actions"] for p in a["primitives"] if p["op"] == op)


REFUSED = {
    "primitive generate_number": lambda d: _primitive(d, "exit").update(op="generate_number"),
    "hash algorithm md5": lambda d: d["calculations"][0].update(algo="md5"),
    "table of type indirect": lambda d: d["pipelines"][0]["tables"][0].update(type="indirect"),
    "match kind selector": lambda d: next(t for t in d["pipelines"][0]["tables"] if t["key"])["key"][
        0
    ].update(match_type="selector"),
    "action profile p": lambda d: d["pipelines"][0].update(action_profiles=[{"name": "p"}]),
    "parser operation leap": lambda d: d["parsers"][0]["parse_states"][1]["parser_ops"][0].update(op="leap"),
    "transition of type parse_vset": lambda d: d["parsers"][0]["parse_states"][0]["transitions"][0].update(
        type="parse_vset"
    ),
    "checksum of type ipv4": lambda d: d["checksums"][0].update(type="ipv4"),
    "a meter of 1 rates": lambda d: d["meter_arrays"][0].update(rate_count=1),
    "width of 1000 bits": lambda d: d["register_arrays"][0].update(bitwidth=1000),
    "operator dereference": lambda d: d["pipelines"][0]["conditionals"][0].update(
        expression={"type": "expression", "value": {"op": "dereference", "left": None, "right": None}}
    ),
    "unstructured _jump": lambda d: _primitive(d, "exit").update(
        op="_jump", parameters=[{"type": "hexstr", "value": "0x0"}]
    ),
}


@pytest.mark.parametrize("what", list(REFUSED))
def test_what_is_outside_the_subset_is_refused_with_its_place(document, what):
    with pytest.raises(Unsupported, match=f"{what}.* is not supported by the embedded switch \\(at .+ .+\\)"):
        load(changed(document, REFUSED[what]))


@pytest.mark.parametrize("part", ["parse_vsets", "header_unions", "header_union_stacks", "extern_instances"])
def test_whole_parts_outside_the_subset_are_refused(document, part):
    with pytest.raises(Unsupported, match="this_one"):
        load(changed(document, lambda d: d.update({part: [{"name": "this_one"}]})))


def test_fields_that_do_not_exist_are_named(document):
    def change(d: dict[str, Any]) -> None:
        d["checksums"][0]["target"] = ["ip", "no_such_field"]

    with pytest.raises(ProgramError, match=r"ip\.no_such_field at checksum"):
        load(changed(document, change))


def test_missing_pieces_are_an_error_with_the_place(document):
    def change(d: dict[str, Any]) -> None:
        del d["actions"][0]["runtime_data"]

    with pytest.raises(ProgramError, match="malformed BMv2 JSON at action"):
        load(changed(document, change))


def test_meters_name_their_cell():
    found = [s for a in features().actions for s in a.body if isinstance(s, ExecuteMeter)]
    assert all(not isinstance(m.index, Const) for m in found)
    assert {m.array for m in found} == {"I.rate"}
