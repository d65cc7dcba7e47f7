"""Whatever bytes are given as a program, it is one, or refused with the one declared error, soon and in little memory."""

import json
import random
import tracemalloc
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataplane.compiler import c_code, layout
from dataplane.errors import DataplaneError, ProgramError, Unsupported
from dataplane.v1model import bmv2_json
from dataplane.v1model.program import load
from tests.naive.p4 import python_code

HERE = Path(__file__).resolve().parent
SMALL = (HERE / "programs" / "features.json").read_text()
OWN = (HERE.parents[1] / "p4" / "sdnator.json").read_text()
VALUES = (
    None, True, -1, 0, 1, 7, 255, 513, 2**31, 2**40, 2**64, 10**300, "", "x", "0x", "0xff", "-0x1", "0x" + "f" * 5000,
    "standard_metadata", "default", "\n#error", [], {}, [[]], ["scalars", "no"], {"type": "hexstr", "value": "0x5"},
    {"type": "expression", "value": {"op": "<<", "left": None, "right": None}},
    {"type": "lookahead", "value": [0, 2**40]}, {"type": "local", "value": -1}, {"type": "stack_field", "value": [1]},
)  # fmt: skip


@pytest.fixture
def document():
    return json.loads(SMALL)


def places(value: Any) -> list[tuple[Any, Any]]:
    """Every list or object of a document with each of its places."""
    found, waiting = [], [value]
    while waiting:
        item = waiting.pop()
        pairs = list(item.items() if isinstance(item, dict) else enumerate(item))
        found += [(item, key) for key, _ in pairs]
        waiting += [below for _, below in pairs if isinstance(below, dict | list)]
    return found


def mutate(document: Any, chance: random.Random) -> None:
    """Replace, remove or double something, or put a part of the document elsewhere."""
    every = places(document)
    holder, key = chance.choice(every)
    what = chance.random()
    if what < 0.5:
        holder[key] = chance.choice(VALUES)
    elif what < 0.7:
        other, place = chance.choice(every)
        holder[key] = json.loads(json.dumps(other[place]))
    elif isinstance(holder, dict) or what < 0.85:
        del holder[key]
    else:
        holder.append(holder[key])


def tried(text: str | bytes) -> None:
    with suppress(DataplaneError):
        program = load(text)
        kept = layout.make(program)
        c_code.generate(program, kept)
        compile(python_code.generate(program, kept)[0], "<generated>", "exec")


@settings(max_examples=120, deadline=None)
@given(seed=st.integers(0, 2**32), count=st.integers(1, 3))
def test_a_small_program_with_parts_exchanged(seed, count):
    chance, changed = random.Random(seed), json.loads(SMALL)
    for _ in range(count):
        mutate(changed, chance)
    tried(json.dumps(changed))


@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_the_product_s_program_with_parts_exchanged(seed):
    changed = json.loads(OWN)
    mutate(changed, random.Random(seed))
    with suppress(ProgramError):
        load(json.dumps(changed))


@settings(max_examples=100, deadline=None)
@given(at=st.integers(0, len(SMALL) - 1), cut=st.integers(0, 40), put=st.binary(max_size=8))
def test_a_program_with_bytes_exchanged(at, cut, put):
    data = SMALL.encode()
    tried(data[:at] + put + data[at + cut :])


def nested(depth: int, op: str = "/") -> Any:
    one: Any = {"type": "hexstr", "value": "0x3"}
    for _ in range(depth):
        one = {
            "type": "expression",
            "value": {"op": op, "left": {"type": "hexstr", "value": "0x2"}, "right": one},
        }
    return one


LIMITS = {
    "registers, counters and meters of": lambda d: d["register_arrays"][0].update(size=2**32),
    "size is 1099511627776": lambda d: d["register_arrays"][0].update(size=2**40),
    "nested deeper": lambda d: d["pipelines"][0]["conditionals"][0].update(expression=nested(150)),
    "more than 10000 operators": lambda d: d["pipelines"][0]["conditionals"][0].update(expression=nested(40)),
    "max_size is": lambda d: d["pipelines"][0]["tables"][0].update(max_size=2**40),
    "the same id": lambda d: d["actions"][1].update(id=d["actions"][0]["id"]),
    "the same name": lambda d: d["headers"][1].update(name=d["headers"][0]["name"]),
    "9000 actions": lambda d: d["actions"].extend([{}] * (9000 - len(d["actions"]))),
    "is 'x', and not within": lambda d: d["learn_lists"][0].update(id="x"),
    "an error's number is": lambda d: d["errors"][0].__setitem__(1, "0; system()"),
    "there is no header": lambda d: d["deparsers"][0].update(order=["standard_metadata"]),
}


@pytest.mark.parametrize("text", list(LIMITS))
def test_limits_are_named(document, text):
    LIMITS[text](document)
    with pytest.raises(ProgramError, match=text):
        load(json.dumps(document))


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, '{"a":' * 50_000, '{"pipelines": 1.5}', '{"a": 1, "a": 2}', "9" * 10_000, "\ud800"],
)
def test_what_upsets_json_itself_is_refused(text):
    with pytest.raises(ProgramError, match="not BMv2 JSON"):
        load(text)


def test_a_large_document_is_not_read_at_all():
    with pytest.raises(ProgramError, match="at most 8388608 are taken"):
        load(b" " * (bmv2_json.MAX_BYTES + 1))


def test_memory_follows_the_size_of_the_document():
    text = '{"pipelines": [' + ",".join(["[]"] * 1_500_000) + "]}"
    tracemalloc.start()
    with pytest.raises(ProgramError, match="values"):
        load(text)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 300 << 20


def test_a_chain_of_thousands_of_conditions_is_refused_and_not_recursed_into(document):
    """Each stands within the one before, when it is written out."""
    pipeline = document["pipelines"][0]
    pattern = pipeline["conditionals"][0]
    names = [f"c{number}" for number in range(3000)]
    for name, following in zip(names, [*names[1:], None], strict=True):
        pipeline["conditionals"].append(
            pattern | {"name": name, "true_next": following, "false_next": pipeline["init_table"]}
        )
    pipeline["init_table"], before = "c0", pipeline["init_table"]
    for condition in pipeline["conditionals"][-3000:]:
        condition["false_next"] = before
    program = load(json.dumps(document))
    for generate in (c_code.generate, python_code.generate):
        with pytest.raises(Unsupported, match="nested blocks"):
            generate(program, layout.make(program))
