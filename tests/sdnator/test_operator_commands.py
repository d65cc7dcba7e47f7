"""All operator's commands: help with an example, and nothing heavy imported before it is needed."""

import json
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from tests.end_to_end.operator_app import COMMANDS, app

HEAVY = (
    "numpy",
    "scipy",
    "grpc",
    "google.protobuf",
    "redis",
    "rich.markdown",
    "uvicorn",
    "due",
    "coordinator",
    "apps",
)
LOADED = """
import json, sys
import tests.end_to_end.operator_app
print(json.dumps(sorted(sys.modules)))
"""


@pytest.mark.parametrize("name", [command.__name__ for command in COMMANDS])
def test_every_help_has_an_example(name):
    done = CliRunner().invoke(app, [name, "--help"], catch_exceptions=False, env={"COLUMNS": "200"})
    assert done.exit_code == 0
    assert f"Example: sdnator {name}" in done.stdout


@pytest.mark.parametrize("name", [command.__name__ for command in COMMANDS])
def test_an_unknown_option_is_misuse(name):
    assert CliRunner().invoke(app, [name, "--no-such-option"]).exit_code == 2


def test_importing_the_commands_loads_nothing_heavy():
    """Each heavy module costs a share of the 300 ms in which `sdnator --help` has to answer."""
    done = subprocess.run([sys.executable, "-c", LOADED], capture_output=True, text=True, check=True)
    loaded = set(json.loads(done.stdout))
    assert [name for name in HEAVY if name in loaded] == []
