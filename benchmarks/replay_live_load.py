"""An office's frames into both ends of a wire at a steady rate: sendmmsg, in a process of its own.

    frames end to end ─ slices of a lap ─► sendmmsg ─► interface in the office's namespace
                                        └► sendmmsg ─► interface in the Internet's namespace

No Python object a frame: frames are made once, and a lap of them is sent again and again.
"""

import os
import socket
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.decision_traffic.capture_writer import frames_in
from benchmarks.decision_traffic.networks import NETWORKS
from dataplane.frame_block import FrameBlock
from dataplane.ports.frame_batches import FrameSender
from sdnator.network_namespaces import inside

LAP: Final = 60_000
"""Frames that differ."""
_TICK_S: Final = 0.001
_MOST_OWED_S: Final = 0.02
"""What could not be offered for so long is given up: the rate is to be steady, without bursts."""
_PRECEDENCE: Final = 10
"""Steps of nice value above all that is measured: a wire does not wait for the programs behind it."""
_OPENS_S: Final = 9 * 3600.0
_HOUR_S: Final = 3600.0
_HOURS: Final = 4
_SYN: Final = 0x02
_SEND_BUFFER: Final = 8 << 20
_SO_SNDBUFFORCE: Final = 32


class Offered(NamedTuple):
    """What one order came to."""

    sent: tuple[int, int]
    """Frames that the interface took, by end."""
    seconds: float


@dataclass(frozen=True, eq=False)
class Lap:
    """Frames of both ends in order."""

    data: bytes
    starts: NDArray[np.int64]
    """Where each begins, and the end of the last."""
    outside: NDArray[np.bool_]
    """Whether a frame comes from the Internet."""

    def __len__(self) -> int:
        return len(self.outside)

    @classmethod
    def of(cls, frames: list[bytes], outside: NDArray[np.bool_]) -> "Lap":
        """Join frames."""
        none: list[int] = []
        block = FrameBlock.of(none, none, frames)
        return cls(block.data, block.starts(), outside)

    def slices(self, first: int, count: int, end: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Beginnings and ends of an end's frames among `count` from `first` on, which begin again after a lap.

        Args:
            first: number of the first frame; any number.
            count: frames of both ends.
            end: 0: the office's; 1: the Internet's.
        """
        rows = np.arange(first, first + count) % len(self)
        rows = rows[self.outside[rows] == bool(end)]
        return self.starts[rows], self.starts[rows + 1]


def office_lap(seed: int, frames: int = LAP) -> Lap:
    """A morning of an office, from nine o'clock on, without the SYNs and SYN-ACKs that open TCP connections.

    A morning within a minute opens hundreds of times as many connections a second as Kitsune and the queries have
    learnt: to the product that is a SYN flood, and it challenges clients instead of forwarding their SYNs.
    """
    network = NETWORKS["office"](seed)
    found: list[bytes] = []
    outside: list[bool] = []
    for part in network.chunks(_OPENS_S, _OPENS_S + _HOURS * _HOUR_S):
        columns = part.columns
        opens = (columns["tcp_sport"] >= 0) & (columns["tcp_flags"] & _SYN != 0)
        from_outside = columns["port"] == network.uplink_port
        for data, opening, end in zip(frames_in(part), opens.tolist(), from_outside.tolist(), strict=True):
            if opening:
                continue
            found.append(data)
            outside.append(end)
            if len(found) == frames:
                return Lap.of(found, np.array(outside))
    return Lap.of(found, np.array(outside))


def load_process(pipe: Any, ends: tuple[tuple[str, str], tuple[str, str]], seed: int) -> None:
    """Offers (frames a second, seconds) as told until it is told 0; answers each with `Offered`.

    Args:
        pipe: to the benchmark.
        ends: namespace and interface of the office, and of the Internet.
        seed: of the traffic.
    """
    lap = office_lap(seed)
    sockets = [_open(namespace, interface) for namespace, interface in ends]
    senders = [FrameSender(each.fileno()) for each in sockets]
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, -_PRECEDENCE)
    position = 0
    pipe.send("ready")
    while order := pipe.recv():
        found, position = _offer(lap, senders, position, *order)
        pipe.send(found)
    for each in sockets:
        each.close()


def _offer(
    lap: Lap, senders: list[FrameSender], position: int, pps: float, seconds: float
) -> tuple[Offered, int]:
    began = due = time.monotonic()
    sent, owed = [0, 0], 0.0
    while (now := time.monotonic()) - began < seconds:
        owed = min(owed + pps * (now - due), pps * _MOST_OWED_S)
        due = now
        count = int(owed)
        owed -= count
        for end, sender in enumerate(senders):
            begins, stops = lap.slices(position, count, end)
            sent[end] += sender.send(lap.data, begins, stops)
        position += count
        time.sleep(_TICK_S)
    return Offered((sent[0], sent[1]), time.monotonic() - began), position


def _open(namespace: str, interface: str) -> socket.socket:
    with inside(namespace):
        # protocol 0: it receives nothing, and nothing waits in it
        opened = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
        with suppress(OSError):
            opened.setsockopt(socket.SOL_SOCKET, _SO_SNDBUFFORCE, _SEND_BUFFER)
        opened.bind((interface, 0))
        opened.setblocking(False)
    return opened
