"""`sdnator --help` knows every command without importing it, and says of it what its own help says."""

import json
import subprocess
import sys
from importlib import import_module
from itertools import pairwise

import pytest
import typer
from typer.main import get_group
from typer.testing import CliRunner

from sdnator.cli.main import COMMANDS, app

WIDE = {"COLUMNS": "300", "TERM": "dumb"}
LOADED = """
import json, sys
from typer.testing import CliRunner
from sdnator.cli.main import app
done = CliRunner().invoke(app, ["--help"])
print(json.dumps([done.exit_code, sorted(name for name in sys.modules if not name.startswith("_"))]))
"""


@pytest.mark.parametrize("name", COMMANDS)
def test_the_list_of_commands_says_what_their_own_help_begins_with(name):
    place, text = COMMANDS[name]
    module, _, attribute = place.partition(":")
    found = getattr(import_module(module), attribute)
    own = get_group(found).help if isinstance(found, typer.Typer) else found.__doc__
    assert " ".join((own or "").split()).startswith(text)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_answers_help(name):
    done = CliRunner().invoke(app, [name, "--help"], env=WIDE, catch_exceptions=False)
    assert done.exit_code == 0
    assert f"Usage: sdnator {name}" in done.stdout
    assert "Exit codes: " in done.stdout


@pytest.mark.parametrize("words", [*([name] for name in COMMANDS), ["app", "enrol"], ["restore"]])
def test_help_flows_to_the_width_of_the_terminal(words):
    """On 80 columns no word is cut, and no line ends early because the source's did."""
    shown = CliRunner().invoke(app, [*words, "--help"], env=WIDE | {"COLUMNS": "80"}).stdout
    prose = shown.partition("╭")[0].splitlines()
    for line, after in pairwise(each.strip() for each in prose):
        word = after.partition(" ")[0]
        if line and after and not word.endswith(":") and word not in ("Exit", "Usage:"):
            assert len(line) + len(word) + 3 > 78, line
    assert "…" not in shown.replace("SDNATOR_…", "")


def test_the_list_imports_none_of_them():
    """Each heavy module costs a share of the 300 ms in which `sdnator --help` has to answer."""
    done = subprocess.run([sys.executable, "-c", LOADED], capture_output=True, text=True, check=True)
    code, loaded = json.loads(done.stdout)
    heavy = {"numpy", "grpc", "redis", "due", "apps", "coordinator", "pydantic", "nicegui", "msgspec"}
    assert (code, heavy & set(loaded)) == (0, set())


@pytest.mark.parametrize("words", [[], ["blocks", "list"], ["replay"], ["detect"]])
def test_flags_do_not_seem_to_want_a_value(words):
    """`--version` and `--json` are given alone: no <bool> stands behind them."""
    shown = CliRunner().invoke(app, [*words, "--help"], env=WIDE).stdout
    assert "--help" in shown
    assert "bool" not in shown.lower()


def test_a_misspelt_command_is_met_with_the_right_one():
    done = CliRunner().invoke(app, ["statsu"], env=WIDE)
    assert done.exit_code == 2
    assert "status" in done.output


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete_commands_and_options(shell):
    """As the completion that `--install-completion` writes asks for it."""
    base = {"COMP_WORDS": "sdnator sta", "COMP_CWORD": "1", "_TYPER_COMPLETE_ARGS": "sdnator sta"}
    asked = base | {"_SDNATOR_COMPLETE": f"complete_{shell}", "_TYPER_COMPLETE_FISH_ACTION": "get-args"}
    assert "status" in CliRunner().invoke(app, [], env=asked, prog_name="sdnator").output
    words = {"COMP_WORDS": "sdnator status --js", "COMP_CWORD": "2"}
    asked |= words | {"_TYPER_COMPLETE_ARGS": "sdnator status --js"}
    assert "--json" in CliRunner().invoke(app, [], env=asked, prog_name="sdnator").output
    words = {"COMP_WORDS": "sdnator dataset fetch mi", "COMP_CWORD": "3"}
    asked |= words | {"_TYPER_COMPLETE_ARGS": "sdnator dataset fetch mi"}
    assert "mirai" in CliRunner().invoke(app, [], env=asked, prog_name="sdnator").output
