"""Real switches for tests: the embedded one always, BMv2 where it is installed; both without ports."""

import json
import signal
import socket
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

from dataplane.bmv2 import ending_with_us, unshared
from tests.requirements import optional_program

KINDS = ("embedded", "bmv2")


class Target:
    """A switch process that can be killed and started again on the same address, known from its first start on."""

    def __init__(
        self, kind: str, folder: Path, *, ports: tuple[str, ...] = (), more: tuple[str, ...] = ()
    ) -> None:
        self.kind = kind
        self.folder = folder
        self._ports = ports
        self._more = more
        self._program = sys.executable if kind == "embedded" else optional_program("simple_switch_grpc")
        self._port = 0 if kind == "embedded" else free_port()
        self._process: subprocess.Popen[str] | None = None

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self._port}"

    @property
    def command(self) -> list[str]:
        if self.kind == "embedded":
            ports = [part for port in self._ports for part in ("--port", port)]
            return [self._program, "-m", "dataplane", "--grpc", self.address, "--device-id", "1",
                    "--cpu-port", "510", *ports, *self._more]  # fmt: skip
        veths = [port.replace("=veth:", "@") for port in self._ports if "=veth:" in port]
        ports = [part for veth in veths for part in ("-i", veth)]
        return [self._program, "--no-p4", "--device-id", "1", *unshared(self._program, self.folder), "-L", "off",
                *ports, "--", "--grpc-server-addr", self.address, "--cpu-port", "510"]  # fmt: skip

    def start(self) -> None:
        # the embedded switch sees to it by itself that it ends with us
        command = self.command if self.kind == "embedded" else ending_with_us(self.command)
        self._process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        if self.kind == "embedded":
            assert self._process.stdout is not None
            ready = json.loads(self._process.stdout.readline())
            self._port = int(ready["grpc"].rpartition(":")[2])
        else:
            _wait_for_port(self._port)

    def kill(self) -> None:
        """As kill -9 does."""
        if self._process is not None:
            self._process.kill()
            self._end()

    def stop(self) -> None:
        if self._process is not None:
            self._process.terminate()
            self._end()

    def pause(self) -> None:
        """Silent, with all its connections open."""
        assert self._process is not None
        self._process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        assert self._process is not None
        self._process.send_signal(signal.SIGCONT)

    def _end(self) -> None:
        assert self._process is not None
        self._process.send_signal(signal.SIGCONT)
        self._process.wait(60)
        assert self._process.stdout is not None
        self._process.stdout.close()
        self._process = None


def free_port() -> int:
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _wait_for_port(port: int) -> None:
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        with closing(socket.socket()) as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.05)
    raise AssertionError(f"nothing listens on port {port}")
