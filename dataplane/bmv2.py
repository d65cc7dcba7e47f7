"""Starts BMv2's simple_switch_grpc, where it is installed, as a stand-in for the embedded switch."""

import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Self

from dataplane.errors import DataplaneError

PROGRAM = "simple_switch_grpc"
_STARTER = """
import ctypes, os, signal, sys
ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG
if os.getppid() != int(sys.argv[1]):
    sys.exit(1)
os.execv(sys.argv[2], sys.argv[2:])
"""
_POLL_S = 0.05


class Bmv2Error(DataplaneError):
    """BMv2 is not installed or did not start."""


class Bmv2:
    """A running simple_switch_grpc, without a pipeline until a controller pushes one.

    interfaces: port number -> interface name
    cpu_port: not 0 and not 511, or BMv2 has no packet I/O
    grpc: "host:port" to serve on, port 0 = any; BMv2 by itself would listen on all addresses
    packet_stream: take frames by gRPC (p4.bm.DataplaneInterface at `packet_address`) instead of interfaces,
        which needs no root
    timeout_s: how long to wait until it serves

    Raises Bmv2Error.
    """

    def __init__(
        self,
        interfaces: Mapping[int, str],
        *,
        device_id: int = 1,
        cpu_port: int = 510,
        grpc: str = "127.0.0.1:0",
        packet_stream: bool = False,
        timeout_s: float = 15.0,
    ) -> None:
        program = shutil.which(PROGRAM)
        if program is None:
            raise Bmv2Error(f"{PROGRAM} is not on the PATH; install BMv2 or use the embedded switch")
        self.address = _with_port(grpc)
        self.packet_address = _with_port("127.0.0.1:0") if packet_stream else ""
        self._folder = tempfile.TemporaryDirectory(prefix="sdnator-bmv2-")
        folder = Path(self._folder.name)
        self.log = folder / "bmv2.log"
        command = [program, "--no-p4", "--device-id", str(device_id), "--log-console", "-L", "warn"]
        for number, interface in sorted(interfaces.items()):
            command += ["-i", f"{number}@{interface}"]
        command += unshared(program, folder)
        command += ["--", "--grpc-server-addr", self.address, "--cpu-port", str(cpu_port)]
        if packet_stream:
            command += ["--dp-grpc-server-addr", self.packet_address]
        with self.log.open("wb") as log:
            self._process = subprocess.Popen(
                ending_with_us(command), stdout=log, stderr=subprocess.STDOUT, cwd=folder
            )
        self._wait(timeout_s)

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def check(self) -> None:
        """Raise Bmv2Error with the end of its output if it has ended."""
        code = self._process.poll()
        if code is not None:
            raise Bmv2Error(f"{PROGRAM} ended with exit code {code}; it said: {self._last_words()}")

    def _last_words(self) -> str:
        said = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-3:]
        return " | ".join(said) or "nothing"

    def _wait(self, timeout_s: float) -> None:
        host, _, port = self.address.rpartition(":")
        deadline = time.monotonic() + timeout_s
        while self._process.poll() is None and time.monotonic() < deadline:
            with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
                if probe.connect_ex((host, int(port))) == 0:
                    return
            time.sleep(_POLL_S)
        said = self._last_words()
        self.close()
        raise Bmv2Error(f"{PROGRAM} did not serve {self.address} within {timeout_s} s; it said: {said}")

    def close(self) -> None:
        """End it and remove its folder."""
        self._process.terminate()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._folder.cleanup()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def unshared(program: str, folder: Path) -> list[str]:
    """Options that separate instances; not all builds of BMv2 have them."""
    offered = subprocess.run([program, "--help"], capture_output=True, text=True, check=False).stdout
    options = []
    if "--thrift-port" in offered:
        options += ["--thrift-port", str(_free_port())]
    if "--notifications-addr" in offered:
        options += ["--notifications-addr", f"ipc://{folder}/notifications"]
    return options


def _with_port(address: str) -> str:
    host, _, port = address.rpartition(":")
    return address if port != "0" else f"{host}:{_free_port()}"


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def ending_with_us(command: list[str]) -> list[str]:
    """The command behind a starter that has the kernel end it when this process does.

    Not a `preexec_fn`: that forks a process with gRPC's threads in it, which may hang before it starts.
    """
    if sys.platform != "linux":
        return command
    return [sys.executable, "-c", _STARTER, str(os.getpid()), *command]
