"""What a switch says of its tables, as people read it; an embedded switch answers."""

import json
import subprocess
import sys
from typing import Any

import pytest
from typer.testing import CliRunner

from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from p4rt import p4runtime
from sdnator import p4_program
from sdnator.cli.switch_commands import _row
from sdnator.errors import BadInput, PipelineError
from tests.end_to_end.operator_app import app


@pytest.fixture(autouse=True)
def no_pipeline(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


@pytest.fixture(scope="module")
def program():
    return ProgramInfo.from_text(p4_program.find().p4info.read_text())


@pytest.fixture(scope="module")
def address():
    """A switch with our program, loaded by a controller that has left."""
    import grpc

    from p4rt import P4RuntimeStub

    command = [sys.executable, "-m", "dataplane"]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            where = json.loads(process.stdout.readline())["grpc"]
            with grpc.insecure_channel(where, options=[("grpc.max_send_message_length", -1)]) as channel:
                load(P4RuntimeStub(channel))
            yield where
        finally:
            process.terminate()


def load(stub):
    """Become primary, push the program, insert a block."""
    import queue

    requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
    hello = p4runtime.StreamMessageRequest()
    hello.arbitration.device_id = 1
    hello.arbitration.election_id.low = 1
    requests.put(hello)
    stream = stub.StreamChannel(iter(requests.get, None))
    assert next(stream).arbitration.status.code == 0
    files = p4_program.find()
    known = ProgramInfo.from_text(files.p4info.read_text())
    config = p4runtime.SetForwardingPipelineConfigRequest(device_id=1)
    config.election_id.low = 1
    config.action = p4runtime.SetForwardingPipelineConfigRequest.VERIFY_AND_COMMIT
    config.config.p4info.CopyFrom(known.message)
    config.config.p4_device_config = files.bmv2_json.read_bytes()
    stub.SetForwardingPipelineConfig(config, timeout=60)
    request = p4runtime.WriteRequest(device_id=1)
    request.election_id.low = 1
    update = request.updates.add(type=p4runtime.Update.INSERT)
    update.entity.table_entry.CopyFrom(block(known))
    stub.Write(request, timeout=60)
    requests.put(None)
    stream.cancel()


def block(known):
    """A drop of one MAC on port 1."""
    table = known.table("ingress.block_mac")
    entry = p4runtime.TableEntry(table_id=table.id)
    for field, value in zip(table.fields, (b"\x01", b"\xaa\xbb\xcc\xdd\xee"), strict=True):
        entry.match.add(field_id=field.id, exact={"value": value})
    entry.action.action.action_id = next(one.id for one in table.actions if "drop" in one.name)
    return entry


def run(*words):
    done = CliRunner().invoke(app, list(words), catch_exceptions=False)
    assert done.exit_code == 0
    return done.stdout


def test_tables_with_their_entries(address):
    lines = run("tables", address).splitlines()
    (row,) = (line for line in lines if line.startswith("ingress.block_mac "))
    assert row.split() == [
        "ingress.block_mac",
        "1",
        "16,384",
        "ingress.pass_mac()",
        "ingress_port,",
        "eth_src",
    ]


def test_one_table_entry_by_entry(address):
    shown = run("tables", address, "--table", "block_mac")
    assert "block_mac[ingress_port=1,eth_src=00:aa:bb:cc:dd:ee]" in shown
    with pytest.raises(BadInput, match="no table 'blocks'"):
        run("tables", address, "--table", "blocks")


def test_counters_of_blocks(address):
    found = json.loads(run("counters", address, "--json"))["counters"]
    (mine,) = (one for one in found if one["table"] == "ingress.block_mac")
    assert (mine["packets"], mine["bytes"], mine["default"]) == (0, 0, False)
    (line,) = (line for line in run("counters", address).splitlines() if "block_mac[" in line)
    assert line.index("ingress.block_mac[") < 40


def test_secrets_of_the_guard_are_not_shown(program):
    table = program.table("ingress.guard_secrets")
    entry = p4runtime.TableEntry(table_id=table.id, is_default_action=True)
    action = next(one for one in table.default_actions if one.params)
    entry.action.action.action_id = action.id
    for param in action.params:
        entry.action.action.params.add(param_id=param.id, value=b"\x2a")
    row = _row(program, entry)
    assert row["action"] == f"{action.name}(hidden)"
    assert "42" not in json.dumps(row)


def test_a_switch_that_does_not_answer_is_one_clear_error():
    with pytest.raises(PipelineError, match=r"switch at 127\.0\.0\.1:1: "):
        run("tables", "127.0.0.1:1", "--insecure")
    with pytest.raises(PipelineError, match="sdnator up"):
        run("counters", "s1")
