"""The ruleset of active blocks is one that nftables loads, whatever is blocked."""

import subprocess

import pytest

from apps.messages import Target
from sdnator.blocks.blocks_nft import nft_sets
from tests.apps.firewall.enforcement.test_eve import decision
from tests.requirements import require_netns, require_program

BLOCKS = [
    decision(),
    decision(target=Target(kind="ip", address="192.0.2.0/24")),
    decision(target=Target(kind="ip", address="2001:db8::1")),
    decision(target=Target(kind="ip", address="2001:db8::/64")),
    decision(target=Target(kind="mac", address="02:00:00:00:00:01", port=3)),
]


def test_sets_by_family():
    """Guards and dry runs are no blocks; each address once."""
    text = nft_sets([*BLOCKS, decision(), decision(action="protect"), decision(dry_run=True)])
    assert "elements = { 192.0.2.0/24, 192.0.2.1 };" in text
    assert "elements = { 2001:db8::/64, 2001:db8::1 };" in text
    assert "elements = { 02:00:00:00:00:01 };" in text


@pytest.mark.parametrize("blocks", [[], BLOCKS], ids=["none", "all kinds"])
def test_nftables_takes_it(blocks, tmp_path):
    """Checked, then loaded twice in a namespace of its own: it replaces itself."""
    require_netns()
    nft, unshare = require_program("nft"), require_program("unshare")
    rules = tmp_path / "blocks.nft"
    rules.write_text(nft_sets(blocks) + "\n")
    program = '"$0" -c -f "$1" && "$0" -f "$1" && "$0" -f "$1" && "$0" list table inet sdnator'
    command = [unshare, "--net", "sh", "-c", program, nft, str(rules)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("@blocked4 drop") == 2
    assert ("192.0.2.0/24" in done.stdout) == bool(blocks)
