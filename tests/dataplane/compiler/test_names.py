"""Nothing that a program calls its parts reaches the generated source: only numbered names of ours do."""

import json
import re
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest

from dataplane.compiler import c_code, layout
from dataplane.compiler.layout import ENGINE_FIELDS, STANDARD
from dataplane.v1model.program import load
from dataplane.v1model.tree import Program
from tests.dataplane.loading import sdnator
from tests.naive.p4 import python_code

PROGRAMS = Path(__file__).resolve().parents[1] / "programs"
EVIL = (
    '*/"\'\\\n#include "/etc/passwd"\n__attribute__((constructor)) static void x(void){__builtin_trap();}\n/*'
)
FIXED = {STANDARD, *ENGINE_FIELDS, "ingress", "egress", "parser", "deparser"}
WORDS = ("type", "op", "algo", "match_type")
"""What these say is a word of the format."""
C_TEXT = """
    define typedef struct static const void int if else goto return switch case break for memcpy memset calloc
    sizeof error done parse ingress egress deparse digest keep_list machine_start phv machine replica replicas
    job zeros turns limbs sample uint8_t uint16_t uint32_t uint64_t int8_t int16_t int32_t int64_t ull
    instance port count length to changed sessions groups ports cpu_port stats out_used out_room seed out verdict budget
    head tail pkt size offset arrived truncate clone clone_list resubmit recirculate exit now from list reg o z
"""


def renamed(document: Any) -> Any:
    """The document with evil text in every name that is not part of v1model itself."""
    names = {
        item["name"]
        for part in document.values()
        if isinstance(part, list)
        for item in part
        if isinstance(item, dict) and "name" in item
    }
    names |= {field[0] for kind in document["header_types"] for field in kind["fields"]}
    names |= {param["name"] for action in document["actions"] for param in action["runtime_data"]}
    names |= {state["name"] for state in document["parsers"][0]["parse_states"]}
    for pipeline in document["pipelines"]:
        names |= {node["name"] for part in ("tables", "conditionals") for node in pipeline[part]}
    names -= FIXED

    def walk(value: Any, inside: str = "") -> Any:
        if isinstance(value, str):
            return value + EVIL if value in names and inside not in WORDS else value
        if isinstance(value, list):
            return [walk(item, inside) for item in value]
        if isinstance(value, dict):
            own = inside == "next_tables"  # whose keys are names, not words of the format
            return {walk(key) if own else key: walk(item, key) for key, item in value.items()}
        return value

    changed: Any = walk(document)
    changed["program"] = EVIL
    return changed


def sources(program: Program) -> tuple[str, str]:
    kept = layout.make(program)
    return c_code.generate(program, kept), python_code.generate(program, kept)[0]


@pytest.fixture(scope="module")
def document():
    return json.loads((PROGRAMS / "features.json").read_text())


def test_the_source_is_the_same_whatever_the_parts_are_called(document):
    text = json.dumps(renamed(document))
    assert text.count("__builtin_trap") > 500
    evil = load(text)
    assert any(EVIL in name for name in evil.tables)
    assert sources(evil) == sources(load(json.dumps(document)))


def test_a_further_field_of_standard_metadata_gets_a_number(document):
    kind = next(t for t in document["header_types"] if t["name"] == "standard_metadata")
    kind["fields"].append([EVIL, 32, False])
    document["learn_lists"][0]["elements"].append({"type": "field", "value": [STANDARD, EVIL]})
    c_text, python_text = sources(load(json.dumps(document)))
    assert "trap" not in c_text + python_text
    assert "passwd" not in c_text + python_text


@pytest.mark.parametrize("make", [sdnator, lambda: load((PROGRAMS / "features.json").read_bytes())])
def test_identifiers_are_numbered(make):
    """Beside words of C and of the engine, every identifier is a letter or two and a number."""
    runtime = "".join(
        files("dataplane.compiler").joinpath(name).read_text()
        for name in ("runtime_types.h", "runtime_tables.h", "runtime_engine.h")
    )
    known = set(re.findall(r"[A-Za-z_]\w*", runtime)) | set(C_TEXT.split())
    known |= {f"{kind}_{name}" for kind in ("HAS", "STD") for name in ENGINE_FIELDS}
    text = re.sub(r"\b0x[0-9a-f]+(ull)?\b|\b\d+(ull)?\b", "", sources(make())[0])
    others = set(re.findall(r"[A-Za-z_]\w*", text)) - known
    assert others
    assert {name for name in others if not re.fullmatch(r"[A-Za-z]\d+|STD_|W[48]_[a-z0-9]+", name)} == set()
