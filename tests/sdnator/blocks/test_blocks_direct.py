"""`blocks panic` on a switch itself: whoever is its controller, it is cleared, and guards of the settings stay."""

import json

import pytest
from typer.testing import CliRunner

from apps.messages import Decision, Target
from apps.p4runtime_ctrl.state.desired_switch import DesiredSwitch
from due import Item
from due.backends import open_archive
from p4rt import INSECURE
from sdnator.blocks.blocks_archive import all_decisions, key_of
from sdnator.blocks.blocks_direct import lift_in_switch
from sdnator.cli.blocks_commands import blocks
from sdnator.cli.switch_commands import tables
from sdnator.errors import PipelineError
from sdnator.testing.controller_run import Bystander
from sdnator.testing.product_program import program
from sdnator.testing.switch_double import SwitchDouble
from tests.apps.firewall.enforcement.test_eve import decision

WEB = Target(kind="ip", address="10.0.0.1", port=80)
SHOP = Target(kind="ip", address="10.0.0.1", port=443)


def made(number: int, **changes) -> Decision:
    return decision(id=f"d{number}", switch="*", **changes)


DECISIONS = [
    made(1),
    made(2, target=Target(kind="ip", address="2001:db8::1")),
    made(3, target=Target(kind="mac", address="02:00:00:00:00:01", port=1)),
    made(4, target=Target(kind="mac", address="02:00:00:00:00:02")),
    made(5, action="protect", target=WEB),
    made(6, action="protect", target=SHOP, expires=2_000_000_000_000_000_000),
]


@pytest.fixture
def switch():
    """A switch with blocks and guards, whose controller has gone."""
    with SwitchDouble() as embedded:
        with Holder(embedded.address) as holder:
            desired = DesiredSwitch("s1", program(), lambda: (0, 0))
            desired.bring_up(holder.session)
            said = desired.decide(DECISIONS, holder.session)
            assert {each.state for each in said} == {"installed"}
        yield embedded.address


class Holder(Bystander):
    """A primary that keeps its session."""

    def became_primary(self, session) -> None:
        self.session = session
        super().became_primary(session)


@pytest.fixture
def archive(tmp_path) -> str:
    """What a firewall has written of these decisions."""
    url = f"sqlite://{tmp_path / 'archive.db'}"
    driver = open_archive(url)
    driver.insert(
        [
            Item(key_of(each), each.to_value(), n, n, "firewall", "f1", n)
            for n, each in enumerate(DECISIONS, 1)
        ]
    )
    driver.close()
    return url


def entries(address: str, capsys) -> dict[str, int]:
    capsys.readouterr()
    tables(address, as_json=True)
    rows = json.loads(capsys.readouterr().out)["entries"]
    names = [row["table"].removeprefix("ingress.") for row in rows if not row["default"]]
    watched = ("block_src", "block_mac", "block", "protect")
    return {name: names.count(name) for name in watched if name in names}


def test_clears_blocks_and_the_guards_that_are_named(switch, capsys):
    """A guard that is not there is no error; what else is in the switch stays."""
    assert entries(switch, capsys) == {"block_src": 2, "block_mac": 1, "block": 1, "protect": 2}
    assert lift_in_switch(switch, 1, [("10.0.0.1", 443), ("10.0.0.7", 22)]) == 5
    assert entries(switch, capsys) == {"protect": 1}
    assert lift_in_switch(switch, 1) == 0


def test_takes_the_place_of_a_controller_that_is_there(switch, capsys):
    """With the next higher election id; and leaves it."""
    with Holder(switch, rank=7):
        assert lift_in_switch(switch, 1) == 4
    assert entries(switch, capsys) == {"protect": 2}


def test_panic_without_a_firewall(switch, archive, capsys):
    """Archive and switch agree afterwards; guards of the settings have no end, and stay."""
    done = CliRunner().invoke(blocks, ["panic", "--direct", "--archive", archive, "--switch", switch])
    assert done.exception is None, done.output
    assert "5 decisions lifted in Data Archives" in done.stdout
    assert "5 entries deleted" in done.stdout
    assert entries(switch, capsys) == {"protect": 1}
    lifted = [each for each in all_decisions(archive) if each.action in ("unblock", "unprotect")]
    assert [each.id for each in lifted] == ["d1", "d2", "d3", "d4", "d6"]


def test_panic_without_an_archive(switch, tmp_path, capsys):
    """The switch is cleared all the same; that controllers may bring blocks back is said."""
    (tmp_path / "file").touch()
    nowhere = f"sqlite://{tmp_path / 'file' / 'archive.db'}"
    done = CliRunner().invoke(blocks, ["panic", "--direct", "--archive", nowhere, "--switch", switch])
    assert done.exception is None, done.output
    assert "may bring blocks back" in done.stderr
    assert entries(switch, capsys) == {"protect": 2}


def test_switch_that_is_none():
    """Named, with what went wrong."""
    with pytest.raises(PipelineError, match=r"switch at 127\.0\.0\.1:1: UNAVAILABLE"):
        lift_in_switch("127.0.0.1:1", 1, security=INSECURE)


def test_nothing_runs(monkeypatch, tmp_path):
    """What to do is said."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    done = CliRunner().invoke(blocks, ["panic", "--direct", "--archive", f"sqlite://{tmp_path / 'a.db'}"])
    assert isinstance(done.exception, PipelineError)
    assert "--switch HOST:PORT" in str(done.exception)
