"""`sdnator up` with nftables among its enforcers: a block by hand stops real packets, and everybody says where."""

import json

import pytest

from sdnator.testing.routed_lab import INPUT, SENDERS, RoutedLab
from sdnator.testing.waiting import wait_for
from tests.end_to_end.test_up import Operator, until
from tests.requirements import require_netns, require_program

CONFIGURATION = """\
[firewall]
enforcers = ["p4runtime_ctrl", "nftables"]
allow_surroundings = false

[nftables]
place = "gateway"
at_end = "remove"
"""


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_block_by_hand_stands_in_the_switch_and_on_the_host(tmp_path):
    """Add, list, why, remove; and the enforcer is a part like all others."""
    require_netns()
    require_program("nft")
    operator = Operator(tmp_path)
    chosen = tmp_path / "sdnator.toml"
    chosen.write_text(CONFIGURATION, encoding="utf-8")
    with RoutedLab() as lab, lab.inside("gateway"), operator.up("--config", str(chosen)) as (_, said):
        assert "nftables" in said["parts"]
        until(operator.well)
        with lab.path(INPUT[4]) as path:
            wait_for(path.passes)
            added = until(lambda: operator.run("blocks", "add", SENDERS[4], "--reason", "a test"))
            assert added.returncode == 0, added.stderr
            wait_for(lambda: not path.passes())
            found = until(lambda: _standing(operator))
            assert found["target"]["address"] == SENDERS[4]
            assert {(each["enforcer"], each["place"]) for each in found["enforcers"]} == {
                ("p4runtime_ctrl", "s1"),
                ("nftables", "gateway"),
            }
            line = " ".join(operator.run("blocks", "list").stdout.split())  # long lines are wrapped
            assert " block 10.77.1.2" in line
            assert "in force: nftables gateway, switch s1" in line
            why = " ".join(operator.run("blocks", "why", found["id"]).stdout.split())
            assert "in force: nftables gateway, switch s1" in why
            assert "nftables gateway: installed" in why
            assert operator.run("blocks", "remove", SENDERS[4]).returncode == 0
            wait_for(path.passes)


def _standing(operator):
    """The block, once both enforcers have confirmed it."""
    done = operator.run("blocks", "list", "--json")
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)
    return next(
        (row for row in rows if sum(each["state"] == "installed" for each in row["enforcers"]) == 2), None
    )
