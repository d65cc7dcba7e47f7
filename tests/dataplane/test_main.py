"""The switch as a process: says when it is ready, ends when told, with its parent, or with one clear line."""

import json
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import grpc
import pytest

from dataplane.p4runtime.trust import own_program, program_hash, read_program
from dataplane.ports.capture_port import CaptureFeed
from dataplane.ports.pcap_port import PcapReader, PcapWriter
from p4rt import P4RuntimeStub, p4runtime
from sdnator.testing.p4runtime_client import TIMEOUT_S, EntryBuilder, P4RuntimeClient, insert, program_config
from tests.requirements import require_program, require_root

PROGRAM = Path(__file__).parent / "programs" / "features"


@pytest.fixture(autouse=True)
def runtime(tmp_path_factory, monkeypatch):
    """Where sockets are put by default."""
    folder = tmp_path_factory.mktemp("run")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    return folder


def start(*arguments, command=("-m", "dataplane"), **more):
    return subprocess.Popen(
        [sys.executable, *command, "--trust", program_hash(program_config(PROGRAM)), *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
        **more,
    )


def ended(process, number=signal.SIGTERM):
    process.send_signal(number)
    out, err = process.communicate(timeout=TIMEOUT_S)
    return process.returncode, out, err


def test_live_ports_have_precedence_over_other_programs():
    require_root()
    process = start("--port", "1=null")
    assert json.loads(process.stdout.readline())["ready"]
    assert os.getpriority(os.PRIO_PROCESS, process.pid) < os.getpriority(os.PRIO_PROCESS, 0)
    assert ended(process)[0] == 0


def test_it_serves_and_ends_with_its_counts(tmp_path):
    process = start(
        "--port", f"1=capture:{tmp_path}/s", "--port", "2=null", "--state-json", "-", "--device-id", "7"
    )
    ready = json.loads(process.stdout.readline())
    assert (ready["ready"], ready["pid"]) == (True, process.pid)
    with P4RuntimeClient(ready["grpc"], device_id=7) as controller, CaptureFeed(f"{tmp_path}/s") as feed:
        assert controller.arbitrate().status.code == 0
        controller.set_pipeline(program_config(PROGRAM))
        beyond = bytes(12) + b"\x88\xb5\x15" + bytes(4) + b"\xff" * 4 + bytes(10)
        feed.send([1, 1], [60, 60], [beyond, bytes(12) + b"\x88\xb5\x0f" + bytes(30)])
        assert controller.packets.get(timeout=TIMEOUT_S).metadata[0].value == b"\x01"
    code, out, err = ended(process)
    state = json.loads(out)
    assert (code, err, state["packet_in"], state["ports"]["1"]["received"]) == (0, "", 1, 2)
    assert state["out_of_range"] == {"I.seen": 1, "I.rate": 1, "I.cells": 2, "I.wide_cells": 1}
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
        (["--grpc", "203.0.113.1:1", "--insecure"], "cannot listen"),
        (["--grpc", "unix:relative"], "must be an absolute path"),
        (["--base-us", str(1 << 60)], "clock cannot begin"),
        (["--heartbeat-fd", "999"], "heartbeat descriptor 999"),
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


def test_the_default_is_a_socket_that_only_its_user_reaches(runtime):
    process = start()
    path = Path(json.loads(process.stdout.readline())["grpc"].removeprefix("unix:"))
    assert path.parent == runtime / "sdnator" / "run"
    assert [each.lstat().st_mode & 0o777 for each in (path, path.parent)] == [0o600, 0o700]
    assert ended(process) == (0, "", "")
    assert not path.exists()


def test_a_state_folder_of_a_long_path_gets_a_socket_of_a_short_one(runtime, monkeypatch):
    """The folder of that socket goes with the switch."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime / ("long" * 30)))
    process = start()
    path = Path(json.loads(process.stdout.readline())["grpc"].removeprefix("unix:"))
    assert [each.lstat().st_mode & 0o777 for each in (path, path.parent)] == [0o600, 0o700]
    assert ended(process) == (0, "", "")
    assert not path.parent.exists()


def test_the_socket_of_a_switch_that_died_is_taken_over(tmp_path):
    address = f"unix:{tmp_path}/run/s.sock"
    first = start("--grpc", address)
    first.stdout.readline()
    ended(first, signal.SIGKILL)
    assert (tmp_path / "run" / "s.sock").exists()
    second = start("--grpc", address)
    with P4RuntimeClient(json.loads(second.stdout.readline())["grpc"]) as controller:
        assert controller.arbitrate().status.code == 0
    ended(second)


def test_a_folder_that_others_can_write_is_refused(tmp_path):
    folder = tmp_path / "open"
    folder.mkdir()
    folder.chmod(0o777)
    process = start("--grpc", f"unix:{folder}/s.sock")
    _, err = process.communicate(timeout=TIMEOUT_S)
    assert (process.returncode, "others could replace sockets" in err) == (2, True)


def test_roles_are_those_that_were_configured():
    process = start("--role", "guard")
    address = json.loads(process.stdout.readline())["grpc"]
    with P4RuntimeClient(address, role="guard") as known, P4RuntimeClient(address, role="other") as unknown:
        assert known.arbitrate().status.code == 0
        unknown.ask_for_arbitration()
        assert unknown.ended.wait(TIMEOUT_S)
        assert (unknown.error.code().name, "not configured" in unknown.error.details()) == (
            "PERMISSION_DENIED",
            True,
        )
    ended(process)


def test_a_switch_that_is_started_again_goes_on_with_its_clock():
    """A frame's arrival is stamped with the time since the first start, not since its own."""
    first = start()
    base = json.loads(first.stdout.readline())["base_us"]
    ended(first, signal.SIGKILL)
    before = time.clock_gettime_ns(time.CLOCK_BOOTTIME) // 1000 - base
    second = start("--base-us", str(base))
    ready = json.loads(second.stdout.readline())
    assert ready["base_us"] == base
    with P4RuntimeClient(ready["grpc"]) as controller:
        controller.arbitrate()
        config = program_config(PROGRAM)
        controller.set_pipeline(config)
        entry = EntryBuilder(config.p4info).entry(
            "I.route", {"h.ip.dst": (1, 32)}, "I.drop", idle_timeout_ns=1
        )
        controller.write(insert(entry))
        entry.table_entry.time_since_last_hit.SetInParent()
        assert controller.read(entry)[0].table_entry.time_since_last_hit.elapsed_ns < 10**9 * TIMEOUT_S
    assert before > 0
    ended(second)


def bytes_of(descriptor, count):
    """So many signs of life; fails if they take too long."""
    ready = select.poll()
    ready.register(descriptor, select.POLLIN)
    for _ in range(count):
        assert ready.poll(TIMEOUT_S * 1000)
        assert os.read(descriptor, 1) == b"."


def test_it_gives_signs_of_life_while_it_is_not_stopped():
    read, write = os.pipe()
    process = start("--heartbeat-fd", str(write), pass_fds=[write])
    os.close(write)
    process.stdout.readline()
    bytes_of(read, 2)
    process.send_signal(signal.SIGSTOP)
    os.set_blocking(read, False)
    time.sleep(0.2)
    while True:  # what was on its way
        try:
            os.read(read, 1)
        except BlockingIOError:
            break
    time.sleep(2.5)
    with pytest.raises(BlockingIOError):
        os.read(read, 1)
    process.send_signal(signal.SIGCONT)
    bytes_of(read, 2)
    assert ended(process)[0] == 0
    os.close(read)


_DYING = {
    "packets": "dataplane.packet_loop.PacketLoop._wait = lambda self: 1 / 0",
    "p4runtime": "dataplane.p4runtime.server._loop_work = dataplane.p4runtime.server._event_loop().stop",
    "heartbeat": "dataplane.heartbeat.LivenessPipe._asked = lambda self: 1 / 0",
}


@pytest.mark.parametrize("thread", list(_DYING))
def test_a_thread_that_dies_takes_the_process_along(thread):
    later = (
        "threading.Timer(1, dataplane.p4runtime.server._loop_work).start()" if thread == "p4runtime" else ""
    )
    script = (
        "import sys, threading, dataplane.heartbeat, dataplane.p4runtime.server, dataplane.packet_loop\n"
        f"from dataplane.__main__ import main\n{_DYING[thread]}\n{later}\nsys.exit(main())"
    )
    read, write = os.pipe()
    process = start("--heartbeat-fd", str(write), command=("-c", script), pass_fds=[write])
    _, err = process.communicate(timeout=TIMEOUT_S)
    os.close(read)
    os.close(write)
    assert process.returncode == 1
    assert f"dataplane: the thread {thread} died" in err


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
            "-keyout", f"{folder}/key.pem", "-out", f"{folder}/cert.pem", "-subj", "/CN=controller",
            "-addext", "subjectAltName=DNS:localhost",
        ],
        check=True, capture_output=True,
    )  # fmt: skip
    return Path(f"{folder}/cert.pem"), Path(f"{folder}/key.pem")


def test_tls_with_client_certificates(tmp_path):
    cert, key = certificate(tmp_path)
    process = start(
        "--grpc", "127.0.0.1:0", "--tls-cert", str(cert), "--tls-key", str(key), "--tls-client-ca", str(cert)
    )
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
    with P4RuntimeClient(address) as controller:
        controller.arbitrate()
        config = program_config(PROGRAM)
        names = EntryBuilder(config.p4info)
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


def test_a_spare_serves_when_a_byte_comes_and_a_first_push_finds_its_program_compiled(tmp_path):
    process = start("--spare", "--port", "1=null", stdin=subprocess.PIPE)
    assert not select.select([process.stdout], [], [], 0.2)[0]
    process.stdin.write("\n")
    process.stdin.flush()
    ready = json.loads(process.stdout.readline())
    with P4RuntimeClient(ready["grpc"]) as controller:
        assert controller.arbitrate().status.code == 0
        controller.set_pipeline(read_program(own_program()))
        controller.set_pipeline(program_config(PROGRAM))
    assert ended(process)[0] == 0


@pytest.mark.parametrize("number", [0, signal.SIGTERM])
def test_a_spare_that_is_not_needed_ends(number):
    process = start("--spare", "--port", "1=null", stdin=subprocess.PIPE)
    if number:
        # once it has handlers; before that the signal ends it as well
        process.send_signal(number)
    assert process.communicate(timeout=TIMEOUT_S)[0] == ""
    assert process.returncode in (0, -number)
