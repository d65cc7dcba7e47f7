"""Frames onto a real interface, and the veth pairs that lead to a switch on this machine.

Linux only, needs root.  Used for switches without a capture port: BMv2, or an external one.
"""

import errno
import os
import re
import socket
import subprocess
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Protocol, Self

from dataplane.frame_block import FrameBlock
from sdnator.errors import BadInput, PipelineError

ETH_P_ALL = 3
MTU = 9_216
"""MTU of the veth pairs, large enough for jumbo frames."""
RETRY_SECONDS = 0.0005
_CABLE_SECONDS = 30.0


class Feed(Protocol):
    """Input of a switch for the frames of a replay."""

    def send(self, times_us: Sequence[int], wire_lengths: Sequence[int], frames: Sequence[bytes]) -> None:
        """Send frames in order; blocks while the other side is full."""

    def send_block(self, block: FrameBlock) -> None:
        """As `send`, of frames that stand end to end."""

    def verdicts(self) -> bytes:
        """The switch's verdicts on the next frames, in order; none on an interface."""

    def fileno(self) -> int:
        """Readable when verdicts wait."""

    def close(self) -> None:
        """No more frames."""


class WireFeed:
    """A feed that sends into an interface, cut frames padded with zeros to their length on the wire.

    Args:
        interface: name of the interface.

    Raises:
        BadInput: no such interface, or no permission.
    """

    def __init__(self, interface: str) -> None:
        self.interface = interface
        try:
            self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)  # it receives nothing
            self._socket.bind((interface, 0))
        except PermissionError:
            raise BadInput(f"--inject {interface}: sending frames needs root; run as root") from None
        except OSError as error:
            raise BadInput(
                f"--inject {interface}: {error.strerror}; see `ip link` for the interfaces"
            ) from None

    def send(self, times_us: Sequence[int], wire_lengths: Sequence[int], frames: Sequence[bytes]) -> None:  # noqa: ARG002 - a wire has its own clock
        """Send frames at once; raises PipelineError if a frame does not fit."""
        for length, frame in zip(wire_lengths, frames, strict=True):
            padded = frame.ljust(length, b"\0")
            while True:
                try:
                    self._socket.send(padded)
                    break
                except BlockingIOError:
                    time.sleep(RETRY_SECONDS)
                except OSError as error:
                    if error.errno == errno.ENOBUFS:  # the interface's queue is full
                        time.sleep(RETRY_SECONDS)
                        continue
                    raise PipelineError(
                        f"a frame of {len(padded)} bytes cannot be sent into {self.interface}: {error.strerror}; "
                        "raise the interface's MTU"
                    ) from None

    def send_block(self, block: FrameBlock) -> None:
        """As `send`: an interface takes one frame at a time."""
        self.send((), block.lengths.tolist(), list(block.frames()))

    def verdicts(self) -> bytes:
        """None: an interface gives no verdicts."""
        return b""

    def fileno(self) -> int:
        """Of the socket: the interface's own frames."""
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()


class VethPair:
    """A veth pair; removed when closed.

    Neither end has addresses, and IPv6 is off, so that the kernel sends no frames itself.

    Raises:
        BadInput: no permission, or the name is taken.
        PipelineError: the interfaces get no carrier.
    """

    def __init__(self, name: str) -> None:
        self.near, self.far = f"{name}a", f"{name}b"
        self._ip(
            "link",
            "add",
            self.near,
            "mtu",
            str(MTU),
            "type",
            "veth",
            "peer",
            "name",
            self.far,
            "mtu",
            str(MTU),
        )
        try:
            for end in (self.near, self.far):
                Path(f"/proc/sys/net/ipv6/conf/{end}/disable_ipv6").write_text("1", encoding="ascii")
                self._ip("link", "set", end, "up")
            for end in (self.near, self.far):
                _wait_for_cable(end)
        except (OSError, PipelineError):
            self.close()
            raise

    @staticmethod
    def _ip(*arguments: str) -> None:
        done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
        if done.returncode:
            raise BadInput(f"ip {' '.join(arguments)}: {done.stderr.strip()}; veth pairs need root")

    def close(self) -> None:
        subprocess.run(["ip", "link", "delete", self.near], capture_output=True, check=False)

    @classmethod
    def make(cls, stack: ExitStack, label: str) -> Self:
        """A pair with a name of this process that is removed with `stack`."""
        _remove_orphans()
        pair = cls(f"sdn{label}{os.getpid()}")
        stack.callback(pair.close)
        return pair


def _wait_for_cable(interface: str) -> None:
    """Wait until the interface has a carrier: frames sent before are dropped without an error."""
    state = Path("/sys/class/net", interface, "operstate")
    deadline = time.monotonic() + _CABLE_SECONDS
    while state.read_text(encoding="ascii").strip() != "up":
        if time.monotonic() > deadline:
            raise PipelineError(f"{interface} has no carrier after {_CABLE_SECONDS:.0f} s; see `ip link`")
        time.sleep(RETRY_SECONDS)


_OURS = re.compile(r"sdn[a-z]+(\d+)a")


def _remove_orphans() -> None:
    """Pairs of processes that were killed before they could remove them."""
    for interface in Path("/sys/class/net").iterdir():
        found = _OURS.fullmatch(interface.name)
        if found and not Path(f"/proc/{found[1]}").exists():
            subprocess.run(["ip", "link", "delete", interface.name], capture_output=True, check=False)
