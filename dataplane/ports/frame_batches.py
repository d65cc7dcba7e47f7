"""Many frames in one system call: recvmmsg and sendmmsg on a packet socket, without a Python object a frame.

    socket ── recvmmsg ──► slots ── what came, end to end ──► ReceivedFrames
    slices of the switch's output ── addresses and lengths ──► sendmmsg ──► socket

The system calls are those of the C library, found at run time; their structures are filled as columns by numpy.
Linux.
"""

import errno
from dataclasses import dataclass
from typing import Any, Final

import cffi
import numpy as np
from numpy.typing import NDArray

MOST_FRAMES: Final = 256
"""In one call."""
_ADDRESS: Final = 20
_PACKET_TYPE: Final = 10
"""Where `sll_pkttype` stands in a sockaddr_ll."""
_OUTGOING: Final = 4
_TRUNCATED: Final = 0x20
_DONT_WAIT: Final = 0x40

_FFI: Final = cffi.FFI()
_FFI.cdef("""
struct iovec { void *iov_base; size_t iov_len; };
struct msghdr {
    void *msg_name; uint32_t msg_namelen; struct iovec *msg_iov; size_t msg_iovlen;
    void *msg_control; size_t msg_controllen; int msg_flags;
};
struct mmsghdr { struct msghdr msg_hdr; unsigned int msg_len; };
int recvmmsg(int fd, struct mmsghdr *messages, unsigned int count, int flags, void *timeout);
int sendmmsg(int fd, struct mmsghdr *messages, unsigned int count, int flags);
""")
_LIBRARY: Final[Any] = _FFI.dlopen(None)

_FIELDS: Final = (
    ("name", "u8", "msg_name"),
    ("name_length", "u4", "msg_namelen"),
    ("pieces", "u8", "msg_iov"),
    ("piece_count", "u8", "msg_iovlen"),
    ("control", "u8", "msg_control"),
    ("control_length", "u8", "msg_controllen"),
    ("flags", "i4", "msg_flags"),
)
_MESSAGE: Final = np.dtype(
    {
        "names": [*(name for name, _, _ in _FIELDS), "length"],
        "formats": [*(kind for _, kind, _ in _FIELDS), "u4"],
        "offsets": [
            *(_FFI.offsetof("struct mmsghdr", "msg_hdr", field) for _, _, field in _FIELDS),
            _FFI.offsetof("struct mmsghdr", "msg_len"),
        ],
        "itemsize": _FFI.sizeof("struct mmsghdr"),
    }
)
_PIECE: Final = np.dtype([("base", "u8"), ("length", "u8")])
_Bytes = NDArray[np.uint8]


def _address(array: NDArray[Any]) -> int:
    return int(array.ctypes.data)


def _spaced(array: NDArray[Any], count: int) -> NDArray[np.uint64]:
    """Addresses of the first rows of an array."""
    return np.uint64(_address(array)) + np.uint64(array.strides[0]) * np.arange(count, dtype=np.uint64)


@dataclass(frozen=True, slots=True)
class ReceivedFrames:
    """Frames of others, as the kernel handed them over: views that hold until the next call."""

    slots: _Bytes
    """Shape (n, room): each frame at the beginning of its row."""
    lengths: NDArray[np.uint32]
    control: _Bytes
    """Shape (n, …): what the kernel said beside each frame."""
    oversized: int
    """Frames that did not fit, and are not here."""

    def joined(self) -> bytes:
        """All frames end to end."""
        memory, room = self.slots.reshape(-1).data, self.slots.shape[1]
        begins = range(0, self.slots.size, room)
        # a view costs less than a tenth of a microsecond; a mask up to the longest frame, a nanosecond a byte
        return b"".join(
            [memory[at : at + size] for at, size in zip(begins, self.lengths.tolist(), strict=True)]
        )

    def frame(self, row: int) -> bytes:
        """One frame."""
        return self.slots[row, : int(self.lengths[row])].tobytes()


class FrameReceiver:
    """Takes what a packet socket holds.

    descriptor: of the socket; not closed here
    room: bytes of the longest frame
    control: bytes for what the kernel says beside a frame
    """

    def __init__(self, descriptor: int, room: int, control: int) -> None:
        self._descriptor = descriptor
        self._slots = np.zeros((MOST_FRAMES, room), np.uint8)
        self._control = np.zeros((MOST_FRAMES, control), np.uint8)
        self._names = np.zeros((MOST_FRAMES, _ADDRESS), np.uint8)
        self._pieces = np.zeros(MOST_FRAMES, _PIECE)
        self._pieces["base"], self._pieces["length"] = _spaced(self._slots, MOST_FRAMES), room
        self._messages = np.zeros(MOST_FRAMES, _MESSAGE)
        self._messages["name"] = _spaced(self._names, MOST_FRAMES)
        self._messages["pieces"] = _spaced(self._pieces, MOST_FRAMES)
        self._messages["piece_count"] = 1
        self._messages["control"] = _spaced(self._control, MOST_FRAMES)
        self._pointer = _FFI.cast("struct mmsghdr *", _address(self._messages))

    def receive(self, limit: int) -> ReceivedFrames:
        """At most `limit` frames, without waiting.  Raises OSError, BlockingIOError where there is none."""
        limit = min(limit, MOST_FRAMES)
        self._messages["name_length"] = _ADDRESS
        self._messages["control_length"] = self._control.shape[1]
        count = _LIBRARY.recvmmsg(self._descriptor, self._pointer, limit, _DONT_WAIT, _FFI.NULL)
        if count < 0:
            raise OSError(_FFI.errno, "recvmmsg")  # OSError makes a BlockingIOError of EAGAIN
        told = self._messages[:count]
        self._control[:count][told["control_length"] == 0] = 0  # nothing was said; what stands there is old
        theirs = self._names[:count, _PACKET_TYPE] != _OUTGOING
        whole = theirs & ((told["flags"] & _TRUNCATED) == 0)
        oversized = int(np.count_nonzero(theirs)) - int(np.count_nonzero(whole))
        if whole.all():
            return ReceivedFrames(
                self._slots[:count], told["length"].copy(), self._control[:count], oversized
            )
        return ReceivedFrames(
            self._slots[:count][whole], told["length"][whole], self._control[:count][whole], oversized
        )


class FrameSender:
    """Sends frames that stand in one piece of memory.

    descriptor: of a socket that does not block; not closed here
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._pieces = np.zeros(MOST_FRAMES, _PIECE)
        self._messages = np.zeros(MOST_FRAMES, _MESSAGE)
        self._messages["pieces"] = _spaced(self._pieces, MOST_FRAMES)
        self._messages["piece_count"] = 1
        self._pointer = _FFI.cast("struct mmsghdr *", _address(self._messages))

    def send(self, data: bytes, begins: NDArray[np.int64], ends: NDArray[np.int64]) -> int:
        """Send each slice once; a frame that is refused is left out.

        data: what the slices are of
        begins, ends: of each frame

        How many were taken.
        """
        base = int(_FFI.cast("uintptr_t", _FFI.from_buffer(data)))
        sent = 0
        for first in range(0, len(begins), MOST_FRAMES):
            count = min(MOST_FRAMES, len(begins) - first)
            self._pieces["base"][:count] = base + begins[first : first + count]
            self._pieces["length"][:count] = ends[first : first + count] - begins[first : first + count]
            sent += self._send(count)
        return sent

    def _send(self, count: int) -> int:
        sent = done = 0
        while done < count:
            taken = _LIBRARY.sendmmsg(self._descriptor, self._pointer + done, count - done, _DONT_WAIT)
            if taken > 0:
                sent += taken
                done += taken
            elif _FFI.errno != errno.EINTR:
                done += 1  # this one was refused; those behind it may pass
        return sent
