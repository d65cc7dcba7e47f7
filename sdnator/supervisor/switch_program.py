"""A switch as a part: restarted with the same ports at the same address."""

import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

from sdnator.supervisor.child import Child

_LONGEST_SOCKET = 100
"""Bytes; the kernel takes 107."""
_AGAIN_S = 60.0
"""A spare that died is replaced after this time."""


class SwitchProgram:
    """Starts the embedded switch or BMv2.

    Args:
        kind: embedded or bmv2.
        name: of the part, for its log.
        logs: folder for that.
        ports: port number to what `python -m dataplane --port` takes; of BMv2 to an interface.
        address: HOST:PORT, port 0 = any that the first start takes, or `unix:PATH`; never for BMv2.
        device_id: P4Runtime device id.
        options: more for `python -m dataplane`.

    The embedded switch's clock continues after a restart; BMv2's starts at zero.  As a `Reserve` it keeps a spare
    process of the embedded switch that has loaded everything and compiled the program.
    """

    def __init__(
        self,
        kind: str,
        *,
        name: str,
        logs: Path,
        ports: Mapping[int, str],
        address: str = "127.0.0.1:0",
        device_id: int = 1,
        options: Sequence[str] = (),
    ) -> None:
        self._kind = kind
        self._name = name
        self._logs = logs
        self._ports = ports
        self._address = address
        self._device_id = device_id
        self._options = options
        self._zero_us = 0
        """The same on the clock that runs since the machine's start."""
        self._child: Child | None = None
        self._spare: Child | None = None
        self._spare_from = 0.0
        self.base_us = 0
        """Absolute time of its clock's zero, µs; valid from the first start on."""

    @property
    def address(self) -> str:
        """Address of its P4Runtime server; from its first ready line on the actual one."""
        said = self._child.ready() if self._child is not None else None
        if said is not None:
            self._address = str(said["grpc"])
        return self._address

    @property
    def clock_goes_on(self) -> bool:
        """Whether `base_us` stays what it is after a restart."""
        return self._kind == "embedded"

    def start(self) -> Child:
        """Start it, at the address of the previous start; the spare takes its place if there is one."""
        spare, self._spare = self._spare, None
        if spare is not None and spare.ended() is None:
            spare.begin()
            self._child = spare
            return spare
        if spare is not None:
            spare.close()
        if not self.base_us or not self.clock_goes_on:
            self.base_us = time.time_ns() // 1_000
            self._zero_us = time.clock_gettime_ns(time.CLOCK_BOOTTIME) // 1_000
        self._child = self._process()
        return self._child

    def prepare(self) -> None:
        """See `Reserve.prepare`."""
        if self._kind != "embedded" or time.monotonic() < self._spare_from:
            return
        if self._spare is None:
            self._spare = self._process("--spare")
        elif self._spare.ended() is not None:
            self.discard()
            self._spare_from = time.monotonic() + _AGAIN_S

    def discard(self) -> None:
        """See `Reserve.discard`."""
        if self._spare is not None:
            self._spare.close()
            self._spare = None

    def _process(self, *more: str) -> Child:
        module = "dataplane" if self._kind == "embedded" else "sdnator.supervisor.bmv2_program"
        places = ["--grpc", self.address, "--device-id", str(self._device_id)]
        ports = [part for number, kind in self._ports.items() for part in ("--port", f"{number}={kind}")]
        clock = ["--base-us", str(self._zero_us)] if self.clock_goes_on else []
        arguments = [module, *places, *ports, *clock, *self._options, *more]
        return Child(self._name, arguments, self._logs, heartbeat=True, waits=bool(more))


def socket_address(folder: Path, name: str, stack: ExitStack) -> str:
    """`unix:PATH` of a socket in a folder of mode 0700; in a short one that ends with `stack` where it is long."""
    path = folder / f"switch-{name}.sock"
    if len(str(path).encode()) > _LONGEST_SOCKET:
        short = stack.enter_context(tempfile.TemporaryDirectory(prefix="sdnator-"))
        path = Path(short) / "switch.sock"
    return f"unix:{path}"
