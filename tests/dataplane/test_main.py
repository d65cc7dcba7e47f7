"""The switch as a process: says when it is ready, ends when told, with its parent, or with one clear line."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import grpc
import pytest

from dataplane.capture_port import CaptureFeed
from dataplane.pcap_port import PcapReader, PcapWriter
from p4rt import P4RuntimeStub, p4runtime
from tests.dataplane.controller import TIMEOUT_S, Controller, Names, insert, program_config
from tests.requirements import require_program

PROGRAM = Path(__file__).parent / "programs" / "features"


def start(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "dataplane", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    )


def ended(process, number=signal.SIGTERM):
    process.send_signal(number)
    out, err = process.communicate(timeout=TIMEOUT_S)
    return process.returncode, out, err


def test_it_serves_and_ends_with_its_counts(tmp_path):
    process = start(
        "--port", f"1=capture:{tmp_path}/s", "--port", "2=null", "--state-json", "-", "--device-id", "7"
    )
    ready = json.loads(process.stdout.readline())
    assert (ready["ready"], ready["pid"]) == (True, process.pid)
    with Controller(ready["grpc"], device_id=7) as controller, CaptureFeed(f"{tmp_path}/s") as feed:
        assert controller.arbitrate().status.code == 0
        controller.set_pipeline(program_config(PROGRAM))
        feed.send([1], [60], [bytes(12) + b"\x88\xb5\x0f" + bytes(30)])
        assert controller.packets.get(timeout=TIMEOUT_S).metadata[0].value == b"\x01"
    code, out, err = ended(process)
    state = json.loads(out)
    assert (code, err, state["packet_in"], state["ports"]["1"]["received"]) == (0, "", 1, 1)
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_end_it_cleanly(number):
    process = start()
    process.stdout.readline()
    assert ended(process, number) == (0, "", "")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--port", "1=nonsense"], "kinds are"),
        (["--grpc", "203.0.113.1:1"], "cannot listen"),
        (["--tls-cert", "x"], "both"),
        (["--tls-cert", "none", "--tls-key", "none"], "cannot read"),
    ],
)
def test_what_cannot_be_is_one_line_and_code_2(arguments, text):
    process = start(*arguments)
    out, err = process.communicate(timeout=TIMEOUT_S)
    assert (process.returncode, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert text in err


def test_an_address_in_use_is_refused():
    process = start()
    address = json.loads(process.stdout.readline())["grpc"]
    second = start("--grpc", address)
    _, err = second.communicate(timeout=TIMEOUT_S)
    assert (second.returncode, "cannot listen" in err) == (2, True)
    ended(process)


def runs(pid):
    try:
        return " Z " not in Path(f"/proc/{pid}/stat").read_text()
    except OSError:  # gone, perhaps while it was read
        return False


def test_it_does_not_outlive_its_parent():
    script = (
        "import subprocess, sys\n"
        "p = subprocess.Popen([sys.executable, '-m', 'dataplane'], stdout=subprocess.PIPE, text=True)\n"
        "print(p.stdout.readline(), flush=True)\n"
    )
    parent = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True, text=True, check=True, timeout=TIMEOUT_S, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    pid = json.loads(parent.stdout)["pid"]
    deadline = time.monotonic() + TIMEOUT_S
    while runs(pid):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def certificate(folder):
    openssl = require_program("openssl")
    subprocess.run(
        [
            openssl, "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes",
            "-keyout", f"{folder}/key.pem", "-out", f"{folder}/cert.pem", "-subj", "/CN=localhost",
            "-addext", "subjectAltName=DNS:localhost",
        ],
        check=True, capture_output=True,
    )  # fmt: skip
    return Path(f"{folder}/cert.pem"), Path(f"{folder}/key.pem")


def test_tls_with_client_certificates(tmp_path):
    cert, key = certificate(tmp_path)
    process = start("--tls-cert", str(cert), "--tls-key", str(key), "--tls-client-ca", str(cert))
    address = json.loads(process.stdout.readline())["grpc"]
    options = (("grpc.ssl_target_name_override", "localhost"),)
    known = grpc.ssl_channel_credentials(cert.read_bytes(), key.read_bytes(), cert.read_bytes())
    unknown = grpc.ssl_channel_credentials(cert.read_bytes())
    ask = p4runtime.CapabilitiesRequest(device_id=1)
    with grpc.secure_channel(address, known, options) as channel:
        assert P4RuntimeStub(channel).Capabilities(ask, timeout=TIMEOUT_S).p4runtime_api_version == "1.4.0"
    with grpc.secure_channel(address, unknown, options) as channel, pytest.raises(grpc.RpcError):
        P4RuntimeStub(channel).Capabilities(ask, timeout=3)
    ended(process)


def test_a_capture_file_goes_in_and_out(tmp_path):
    writer = PcapWriter(tmp_path / "in.pcap")
    frames = [bytes(12) + b"\x12\x34" + os.urandom(50) for _ in range(500)]
    for number, frame in enumerate(frames):
        writer.write(10**15 + number, frame)
    writer.close()
    process = start(
        "--port", f"1=pcap:{tmp_path}/in.pcap", "--port", f"2=pcap:,{tmp_path}/out.pcap", "--state-json", "-"
    )
    address = json.loads(process.stdout.readline())["grpc"]
    with Controller(address) as controller:
        controller.arbitrate()
        config = program_config(PROGRAM)
        names = Names(config.p4info)
        controller.set_pipeline(config, "VERIFY_AND_SAVE")
        controller.write(insert(names.entry("I.ports", {"sm.ingress_port": 1}, "I.forward", [2])))
        controller.set_pipeline(None, "COMMIT")
        counter = p4runtime.Entity()
        counter.counter_entry.counter_id = next(c for c in names.info.counters).preamble.id
        counter.counter_entry.index.index = 1
        deadline = time.monotonic() + TIMEOUT_S
        while controller.read(counter)[0].counter_entry.data.packet_count < len(frames):
            assert time.monotonic() < deadline
            time.sleep(0.01)
    code, out, _ = ended(process)
    assert (code, json.loads(out)["ports"]["2"]["sent"]) == (0, 500)
    reader = PcapReader(tmp_path / "out.pcap")
    assert [reader.read()[1] for _ in frames] == frames
    reader.close()
