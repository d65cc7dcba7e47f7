"""First reading of a capture: number of packets, times, and notes."""

from array import array
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sdnator.capture.capture_blocks import FrameIndex
from sdnator.capture.captures import Capture, CutCapture

_BATCH = 16_384


@dataclass(frozen=True, eq=False)
class Survey:
    """Facts that a replay needs about its capture before it begins."""

    path: Path
    time_ns: NDArray[np.int64]
    """Capture time of each packet, ns since the epoch (UTC)."""
    eth_src: NDArray[np.uint64]
    ipv4_src: NDArray[np.uint32]
    """Source address of IPv4 frames (behind up to two VLAN tags) and of ARP; 0 for others."""
    bytes: int
    cut: CutCapture | None
    lengths: NDArray[np.uint32]
    """Bytes of each frame on the wire."""
    captured: NDArray[np.uint32]
    """Bytes of each frame in the capture."""
    plain: bool
    """The file is pcap, and not gzipped."""

    @property
    def packets(self) -> int:
        return len(self.time_ns)

    @cached_property
    def base_us(self) -> int:
        """Start of the earliest packet's second, us since the epoch: the switch counts from here."""
        return int(self.time_ns.min()) // 1_000_000_000 * 1_000_000

    def frames(self) -> FrameIndex:
        """For the second reading."""
        return FrameIndex(self.time_ns // 1_000 - self.base_us, self.lengths, self.captured, self.plain)

    def notes(self) -> list[str]:
        """Notes about the capture for the report."""
        found = [] if self.cut is None else [str(self.cut)]
        if bool((self.time_ns % 1_000 != 0).any()):
            found.append(
                "the capture has nanosecond times; the switch's clock counts microseconds, so they are truncated"
            )
        backwards = int(np.count_nonzero(np.diff(self.time_ns) < 0))
        if backwards:
            found.append(f"time runs backwards at {backwards:,} packets of the capture")
        return found


def survey(path: Path, progress: Callable[[int, int], None] | None = None) -> Survey:
    """Read a capture once.

    Args:
        path: the capture.
        progress: called with (bytes read, bytes in the file) now and then.

    Raises:
        CaptureError: as `Capture` does.
    """
    times, macs, addresses = array("q"), array("Q"), array("I")  # lists would take ten times as much memory
    lengths, captured = array("I"), array("I")
    with Capture(path) as capture:
        for time_ns, length, data in capture:
            times.append(time_ns)
            macs.append(int.from_bytes(data[6:12], "big"))
            addresses.append(_ipv4_source(data))
            lengths.append(length)
            captured.append(len(data))
            if progress is not None and len(times) % _BATCH == 0:
                progress(capture.position, capture.size)
        cut, plain = capture.cut, capture.plain
    wire = np.array(lengths, np.uint32)
    return Survey(
        path,
        np.array(times, np.int64),
        np.array(macs, np.uint64),
        np.array(addresses, np.uint32),
        int(wire.sum(dtype=np.int64)),
        cut,
        wire,
        np.array(captured, np.uint32),
        plain,
    )


def _ipv4_source(data: bytes) -> int:
    offset = 12
    ethertype = data[12:14]
    while ethertype in (b"\x81\x00", b"\x88\xa8") and offset < 20:
        offset += 4
        ethertype = data[offset : offset + 2]
    if ethertype == b"\x08\x00":
        return int.from_bytes(data[offset + 14 : offset + 18], "big")
    if ethertype == b"\x08\x06":
        return int.from_bytes(data[offset + 16 : offset + 20], "big")
    return 0
