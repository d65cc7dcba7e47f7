"""FastNetMon on the floods of `benchmarks.decisions`, which starts this module in a network namespace.

    capture ─► at its own pace into one end of a veth pair ─► FastNetMon on the other ─► its script writes whom it bans

FastNetMon (Debian's package) measures an interface by the clock on the wall, so a capture takes its own time here.  A
network namespace needs root.  Settings: those of Debian, but for the interface (AF_PACKET), the network to protect, no
report to its authors, and thresholds of packets a second of one host, in all and by protocol: half as much again as
any host had in training.  Time is counted from the attack's first packet to the script's call.
"""

import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.decision_traffic.capture_writer import frames_in
from benchmarks.decision_traffic.traffic import SECOND, Traffic

DEBIANS: Final = Path("/etc/fastnetmon.conf")
START_S: Final = 20.0
"""FastNetMon is given so long to begin to listen ..."""
AFTER_S: Final = 8.0
"""... and so long after the last packet to decide: it averages over five seconds."""
MEAN_S: Final = 5
"""Seconds over which it averages."""
LEAST_PPS: Final = 10
PROTOCOLS: Final = {
    "threshold_pps": 0,
    "threshold_tcp_pps": 6,
    "threshold_udp_pps": 17,
    "threshold_icmp_pps": 1,
}
_LISTENS: Final = "AF_PACKET"
_MOST_FRAME: Final = 1_514


def missing() -> str:
    """Why it cannot be run here; empty if it can."""
    for program, package in (("fastnetmon", "fastnetmon"), ("unshare", "util-linux"), ("ip", "iproute2")):
        if shutil.which(program) is None:
            return f"not run: no program {program}; apt-get install {package}"
    return "" if os.geteuid() == 0 else "not run: it needs root, for a network namespace"


def settings(thresholds: Mapping[str, int]) -> dict[str, str]:
    """What differs from Debian's configuration, files and interface apart."""
    return {
        "mirror_afpacket": "on",
        **{name: str(value) for name, value in thresholds.items()},
        **{f"ban_for_{name}_pps": "on" for name in ("tcp", "udp", "icmp")},
        "ban_for_bandwidth": "off",
        "disable_usage_report": "on",
        "unban_only_if_attack_finished": "off",
    }


def thresholds_of(training: Traffic, prefix: int) -> dict[str, int]:
    """Packets a second that no host exceeded in training, and half as much again.

    Args:
        training: benign traffic.
        prefix: the network's, of 24 bits.

    Returns:
        By FastNetMon's setting, from means over `MEAN_S` of packets to or from each host of the network: of all packets,
        and of those of a protocol.
    """
    columns = training.columns
    spans = columns["time_us"] // (MEAN_S * SECOND)
    found = {}
    for setting, protocol in PROTOCOLS.items():
        highest = 0
        for side in ("ip_src_lo", "ip_dst_lo"):
            hosts = columns[side].astype(np.int64)
            here = (columns["ip_version"] == 4) & (hosts >> 8 == prefix >> 8)
            if protocol:
                here &= columns["ip_proto"] == protocol
            _, counts = np.unique(spans[here] << 32 | hosts[here], return_counts=True)
            highest = max(highest, int(counts.max(initial=0)))
        found[setting] = max(LEAST_PPS, round(1.5 * highest / MEAN_S))
    return found


def bans(traffic: Traffic, prefix: str, thresholds: Mapping[str, int]) -> list[tuple[float, str]]:
    """Whom FastNetMon bans.

    Args:
        traffic: packets in order of time, the attack's among them.
        prefix: the network to protect, `10.0.0.0/24`.
        thresholds: packets a second of one host, by setting.

    Returns:
        Seconds after the attack's first packet, and the host's address, in order.
    """
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        times = traffic.columns["time_us"]
        with (folder / "frames").open("wb") as file:
            for at, frame in zip(times.tolist(), frames_in(traffic), strict=True):
                cut = frame[:_MOST_FRAME]
                file.write((at - int(times[0])).to_bytes(8, "big") + len(cut).to_bytes(2, "big") + cut)
        first = int(times[traffic.attack > 0][0] - times[0]) / 1e6
        command = [
            *("unshare", "--net", "--", sys.executable, "-m", "benchmarks.decisions_fastnetmon"),
            *(place, prefix, json.dumps(thresholds)),
        ]
        said = subprocess.run(command, capture_output=True, text=True, check=False)
        if said.returncode:
            raise SystemExit(f"benchmarks.decisions: FastNetMon did not run: {said.stderr.strip()[-500:]}")
        return [(at - first, host) for at, host in json.loads(said.stdout)]


def _frames(path: Path) -> Iterator[tuple[float, bytes]]:
    with path.open("rb") as file:
        while head := file.read(10):
            yield int.from_bytes(head[:8], "big") / 1e6, file.read(int.from_bytes(head[8:], "big"))


def _configuration(folder: Path, prefix: str, thresholds: Mapping[str, int]) -> Path:
    script, networks, white = folder / "notify", folder / "networks", folder / "white"
    script.write_text(
        f'#!/bin/sh\n[ "$4" = ban ] && echo "$(date +%s.%N) $1" >> {folder}/bans\ncat > /dev/null\n'
    )
    script.chmod(0o700)
    networks.write_text(f"{prefix}\n")
    white.write_text("")
    changed = {
        **settings(thresholds),
        "interfaces": "seen",
        "notify_script_path": str(script),
        "networks_list_path": str(networks),
        "white_list_path": str(white),
    }
    lines = [
        line for line in DEBIANS.read_text().splitlines() if line.partition("=")[0].strip() not in changed
    ]
    path = folder / "fastnetmon.conf"
    path.write_text("\n".join([*lines, *(f"{name} = {value}" for name, value in changed.items())]) + "\n")
    return path


def _send(path: Path, wire: socket.socket) -> float:
    """Send at the capture's pace; returns the wall time of its beginning, s."""
    begun = time.time()
    for at, frame in _frames(path):
        ahead = begun + at - time.time()
        if ahead > 0.001:
            time.sleep(ahead)
        with contextlib.suppress(OSError):  # a full queue drops, as a port would
            wire.send(frame)
    return begun


def main(arguments: Sequence[str]) -> list[Any]:
    """In the namespace: wire, FastNetMon, packets; returns its bans in seconds after the first packet."""
    folder, prefix, thresholds = Path(arguments[0]), arguments[1], json.loads(arguments[2])
    for line in (
        "link add sent type veth peer name seen",
        "link set sent up",
        "link set seen up",
        "link set lo up",
    ):
        subprocess.run(["ip", *line.split()], check=True)
    log = folder / "log"
    log.touch()
    command = ["fastnetmon", "--configuration_file", str(_configuration(folder, prefix, thresholds))]
    command += ["--log_file", str(log), "--disable_pid_logic"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as running:
        try:
            end = time.monotonic() + START_S
            while _LISTENS not in log.read_text() and time.monotonic() < end:
                time.sleep(0.1)
            if running.poll() is not None:
                raise SystemExit(f"FastNetMon ended: {log.read_text()[-500:]}")
            time.sleep(1.0)
            with socket.socket(socket.AF_PACKET, socket.SOCK_RAW) as wire:
                wire.bind(("sent", 0))
                begun = _send(folder / "frames", wire)
            time.sleep(AFTER_S)
        finally:
            running.terminate()
    written = folder / "bans"
    lines = written.read_text().split("\n")[:-1] if written.exists() else []
    return [(float(at) - begun, host) for at, host in (line.split() for line in lines)]


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1:])))
