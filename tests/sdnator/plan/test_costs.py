"""A file of costs is checked before anything is calculated with it."""

import json

import msgspec
import pytest

from sdnator.errors import BadInput
from sdnator.plan.costs import Costs, ProcessCost, decoded, read, write
from sdnator.plan.default_costs import default_costs

GOOD = {
    "machine": "some processor",
    "cores": 2,
    "measured": "2026-11-25",
    "rates": [100, 1000],
    "processes": {"switch": {"us_per_packet": [10, 5]}},
}


def test_what_is_written_can_be_read(tmp_path):
    costs = Costs(
        machine="some processor",
        cores=4,
        measured="2026-11-25",
        error=0.12,
        rates=(10.0,),
        processes={"kitsune": ProcessCost(us_per_packet=(3.5,))},
    )
    write(tmp_path / "costs.json", costs)
    assert read(tmp_path / "costs.json") == costs


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"rates": []}, "rates"),
        ({"rates": [0, 5]}, "rates"),
        ({"rates": [1000, 100]}, "ascending"),
        ({"processes": {}}, "must name at least one"),
        ({"processes": {"switch": {"us_per_packet": [10]}}}, "2 values"),
        ({"processes": {"switch": {"us_per_packet": [10, -5]}}}, "negative"),
        ({"processes": {"switch": {"mib": -1}}}, "negative"),
        ({"archive": [1, 2, 3]}, "2 values"),
        ({"error": -0.1}, "negative"),
        ({"schema": 2}, "measure again"),
        ({"machine": None}, "machine"),
        ({"more": 1}, "more"),
    ],
)
def test_wrong_costs_are_refused(change, word):
    with pytest.raises(BadInput, match=word):
        decoded(json.dumps(GOOD | change), "--costs x")
    assert decoded(json.dumps(GOOD), "--costs x").rates == (100, 1000)


@pytest.mark.parametrize("text", [b"", b"{", b"[]", b"\xff\xfe", b'{"rates": [1e999]}', b"[" * 100_000])
def test_other_files_are_refused(text, tmp_path):
    (tmp_path / "costs.json").write_bytes(text)
    with pytest.raises(BadInput, match=r"costs\.json: .*--measure"):
        read(tmp_path / "costs.json")


def test_missing_and_large_files_are_refused(tmp_path):
    with pytest.raises(BadInput, match="No such file"):
        read(tmp_path / "none.json")
    with pytest.raises(BadInput, match="Is a directory"):
        read(tmp_path)
    (tmp_path / "large.json").write_bytes(b" " * ((1 << 20) + 1))
    with pytest.raises(BadInput, match="larger than"):
        read(tmp_path / "large.json")
    with pytest.raises(BadInput, match="No such file"):
        write(tmp_path / "none" / "costs.json", default_costs())


def test_the_product_brings_costs_that_say_where_they_are_from():
    """Every process of a pipeline is among them."""
    costs = default_costs()
    assert costs.machine
    assert costs.measured
    parts = {"coordinator", "dashboard", "firewall", "kitsune", "p4runtime_ctrl", "sonata_adapter"}
    assert {*parts, "spare", "supervisor", "switch", "updates"} == set(costs.processes)
    assert {name for name, each in costs.processes.items() if each.per_switch} == {"switch", "spare"}
    assert msgspec.json.decode(msgspec.json.encode(costs), type=Costs) == costs
