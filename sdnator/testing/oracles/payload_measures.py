"""Lengths and entropies of names and payloads, one packet at a time: slow and obvious.

Nothing of the product is used. -1 stands for what a packet does not have.
"""

import math
from collections import Counter

from sdnator.testing.oracles.sonata import COPIED, NaivePacket


def name_text(payload: bytes) -> bytes | None:
    """The first question's name as people write it, in lower case; None for no question.

    Args:
        payload: of a UDP datagram, as far as it was copied.
    """
    if len(payload) < 12 or payload[4:6] == b"\0\0":
        return None
    labels = []
    rest = payload[12:]
    while rest and rest[0]:
        labels.append(rest[1 : 1 + rest[0]])
        rest = rest[1 + rest[0] :]
    return b".".join(labels).lower()


def entropy(data: bytes) -> int:
    """Shannon entropy, thousandths of a bit a byte; 0 for no bytes.

    Args:
        data: any bytes.
    """
    shares = [count / len(data) for count in Counter(data).values()]
    return round(-1000 * sum(share * math.log2(share) for share in shares))


def name_measures(packet: NaivePacket) -> tuple[int, int]:
    """(length, entropy) of the name in a packet.

    Args:
        packet: as `sonata.read` makes it.
    """
    text = name_text(packet.payload) if packet.protocol == 17 and 53 in (packet.sport, packet.dport) else None
    return (-1, -1) if text is None else (len(text), entropy(text))


def payload_length(frame: bytes) -> int:
    """Length of the TCP or UDP payload of an untagged frame without IPv6 extension headers, as its headers say.

    Args:
        frame: whole.
    """
    body = frame[14:COPIED]
    if frame[12:14] == b"\x08\x00":
        header, total, protocol = (body[0] & 15) * 4, int.from_bytes(body[2:4], "big"), body[9]
    else:
        header, total, protocol = 40, 40 + int.from_bytes(body[4:6], "big"), body[6]
    if protocol not in (6, 17):
        return -1
    return total - header - (8 if protocol == 17 else (body[header + 12] >> 4) * 4)
