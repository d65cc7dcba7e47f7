"""The initiator of a conversation is responsible for the replies, so that a flood's victim is not blocked.

A reply is a TCP SYN-ACK or RST, an ICMP error, or a UDP packet back, soon after the initiator's last
packet.  An initiator is responsible for at most `REPLIES_PER_PACKET` replies per packet of its
own; further replies are a flood by the host that sends them.
"""

from typing import Final

from apps.kitsune import senders as product
from apps.kitsune.senders import REPLIES_PER_PACKET, Address

UDP_REPLY_S: Final = 5.0
TCP_REPLY_S: Final = 65.0
"""A half-open connection repeats its SYN-ACK for up to 63 s."""
_SYN, _RST, _ACK = 0x02, 0x04, 0x10

Key = tuple[bool, Address, int, int]
"""TCP or UDP, initiator's address, initiator's port, the other port."""


def is_tcp_reply(tcp_flags: int) -> bool:
    """Whether a packet is a SYN-ACK or RST, which never begin a conversation."""
    return bool(tcp_flags & _RST) or tcp_flags & (_SYN | _ACK) == _SYN | _ACK


class _Entry:
    __slots__ = ("credit", "sender", "time")

    def __init__(self, sender: int) -> None:
        self.sender = sender
        self.time = 0.0
        self.credit = 0


class Conversations:
    """Remembers recent initiators by addresses and ports; two generations bound its memory."""

    def __init__(self) -> None:
        self._young: dict[Key, _Entry] = {}
        self._old: dict[Key, _Entry] = {}
        self._turned = 0.0

    def responsible(self, sender: int, time: float, key: Key, reverse: Key, tcp_flags: int) -> int:
        """The sender held responsible for a TCP or UDP packet sent by `sender` under `key` at `time` (seconds)."""
        is_tcp = key[0]
        begun = None if is_tcp and tcp_flags & (_SYN | _ACK) == _SYN else self._find(reverse, time)
        reply = not is_tcp or is_tcp_reply(tcp_flags)
        if begun is None:
            if not (is_tcp and reply):
                self._begin(key, sender, time)
            return sender
        return _charge(begun, sender) if reply else sender

    def responsible_for_error(self, sender: int, time: float, key: Key) -> int:
        """The sender held responsible for an ICMP error that quotes a packet sent under `key`."""
        begun = self._find(key, time)
        return sender if begun is None else _charge(begun, sender)

    def _find(self, key: Key, time: float) -> _Entry | None:
        entry = self._young.get(key) or self._old.get(key)
        within = TCP_REPLY_S if key[0] else UDP_REPLY_S
        return entry if entry is not None and abs(time - entry.time) <= within else None

    def _begin(self, key: Key, sender: int, time: float) -> None:
        if not 0 <= time - self._turned <= TCP_REPLY_S or len(self._young) >= product.MOST_CONVERSATIONS:
            self._old, self._young, self._turned = self._young, {}, time
        entry = self._young.get(key)
        if entry is None or entry.sender != sender:
            entry = self._young[key] = _Entry(sender)
        entry.time = time
        entry.credit = min(entry.credit + REPLIES_PER_PACKET, 10 * REPLIES_PER_PACKET)


def _charge(begun: _Entry, sender: int) -> int:
    if begun.credit <= 0:
        return sender
    begun.credit -= 1
    return begun.sender
