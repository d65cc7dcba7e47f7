"""Frames of a network interface as record batches (AF_PACKET; Linux, needs CAP_NET_RAW)."""

import errno
import select
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Final

import numpy as np

from sdnator.capture.interfaces import ETH_P_ALL
from sdnator.capture.packet_sources import BATCH, Batch, frame_batch
from sdnator.errors import BadInput

_SOL_PACKET, _PACKET_ADD_MEMBERSHIP, _PACKET_AUXDATA, _PACKET_MR_PROMISC = 263, 1, 8, 1
_AUXDATA: Final = struct.Struct("=IIIHHHH")
_VLAN_VALID, _VLAN_TPID_VALID = 0x10, 0x40
_MOST: Final = 65_536
_PERIOD_S: Final = 0.1


class LiveSource:
    """Frames that arrive at an interface, in batches about every tenth of a second, until `stop()` is true.

    Also those for others: the interface is promiscuous meanwhile, as one at a mirror port has to be.  VLAN tags that
    the network card took off are put back.  An interface that goes down or is removed is waited for; `tell` gets a
    line about it.  Raises `BadInput` when there is no such interface or the rights are missing.
    """

    def __init__(
        self,
        interface: str,
        stop: Callable[[], bool] = lambda: False,
        tell: Callable[[str], None] = lambda _line: None,
    ) -> None:
        self._interface = interface
        self._stop = stop
        self._tell = tell
        self._index = 0
        self._down = False
        try:
            # protocol 0 until it is bound, or frames of all interfaces would come in
            self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
        except PermissionError:
            raise BadInput(
                f"{interface}: listening needs root or CAP_NET_RAW; use sudo, or give a capture"
            ) from None
        try:
            self._socket.setsockopt(_SOL_PACKET, _PACKET_AUXDATA, 1)
            self._attach(socket.if_nametoindex(interface))
        except OSError as error:
            self._socket.close()
            raise BadInput(
                f"{interface}: cannot listen ({error.strerror}); see `ip link` for names"
            ) from error
        self._socket.setblocking(False)

    def _attach(self, index: int) -> None:
        every = struct.pack("=iHH8s", index, _PACKET_MR_PROMISC, 0, b"")
        self._socket.setsockopt(_SOL_PACKET, _PACKET_ADD_MEMBERSHIP, every)
        self._socket.bind((self._interface, ETH_P_ALL))
        self._index = index

    def __iter__(self) -> Iterator[Batch]:
        start = 0
        with self._socket:
            while not self._stop():
                received = self._receive()
                if received:
                    frames, lengths, times = zip(*received, strict=True)
                    yield frame_batch(frames, lengths, np.array(times, dtype=np.int64), start)
                    start += len(received)

    def _receive(self) -> list[tuple[bytes, int, int]]:
        received: list[tuple[bytes, int, int]] = []
        self._follow_name()
        deadline = time.monotonic() + _PERIOD_S
        while len(received) < BATCH and (left := deadline - time.monotonic()) > 0:
            if not select.select([self._socket], [], [], left)[0]:
                break
            try:
                data, extra, _, sender = self._socket.recvmsg(
                    _MOST, socket.CMSG_SPACE(_AUXDATA.size), socket.MSG_TRUNC
                )
            except OSError as error:
                if error.errno != errno.ENETDOWN:
                    raise
                self._gone()
                break
            self._down = False
            if sender[2] != socket.PACKET_OUTGOING:
                frame, length = _whole(data, extra)
                received.append((frame, length, time.time_ns()))
        return received

    def _gone(self) -> None:
        if not self._down:
            self._tell(f"{self._interface} is down: waiting until it is back")
        self._down = True

    def _follow_name(self) -> None:
        """The kernel attaches us again to an interface that was down, but not to a new one of the same name."""
        with suppress(OSError):  # there is none now
            if (index := socket.if_nametoindex(self._interface)) != self._index:
                self._attach(index)


def _whole(data: bytes, extra: list[tuple[int, int, bytes]]) -> tuple[bytes, int]:
    """The frame with its VLAN tag, and its length on the wire."""
    for level, kind, value in extra:
        if level == _SOL_PACKET and kind == _PACKET_AUXDATA:
            status, length, _, _, _, tag, tpid = _AUXDATA.unpack(value[: _AUXDATA.size])
            if status & _VLAN_VALID:
                tpid = tpid if status & _VLAN_TPID_VALID else 0x8100
                return data[:12] + struct.pack(">HH", tpid, tag) + data[12:], length + 4
            return data, length
    return data, len(data)
