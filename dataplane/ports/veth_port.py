"""A port on a network interface (veth or real) through AF_PACKET; Linux, needs root or CAP_NET_RAW.

What the kernel does to frames behind a switch's back is undone here: a VLAN tag that it took out of the
frame comes back from PACKET_AUXDATA, frames that we sent ourselves are not seen again, and offloads that
make frames larger than the wire, or leave checksums unfinished, are turned off.
"""

import contextlib
import ctypes
import fcntl
import socket
import struct

from dataplane.ports.port import MAX_FRAME, Arrived, PortCounters, PortError, Unanswering

_ETH_P_ALL = 3
_SOL_PACKET = 263
_PACKET_ADD_MEMBERSHIP, _PACKET_AUXDATA, _PACKET_IGNORE_OUTGOING = 1, 8, 23
_PACKET_MR_PROMISC = 1
_PACKET_OUTGOING = 4
_AUXDATA = struct.Struct("=IIIHHHH")
_AUX_SPACE = socket.CMSG_SPACE(_AUXDATA.size)
_VLAN_VALID, _TPID_VALID = 1 << 4, 1 << 6
_TPID = 0x8100
_ADDRESSES = 12
_ETHERNET_HEADER = 14
_VLAN_TAG = 4
_SIOCGIFMTU, _SIOCETHTOOL = 0x8921, 0x8946
# ETHTOOL_SRXCSUM, STXCSUM, SSG, STSO, SUFO, SGSO, SGRO
_OFFLOADS = (0x15, 0x17, 0x19, 0x1F, 0x22, 0x24, 0x2C)
_RECEIVE_BUFFER = 8 << 20
_SO_RCVBUFFORCE = 33


class VethPort(Unanswering):
    """Frames of an interface, both ways.

    interface: its name; it must exist and be up

    Raises PortError.
    """

    lossless = False

    def __init__(self, interface: str) -> None:
        self.counters = PortCounters()
        try:
            self._socket = _open(interface)
            self._mtu = _mtu(self._socket, interface)
        except (OSError, AttributeError) as error:
            raise PortError(
                f"veth port {interface}: {error}; it needs Linux, root, and an interface that is up"
            ) from error

    def fileno(self) -> int:
        return self._socket.fileno()

    def waiting(self) -> bool:
        return False

    def receive(self, limit: int) -> Arrived:
        frames: list[bytes] = []
        with contextlib.suppress(BlockingIOError):
            while len(frames) < limit:
                self._receive_one(frames)
        self.counters.received += len(frames)
        return Arrived(frames)

    def _receive_one(self, frames: list[bytes]) -> None:
        try:
            data, ancillary, flags, address = self._socket.recvmsg(1 << 16, _AUX_SPACE)
        except OSError as error:
            if isinstance(error, BlockingIOError):
                raise
            # the interface went down; frames come again when it is back
            self.counters.failed += 1
            raise BlockingIOError from error
        if address[2] == _PACKET_OUTGOING:
            return
        data = with_vlan_tag(data, ancillary)
        if len(data) > MAX_FRAME or flags & socket.MSG_TRUNC:
            self.counters.oversized += 1
            return
        frames.append(data)

    def send(self, frame: bytes) -> None:
        tag = _VLAN_TAG if frame[_ADDRESSES : _ADDRESSES + 2] in (b"\x81\x00", b"\x88\xa8") else 0
        if len(frame) > self._mtu + _ETHERNET_HEADER + tag:
            self.counters.oversized += 1
            return
        try:
            self._socket.send(frame)
        except OSError:
            self.counters.failed += 1
            return
        self.counters.sent += 1

    def close(self) -> None:
        self._socket.close()


def with_vlan_tag(frame: bytes, ancillary: list[tuple[int, int, bytes]]) -> bytes:
    """The frame as it was on the wire: the kernel hands the outer tag over beside it."""
    for level, kind, data in ancillary:
        if (level, kind) != (_SOL_PACKET, _PACKET_AUXDATA) or len(data) < _AUXDATA.size:
            continue
        status, _, _, _, _, tci, tpid = _AUXDATA.unpack_from(data)
        if status & _VLAN_VALID:
            tag = struct.pack("!HH", tpid if status & _TPID_VALID else _TPID, tci)
            return frame[:_ADDRESSES] + tag + frame[_ADDRESSES:]
    return frame


def _open(interface: str) -> socket.socket:
    index = socket.if_nametoindex(interface)
    # protocol 0 until it is bound, or frames of all interfaces would come in
    opened = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    try:
        opened.setsockopt(_SOL_PACKET, _PACKET_AUXDATA, 1)
        with contextlib.suppress(OSError):
            opened.setsockopt(_SOL_PACKET, _PACKET_IGNORE_OUTGOING, 1)
        with contextlib.suppress(OSError):
            opened.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER)
        promiscuous = struct.pack("=iHH8s", index, _PACKET_MR_PROMISC, 0, b"")
        opened.setsockopt(_SOL_PACKET, _PACKET_ADD_MEMBERSHIP, promiscuous)
        turn_off_offloads(opened, interface)
        opened.bind((interface, _ETH_P_ALL))
        opened.setblocking(False)
    except OSError:
        opened.close()
        raise
    return opened


def turn_off_offloads(opened: socket.socket, interface: str) -> None:
    """Checksum, segmentation and receive-merging offloads off, where the driver has them."""
    for command in _OFFLOADS:
        value = ctypes.create_string_buffer(struct.pack("=II", command, 0))
        request = struct.pack("16sP8x", interface.encode(), ctypes.addressof(value))
        with contextlib.suppress(OSError):
            fcntl.ioctl(opened, _SIOCETHTOOL, request)


def _mtu(opened: socket.socket, interface: str) -> int:
    answer = fcntl.ioctl(opened, _SIOCGIFMTU, struct.pack("16si20x", interface.encode(), 0))
    return int(struct.unpack("16si20x", answer)[1])
