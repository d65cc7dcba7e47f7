"""`sdnator blocks` and `sdnator allow` against a running firewall, and `panic` without one."""

import json
import time

import pytest
from typer.testing import CliRunner

from due.drivers.embedded_redis import EmbeddedServer
from sdnator.blocks_commands import allow, blocks, lift_in_archive, nft_sets
from sdnator.errors import BadInput
from sdnator.process import Child
from tests.apps.firewall.test_eve import decision


@pytest.fixture
def firewall(tmp_path):
    """URLs of a running firewall's backends."""
    eve = tmp_path / "eve.json"
    settings = tmp_path / "firewall.json"
    settings.write_text(json.dumps({"eve_file": str(eve), "rules": {"allow": ["10.0.0.1"]}}))
    archive = f"sqlite:///{tmp_path / 'archive.db'}"
    with EmbeddedServer(tmp_path / "updates") as server:
        arguments = ("--updates", server.url, "--archive", archive, "--settings", str(settings))
        child = Child("firewall", ["apps.firewall.service", *arguments], tmp_path)
        try:
            child.wait_ready()
            yield ["--updates", server.url, "--archive", archive], ["--archive", archive], eve
        finally:
            child.stop()


def run(group, *arguments: str) -> str:
    done = CliRunner().invoke(group, arguments)
    if done.exception is not None:
        raise done.exception
    return done.stdout


def listed(text: str, archive: list[str]) -> str:
    """`blocks list`, as soon as the archive has it: the firewall answers before the archive is written."""
    for _ in range(200):
        shown = run(blocks, "list", *archive)
        if text in shown:
            return shown
        time.sleep(0.02)
    raise AssertionError(shown)


def test_life_of_a_block_by_hand(firewall):
    """Add, list, explain, refuse what is allowed, lift by an allow-list entry, panic."""
    both, archive, eve = firewall
    answer = run(blocks, "add", "192.0.2.66", "--reason", "ticket 4711", *both)
    assert "of 192.0.2.66 for 600 s" in answer
    assert "192.0.2.66" in listed("ticket 4711", archive)
    (shown,) = json.loads(run(blocks, "list", "--json", *archive))
    assert "network.instruction.operator.firewall" in run(blocks, "why", shown["id"], *archive)
    assert "elements = { 192.0.2.66 }" in run(blocks, "list", "--nft", *archive)
    with pytest.raises(BadInput, match="allow-list"):
        run(blocks, "add", "10.0.0.1", *both)
    assert "1 blocks lifted" in run(allow, "add", "192.0.2.0/24", *both)
    listed("nothing is blocked", archive)
    assert run(allow, "list", *archive) == "192.0.2.0/24\n"
    run(blocks, "add", "198.51.100.1", *both)
    assert "1 lifted" in run(blocks, "panic", *both)
    listed("nothing is blocked", archive)
    events = [json.loads(line)["alert"]["category"] for line in eve.read_text().splitlines()]
    assert events == ["block", "unblock", "block", "unblock"]


def test_unknown_id_is_named(tmp_path):
    """And where ids are to be seen."""
    with pytest.raises(BadInput, match=r"no decision has the id abc.*--all"):
        run(blocks, "why", "abc", "--archive", f"sqlite:///{tmp_path / 'archive.db'}")


def test_empty_archive_has_nothing_to_lift(tmp_path):
    """Panic without a firewall is no error."""
    assert lift_in_archive(f"sqlite:///{tmp_path / 'archive.db'}") == 0


def test_nft_sets_by_family():
    """Guards are no blocks."""
    text = nft_sets([decision(), decision(action="protect")])
    assert "set blocked4 { type ipv4_addr; elements = { 192.0.2.1 }; }" in text
    assert "set blocked6 { type ipv6_addr; }" in text
