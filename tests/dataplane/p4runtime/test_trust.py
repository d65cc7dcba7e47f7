"""Only the product's own program and those that the operator has named are compiled and loaded."""

import json
import os
import subprocess
import sys
from pathlib import Path

import grpc
import pytest
from typer.testing import CliRunner

from dataplane.compiler import c_build
from dataplane.p4runtime.trust import (
    AnyProgram,
    TrustedPrograms,
    TrustError,
    own_program,
    program_hash,
    read_program,
    read_trusted,
)
from sdnator.cli.main import app
from sdnator.testing.p4runtime_client import P4RuntimeClient, program_config
from sdnator.testing.switch_double import SwitchDouble
from tests.dataplane.compiler.test_names import STANDARD

PROGRAM = Path(__file__).parents[1] / "programs" / "features"
OWN = own_program().with_suffix("")
ACTIONS = ("VERIFY", "VERIFY_AND_SAVE", "VERIFY_AND_COMMIT", "RECONCILE_AND_COMMIT")


@pytest.fixture
def listed(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    return tmp_path / "sdnator" / "trusted-programs"


def refused(switch, config, action="VERIFY_AND_COMMIT"):
    with P4RuntimeClient(switch.address) as controller:
        controller.arbitrate()
        with pytest.raises(grpc.RpcError) as caught:
            controller.set_pipeline(config, action)
        return caught.value.code().name, caught.value.details()


def hostile(mark):
    """Code of the attacker's in the name of a field, run when the library is loaded."""
    document = json.loads(PROGRAM.with_suffix(".json").read_text())
    code = f'x\n#include <stdio.h>\n__attribute__((constructor)) static void x(void) {{ fopen("{mark}", "w"); }}\n//'
    next(t for t in document["header_types"] if t["name"] == STANDARD)["fields"].append([code, 32, False])
    document["field_lists"][0]["elements"].append({"type": "field", "value": [STANDARD, code]})
    config = program_config(PROGRAM)
    config.p4_device_config = json.dumps(document).encode()
    return config


@pytest.mark.parametrize("action", ACTIONS)
def test_code_in_the_name_of_a_field_is_neither_compiled_nor_run(tmp_path, monkeypatch, action):
    compiled = []
    monkeypatch.setattr(c_build, "_compile", lambda *given: compiled.append(given))
    with SwitchDouble(programs=TrustedPrograms()) as switch:
        code, text = refused(switch, hostile(tmp_path / "mark"), action)
    assert (code, compiled, (tmp_path / "mark").exists()) == ("PERMISSION_DENIED", [], False)
    assert "sdnator program trust" in text


def test_in_a_switch_that_takes_every_program_it_is_a_field_like_others(tmp_path):
    """The second wall: names do not reach the source."""
    with (
        SwitchDouble(programs=AnyProgram()) as switch,
        P4RuntimeClient(switch.address) as controller,
    ):
        controller.arbitrate()
        controller.set_pipeline(hostile(tmp_path / "mark"))
        assert switch.device.pipeline is not None
    assert not (tmp_path / "mark").exists()


def test_the_product_s_program_needs_no_word():
    with SwitchDouble(programs=TrustedPrograms()) as switch, P4RuntimeClient(switch.address) as controller:
        controller.arbitrate()
        controller.set_pipeline(program_config(OWN), "VERIFY")


def test_a_byte_more_is_another_program():
    config = program_config(OWN)
    config.p4_device_config += b"\n"
    with SwitchDouble(programs=TrustedPrograms()) as switch:
        code, text = refused(switch, config, "VERIFY")
    assert code == "PERMISSION_DENIED"
    assert program_hash(config) in text


def test_an_operator_s_word_holds_at_once_and_can_be_taken_back(listed):
    run = CliRunner().invoke
    config, file = program_config(PROGRAM), str(PROGRAM.with_suffix(".json"))
    with SwitchDouble(programs=TrustedPrograms(file=listed)) as switch:
        assert refused(switch, config)[0] == "PERMISSION_DENIED"
        assert run(app, ["program", "trust", file]).exit_code == 0
        with P4RuntimeClient(switch.address) as controller:
            controller.arbitrate()
            controller.set_pipeline(config)
        assert program_hash(config) in run(app, ["program", "list"]).output
        assert listed.stat().st_mode & 0o777 == 0o600
        assert run(app, ["program", "untrust", file]).exit_code == 0
        assert refused(switch, config)[0] == "PERMISSION_DENIED"


@pytest.mark.parametrize("mode", ["file", "folder"])
def test_a_list_that_others_can_write_is_not_believed(listed, mode):
    listed.parent.mkdir(parents=True)
    listed.write_text("0" * 64)
    (listed if mode == "file" else listed.parent).chmod(0o777)
    with pytest.raises(TrustError, match="could be written by others"):
        read_trusted(listed)


def test_a_list_of_somebody_else_is_not_believed(listed, monkeypatch):
    listed.parent.mkdir(parents=True)
    listed.write_text("0" * 64)
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    if listed.stat().st_uid == 0:
        os.chown(listed, 54321, -1)
    with pytest.raises(TrustError, match="could be written by others"):
        read_trusted(listed)


@pytest.mark.parametrize("text", ["nonsense", "A" * 64, "0" * 63, "x" * (2 << 20)])
def test_a_list_that_is_none_is_an_error(listed, text):
    listed.parent.mkdir(parents=True)
    listed.write_text(text)
    with pytest.raises(TrustError):
        read_trusted(listed)


def test_a_p4info_with_a_number_that_its_field_cannot_hold_is_an_error(tmp_path):
    program = tmp_path / "x.json"
    program.write_text("{}")
    program.with_suffix(".p4info.txtpb").write_text("tables { match_fields { match_type: 4294967295 } }")
    with pytest.raises(TrustError, match="give the BMv2 JSON that p4c wrote"):
        read_program(program)


def test_a_wrong_hash_on_the_command_line_is_one_line():
    done = subprocess.run(
        [sys.executable, "-m", "dataplane", "--trust", "abc"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, "not a SHA-256" in done.stderr) == (2, True)
