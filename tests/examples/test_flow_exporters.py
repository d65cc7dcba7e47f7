"""Real exporters, a second collector that hears the same bytes, and the commands of the README."""

import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from flow_records.columns import joined
from flow_records.decoding.exporter import Exporter

from apps.packets import read_frames
from sdnator.testing.query_traffic import TimedFrame, mixed, udp
from sdnator.testing.waiting import wait_for
from tests.end_to_end.test_up import Operator, until
from tests.examples.flow_datagrams import (
    expanded_sample,
    flow_sample,
    raw_header,
    sflow5,
    structure,
    write_pcap,
)
from tests.requirements import optional_program, require_program

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "examples" / "flow_records"
README = (PACKAGE / "README.md").read_text(encoding="utf-8")
SECONDS = 120
VERSIONS = {"5": "netflow5", "9": "netflow9", "10": "ipfix"}


@pytest.fixture(scope="module")
def frames():
    """An office and a port scan, TCP and UDP only."""
    kept = mixed(["port_scan", "new_tcp", "ddos"], seconds=10)
    protocols = {b"\x08\x00": 23, b"\x86\xdd": 20}
    places = [(frame, protocols.get(frame.data[12:14], 0)) for frame in kept]
    return [frame for frame, place in places if place and frame.data[place] in (6, 17)]


@pytest.fixture(scope="module")
def capture(frames, tmp_path_factory):
    path = tmp_path_factory.mktemp("capture") / "office.pcap"
    write_pcap(path, frames)
    return path


@contextmanager
def hearing():
    """A UDP port of this process, and the datagrams that have arrived there."""
    found = []
    stopping = threading.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        one.bind(("127.0.0.1", 0))
        one.settimeout(0.1)

        def hear():
            while not stopping.is_set():
                try:
                    found.append(one.recv(65_535))
                except TimeoutError:
                    continue

        thread = threading.Thread(target=hear)
        thread.start()
        try:
            yield one.getsockname()[1], found
        finally:
            stopping.set()
            thread.join()


def free_udp_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def softflowd(capture, folder, port, version, *more):
    """softflowd over a capture, to its end; it exports all flows when the capture is over."""
    program = require_program("softflowd")
    files = ["-p", folder / "softflowd.pid"]
    command = [program, "-d", "-v", version, "-n", f"127.0.0.1:{port}", "-r", capture, *files, *more]
    done = subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, timeout=SECONDS, check=False
    )
    assert done.returncode == 0, done.stderr


def exported(capture, folder, version, *more):
    """The datagrams of softflowd over a capture."""
    with hearing() as (port, found):
        softflowd(capture, folder, port, version, *more)
        wait_for(lambda: waiting_bytes(port) == 0)
    return found


def decoded(datagrams):
    exporter = Exporter()
    batches = [
        batch for each in datagrams for batch in exporter.decode(each, 2055, 0.0, 1_700_000_000_000_000)
    ]
    return joined(batches), exporter.health()


def totals(columns, packets, sizes):
    """Packets and bytes by addresses, protocol and ports."""
    names = (
        "ip_version",
        "ip_src_hi",
        "ip_src_lo",
        "ip_dst_hi",
        "ip_dst_lo",
        "ip_proto",
        "src_port",
        "dst_port",
    )
    found = Counter()
    for *key, count, size in zip(*(columns[name].tolist() for name in names), packets, sizes, strict=True):
        if key[5] in (6, 17):
            found[(*key, "packets")] += count
            found[(*key, "bytes")] += size
    return found


def expected(frames, versions):
    """The same of the frames, by their headers."""
    numbers = np.arange(len(frames))
    packets = read_frames(
        [frame.data for frame in frames],
        lengths=[frame.length for frame in frames],
        times_us=numbers, ports=numbers * 0, sequence=numbers, arrival=numbers,
    )  # fmt: skip
    columns = dict(packets)
    columns["src_port"] = np.maximum(packets["tcp_sport"], packets["udp_sport"])
    columns["dst_port"] = np.maximum(packets["tcp_dport"], packets["udp_dport"])
    kept = np.isin(packets["ip_version"], versions)
    # softflowd counts what follows the Ethernet header, the padding of short frames included
    sizes = [frame.length - 14 for frame in frames]
    columns = {name: column[kept] for name, column in columns.items()}
    return totals(columns, [1] * int(kept.sum()), np.array(sizes)[kept].tolist())


@pytest.mark.parametrize("version", VERSIONS)
def test_what_softflowd_exports_is_what_it_saw(version, frames, capture, tmp_path):
    """Packets and bytes of every five-tuple are those of the capture; nothing is lost or refused."""
    flows, health = decoded(exported(capture, tmp_path, version))
    wanted = expected(frames, [4] if version == "5" else [4, 6])
    assert totals(flows, flows["packets"].tolist(), flows["bytes"].tolist()) == wanted
    assert health["protocols"] == [VERSIONS[version]]
    assert [health[name] for name in ("refused", "without_template")] == [0, 0]
    if (
        version != "10"
    ):  # softflowd numbers messages of IPFIX by their last record, not by their first (RFC 7011, 3.1)
        assert [health[name] for name in ("lost_records", "lost_datagrams", "restarts")] == [0, 0, 0]


@pytest.mark.parametrize("version", VERSIONS)
def test_softflowd_tells_its_sampling_rate(version, capture, tmp_path):
    """One of ten packets, by options or by the header: every record says ten, and counts are tens."""
    flows, _ = decoded(exported(capture, tmp_path, version, "-s", "10"))
    assert set(flows["sampling"].tolist()) == {10}
    assert not (flows["packets"] % 10).any()


@pytest.mark.parametrize("version", VERSIONS)
def test_nfcapd_reads_the_same(version, capture, tmp_path):
    """The same datagrams at nfdump's collector: every record with its addresses, ports, counts, flags and protocol."""
    nfcapd, nfdump = optional_program("nfcapd"), optional_program("nfdump")
    datagrams = exported(capture, tmp_path, version)
    flows, _ = decoded(datagrams)
    store, port = tmp_path / "store", free_udp_port()
    store.mkdir()
    with (tmp_path / "nfcapd.log").open("w") as log:
        command = [nfcapd, "-w", store, "-p", port, "-b", "127.0.0.1", "-t", "3600", "-I", "lab"]
        process = subprocess.Popen([str(part) for part in command], stdout=log, stderr=log)
        try:
            wait_for(lambda: waiting_bytes(port) == 0, why=(tmp_path / "nfcapd.log").read_text)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
                for datagram in datagrams:
                    one.sendto(datagram, ("127.0.0.1", port))
                    wait_for(lambda: waiting_bytes(port) == 0)
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(SECONDS)
    done = subprocess.run(
        [nfdump, "-R", str(store), "-q", "-N", "-6", "-o", "fmt:%sa|%da|%sp|%dp|%pr|%pkt|%byt"],
        capture_output=True, text=True, timeout=SECONDS, check=True,
    )  # fmt: skip
    theirs = sorted(line.replace(" ", "") for line in done.stdout.splitlines() if line.count("|") == 6)
    assert len(theirs) == len(flows)
    assert theirs == sorted(nfdump_line(flows, place) for place in range(len(flows)))


def waiting_bytes(port):
    """Bytes of datagrams that wait in the socket of a UDP port; None: nobody has it."""
    for line in Path("/proc/net/udp").read_text().splitlines():
        if f"0100007F:{port:04X} " in line:
            return int(line.split()[4].split(":")[1], 16)
    return None


def ends(flow):
    """Source and destination as text."""
    found = []
    for side in ("src", "dst"):
        number = flow[f"ip_{side}_hi"] << 64 | flow[f"ip_{side}_lo"]
        family, width = (socket.AF_INET, 4) if flow["ip_version"] == 4 else (socket.AF_INET6, 16)
        found.append(socket.inet_ntop(family, number.to_bytes(width, "big")))
    return found


def nfdump_line(flows, place):
    here = {name: int(flows[name][place]) for name in flows}
    source, target = str(max(here["src_port"], 0)), str(max(here["dst_port"], 0))
    return "|".join(
        [*ends(here), source, target, str(here["ip_proto"]), str(here["packets"]), str(here["bytes"])]
    )


def column(line, name, names):
    """The values of one field in a line of tshark."""
    text = line.split("\t")[names.index(name)]
    return text.split(",") if text else []


def test_tshark_reads_the_same_in_sflow(frames, tmp_path):
    """Both forms of samples: rates, lengths, addresses and ports of every sampled packet."""
    tshark = require_program("tshark")
    sent = [
        sflow5(
            flow_sample(raw_header(first.data[:128], first.length), rate=100 + place),
            structure(2, bytes(12)),
            expanded_sample(raw_header(second.data[:128], second.length), rate=7),
            sequence=place,
        )
        for place, (first, second) in enumerate(zip(frames[:200:2], frames[1:200:2], strict=True))
    ]
    path = tmp_path / "sflow.pcap"
    outer = [udp("127.0.0.1", "127.0.0.1", 6343, 6343, datagram) for datagram in sent]
    write_pcap(path, [TimedFrame(place, len(data), data) for place, data in enumerate(outer)])
    names = [
        "sflow.flow_sample.sampling_rate",
        "sflow_245.header.frame_length",
        "ip.src",
        "ipv6.dst",
        "tcp.srcport",
    ]
    names += ["udp.dstport", "_ws.malformed"]
    fields = [word for name in names for word in ("-e", name)]
    done = subprocess.run(
        [tshark, "-n", "-r", str(path), "-T", "fields", "-E", "occurrence=a", *fields],
        capture_output=True, text=True, check=True, timeout=SECONDS,
    )  # fmt: skip
    lines = done.stdout.splitlines()
    assert len(lines) == len(sent)
    for line, datagram in zip(lines, sent, strict=True):
        flows, _ = decoded([datagram])
        ours = [{name: int(flows[name][place]) for name in flows} for place in range(2)]
        assert column(line, names[0], names) == [str(flow["sampling"]) for flow in ours]
        assert column(line, names[1], names) == [str(flow["bytes"] // flow["sampling"]) for flow in ours]
        assert column(line, "ip.src", names)[1:] == [
            ends(flow)[0] for flow in ours if flow["ip_version"] == 4
        ]
        assert column(line, "ipv6.dst", names) == [ends(flow)[1] for flow in ours if flow["ip_version"] == 6]
        assert column(line, "tcp.srcport", names) == [
            str(flow["src_port"]) for flow in ours if flow["ip_proto"] == 6
        ]
        assert column(line, "udp.dstport", names)[1:] == [
            str(flow["dst_port"]) for flow in ours if flow["ip_proto"] == 17
        ]
        assert column(line, "_ws.malformed", names) == []


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder with the package as pip installs it, from a copy: a build in the checkout would leave files there."""
    base = tmp_path_factory.mktemp("installed")
    shutil.copytree(
        PACKAGE, base / "source", ignore=shutil.ignore_patterns("__pycache__", "*.egg-info", "build")
    )
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--no-build-isolation"]
    done = subprocess.run(
        [*pip, "--no-deps", "--no-index", "--target", str(base / "site"), str(base / "source")],
        capture_output=True, text=True, timeout=SECONDS, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return base / "site"


def commands():
    """Every line of the README's `sh` blocks, without its remark."""
    blocks = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
    return [line.split("#")[0].strip() for block in blocks for line in block.splitlines()]


def test_the_readme_s_commands_work(installed, frames, tmp_path, monkeypatch):
    """Installed, configured, started; what softflowd exports is observed as flows, as a result and as a state."""
    port = free_udp_port()
    (settings,) = re.findall(r"```toml\n(.*?)```", README, re.DOTALL)
    (tmp_path / "flows.toml").write_text(settings.replace("2055", str(port)), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join((str(installed), str(ROOT))))
    require_program("softflowd")
    operator = Operator(tmp_path)
    lines = [shlex.split(line.replace("2055", str(port))) for line in commands()]
    assert lines[0] == ["pip", "install", "-e", "examples/flow_records"]
    check, up, *observed, router = lines[1:]
    done = operator.run(*words(check))
    assert done.returncode == 0, done.stdout
    assert up[:2] == ["sdnator", "up"]
    with operator.up(*up[2:]):
        until(lambda: (now := operator.well()) and now["parts"]["flow_records"]["alive"])
        said = {
            line[2]: start(operator, line, tmp_path / f"{place}.jsonl") for place, line in enumerate(observed)
        }
        assert router[0] == "softflowd"
        capture = tmp_path / "now.pcap"
        values = {"CAPTURE.pcap": str(capture), "softflowd": require_program("softflowd")}
        command = [values.get(word, word) for word in router] + ["-p", str(tmp_path / "softflowd.pid")]
        # more than once, since it takes some heartbeats until producers know that somebody observes
        while any(process.poll() is None for process, _ in said.values()):
            ago = time.time_ns() // 1000 - frames[-1].time_us  # each time in windows of its own
            write_pcap(capture, [frame._replace(time_us=frame.time_us + ago) for frame in frames])
            sent = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, check=False)
            assert sent.returncode == 0, sent.stderr
            threading.Event().wait(1.0)
    assert [process.returncode for process, _ in said.values()] == [0] * len(said)
    heard = {key: path.read_text(encoding="utf-8") for key, (_, path) in said.items()}
    items = {key: [json.loads(line) for line in out.splitlines()] for key, out in heard.items()}
    assert items.keys() == {line[2] for line in observed}
    flows, results, states = items.values()
    assert {item["dataKey"] for item in flows} == {"network.flows.flow_records.lab"}
    assert "198.51.100.4" in {item["value"]["src"] for item in results}
    assert states[-1]["value"]["records"] > 100


def words(line):
    assert line[0] == "sdnator", f"no test knows how to run: {line}"
    return line[1:]


def start(operator, line, path):
    """An observation that runs on its own, and the file of its JSON lines."""
    with path.open("w") as file:
        command = operator.command(*words(line), "--json")
        return subprocess.Popen(
            command, env=operator.environment, stdout=file, stderr=subprocess.DEVNULL
        ), path


@pytest.mark.parametrize("target", re.findall(r"\]\(([^)#]+)\)", README))
def test_links_of_the_readme_lead_somewhere(target):
    assert (PACKAGE / target).exists()
