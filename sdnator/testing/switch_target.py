"""A switch as a separate process that a test can stop, kill and start again: the embedded one, or BMv2."""

import os
import signal
from collections.abc import Sequence
from pathlib import Path

from dataplane.bmv2 import Bmv2
from sdnator.supervisor import Child

KINDS = ("embedded", "bmv2")
"""Of switches; BMv2 where it is installed."""


class SwitchTarget:
    """A switch, P4Runtime device 1, CPU port 510; at the same address from its first start on.

    Args:
        kind: of KINDS.
        folder: for its log.
        ports: NUMBER=WHAT as `python -m dataplane --port` takes them; BMv2 takes those on veth interfaces only.
        more: further options of `python -m dataplane`.
    """

    def __init__(
        self, kind: str, folder: Path, *, ports: Sequence[str] = (), more: Sequence[str] = ()
    ) -> None:
        self.kind = kind
        self.folder = folder
        self._ports = ports
        self._more = more
        self._open = () if "--tls-client-ca" in more else ("--insecure",)
        self._address = "127.0.0.1:0"
        self._process: Child | Bmv2 | None = None

    @property
    def address(self) -> str:
        """HOST:PORT; port 0 before the first start."""
        return self._address

    def start(self) -> None:
        """Start it, and return when it is ready to serve.

        Raises:
            PipelineError: the embedded switch ended; the text has its last words.
            Bmv2Error: BMv2 is not installed, or did not start.
        """
        self._process = self._embedded() if self.kind == "embedded" else self._bmv2()

    def _embedded(self) -> Child:
        ports = [part for port in self._ports for part in ("--port", port)]
        places = ["--grpc", self._address, "--device-id", "1", "--cpu-port", "510"]
        child = Child("switch", ["dataplane", *places, *ports, *self._more, *self._open], self.folder)
        try:
            self._address = str(child.wait_ready()["grpc"])
        except BaseException:
            child.close()
            raise
        return child

    def _bmv2(self) -> Bmv2:
        wires = [port.partition("=veth:") for port in self._ports if "=veth:" in port]
        switch = Bmv2({int(number): wire for number, _, wire in wires}, grpc=self._address)
        self._address = switch.address
        return switch

    def kill(self) -> None:
        """Kill it as `kill -9` does; does nothing if it is not running."""
        process, self._process = self._process, None
        if process is not None:
            os.kill(process.pid, signal.SIGKILL)
            process.close()

    def stop(self) -> None:
        """Shut it down in order; does nothing if it is not running."""
        process, self._process = self._process, None
        if isinstance(process, Child):
            process.stop()
        elif process is not None:
            os.kill(process.pid, signal.SIGCONT)
            process.close()

    def pause(self) -> None:
        """Make it silent, with all its connections open; it must run."""
        self._signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Let it continue after `pause`."""
        self._signal(signal.SIGCONT)

    def _signal(self, number: signal.Signals) -> None:
        if self._process is None:
            raise RuntimeError(f"the {self.kind} switch does not run: start it first")
        os.kill(self._process.pid, number)
