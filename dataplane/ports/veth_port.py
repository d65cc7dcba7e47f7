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

import numpy as np
from numpy.typing import NDArray

from dataplane.frame_block import FrameBlock
from dataplane.ports.frame_batches import FrameReceiver, FrameSender, ReceivedFrames
from dataplane.ports.port import MAX_FRAME, Arrived, PortCounters, PortError, Unanswering

_ETH_P_ALL = 3
_SOL_PACKET = 263
_PACKET_ADD_MEMBERSHIP, _PACKET_AUXDATA, _PACKET_IGNORE_OUTGOING = 1, 8, 23
_PACKET_MR_PROMISC = 1
_AUXDATA = struct.Struct("=IIIHHHH")
_AUX_SPACE = socket.CMSG_SPACE(_AUXDATA.size)
_CONTROL_HEAD = struct.Struct("@Nii")
_CONTROL_FIELDS = np.dtype([("length", np.uintp), ("level", "i4"), ("kind", "i4")])
_VLAN_VALID, _TPID_VALID = 1 << 4, 1 << 6
_TPID = 0x8100
_ADDRESSES = 12
_ETHERNET_HEADER = 14
_VLAN_TAG = 4
_TAGGED = (0x8100, 0x88A8)
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
            self._receiver = FrameReceiver(self._socket.fileno(), MAX_FRAME + _VLAN_TAG, _AUX_SPACE)
            self._sender = FrameSender(self._socket.fileno())
        except (OSError, AttributeError) as error:
            raise PortError(
                f"veth port {interface}: {error}; it needs Linux, root, and an interface that is up"
            ) from error

    def fileno(self) -> int:
        return self._socket.fileno()

    def waiting(self) -> bool:
        return False

    def receive(self, limit: int) -> Arrived:
        try:
            found = self._receiver.receive(limit)
        except BlockingIOError:
            return Arrived()
        except OSError:
            # the interface went down; frames come again when it is back
            self.counters.failed += 1
            return Arrived()
        self.counters.oversized += found.oversized
        arrived = self._arrived(found)
        self.counters.received += len(arrived)
        return arrived

    def _arrived(self, found: ReceivedFrames) -> Arrived:
        tagged = tags_taken_out(found.control)
        if not tagged.any():
            lengths = found.lengths
            fits = lengths <= MAX_FRAME
            if fits.all():
                return Arrived(
                    block=FrameBlock(np.zeros(len(lengths), np.int64), lengths, lengths, found.joined())
                )
        frames = [
            with_vlan_tag(found.frame(row), found.control[row].tobytes()) if tagged[row] else found.frame(row)
            for row in range(len(found.lengths))
        ]
        short = [frame for frame in frames if len(frame) <= MAX_FRAME]
        self.counters.oversized += len(frames) - len(short)
        return Arrived(short)

    def send(self, frame: bytes) -> None:
        self.send_many(frame, np.zeros(1, np.int64), np.full(1, len(frame), np.int64))

    def send_many(self, data: bytes, begins: NDArray[np.int64], ends: NDArray[np.int64]) -> None:
        types = np.frombuffer(data, np.uint8)
        most = np.full(len(begins), self._mtu + _ETHERNET_HEADER)
        long = ends - begins > most
        if long.any():
            at = begins[long] + _ADDRESSES  # a frame over the MTU is long enough to have a type
            kind = types[at].astype(np.int64) << 8 | types[at + 1]
            most[long] += _VLAN_TAG * np.isin(kind, _TAGGED)
            long = ends - begins > most
            begins, ends = begins[~long], ends[~long]
            self.counters.oversized += int(np.count_nonzero(long))
        sent = self._sender.send(data, begins, ends)
        self.counters.sent += sent
        self.counters.failed += len(begins) - sent

    def close(self) -> None:
        self._socket.close()


def tags_taken_out(control: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Which frames had a VLAN tag on the wire that the kernel handed over beside them; shape (n,)."""
    heads = control[:, : _CONTROL_HEAD.size].copy().view(_CONTROL_FIELDS)[:, 0]
    ours = (heads["level"] == _SOL_PACKET) & (heads["kind"] == _PACKET_AUXDATA)
    status = control[:, _CONTROL_HEAD.size : _CONTROL_HEAD.size + 4].copy().view("=u4")[:, 0]
    tagged: NDArray[np.bool_] = ours & (status & _VLAN_VALID != 0)
    return tagged


def with_vlan_tag(frame: bytes, control: bytes) -> bytes:
    """The frame as it was on the wire, from the auxiliary data that holds its outer tag."""
    status, _, _, _, _, tci, tpid = _AUXDATA.unpack_from(control, _CONTROL_HEAD.size)
    tag = struct.pack("!HH", tpid if status & _TPID_VALID else _TPID, tci)
    return frame[:_ADDRESSES] + tag + frame[_ADDRESSES:]


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
