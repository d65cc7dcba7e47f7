"""`sdnator incidents`: rows and details from archived items alone."""

import json

import pytest
from msgspec import structs
from typer.testing import CliRunner

from due import Item
from due.backends import open_archive
from sdnator.cli.blocks_commands import blocks
from sdnator.cli.incidents_commands import incidents
from sdnator.errors import BadInput
from tests.apps.firewall.incidents.samples import decision
from tests.sdnator.incidents.samples import life


@pytest.fixture
def archive(tmp_path):
    """URL of an archive with an incident that is over, an open one, a part of another, and nonsense."""
    told = life()
    started = structs.replace(told[0], id="later", begun=told[0].begun + 10**9)
    part = structs.replace(told[-1], id="part", joined=told[0].id)
    values = [each.to_value() for each in (*told, part, started)]
    items = [("network.incident.firewall.scan", value, "firewall") for value in values]
    items.append(("network.incident.firewall.scan", {"id": 5}, "firewall"))
    items.append(("network.incident.firewall.scan", values[0] | {"id": "foreign"}, "stranger"))
    items.append(("network.block.firewall.mac", decision().to_value(), "firewall"))
    url = f"sqlite://{tmp_path / 'archive.db'}"
    driver = open_archive(url)
    driver.insert([Item(key, value, n, n, app, "i", n) for n, (key, value, app) in enumerate(items, 10)])
    driver.close()
    return url


def run(group, *words: str) -> str:
    done = CliRunner().invoke(group, words)
    if done.exception is not None:
        raise done.exception
    return done.stdout


def test_two_lines_each(archive):
    lines = run(incidents, "list", "--archive", archive).splitlines()
    assert max(map(len, lines)) <= 100
    assert lines[0].startswith(life()[0].id)
    assert "over: blocked 5c:cf:7f:05:f2:c6 port 1, over (70 packets stopped)" in lines[1]
    assert any(line.startswith("later") for line in lines)
    (only,) = json.loads(run(incidents, "list", "--open", "--json", "--archive", archive))
    assert (only["id"], only["mitigated"], only["done"]) == ("later", False, "nothing")


def test_nothing_since(archive):
    assert run(incidents, "list", "--since", "1h", "--archive", archive) == "no incidents\n"
    assert run(incidents, "list", "--since", "1h", "--open", "--archive", archive) == "no incident is open\n"


def test_one_is_shown_by_its_id_or_by_a_decision(archive):
    shown = run(incidents, "show", "d1", "--archive", archive)
    assert shown == run(incidents, "show", life()[0].id, "--archive", archive)
    assert "attacker: 192.168.2.108 (5c:cf:7f:05:f2:c6, port 1 of s1)" in shown
    assert json.loads(run(incidents, "show", "d1", "--json", "--archive", archive))["state"] == "over"
    with pytest.raises(BadInput, match="has the id nobody"):
        run(incidents, "show", "nobody", "--archive", archive)


def test_why_names_the_sum_and_the_incident(archive):
    """`blocks why` says it in five lines, from the incident's archived reports."""
    five, rest = run(blocks, "why", "d1", "--archive", archive).split("\n\n")
    assert sum(not line.startswith(" ") for line in five.splitlines()) == 5
    assert "10.0 nats of evidence; the bound was 10.0" in five
    assert rest.startswith(f"part of incident {life()[0].id}")
