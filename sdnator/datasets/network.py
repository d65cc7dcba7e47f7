"""What the house answers: the gateway, name service, neighbours and the victims of floods.

    Sent … (in order of time) ──► NetworkModel.answers ──► Frame …

The uplink is dead, as it was in the lab of the original: the gateway answers what goes out with ICMP
unreachable, at most one a second for each asker.  Victims answer floods; their answers are benign.
"""

import heapq
from collections import deque
from collections.abc import Iterable, Iterator
from typing import Final

from sdnator.datasets import frames
from sdnator.datasets.hosts import BY_IP, GATEWAY, PC, LanHost, is_local
from sdnator.datasets.traffic import ARP, ECHO, RAW, SECOND, TCP, UDP, Chance, SentPacket, WireFrame, as_frame

OPEN_PORTS: Final = {PC.ip: {80, 445}, GATEWAY.ip: {53, 80}}
_BACKLOG: Final = 256
"""Half-open connections that a victim holds; it answers no SYN while they are all taken."""
_RETRIES: Final = (1, 3, 7, 15, 31)
"""Seconds after which a SYN-ACK is sent again; a half-open connection lives for 63 s."""
_HALF_OPEN_S: Final = 63
_UNREACHABLE_BURST: Final = 6
_QUOTED: Final = 64
"""Bytes of a packet, from its IP header on, that an ICMP error quotes at most here."""


class _Limit:
    """Linux's limit on ICMP errors: one a second for each address, six in a burst."""

    def __init__(self) -> None:
        self._tokens: dict[tuple[bytes, bytes], tuple[int, float]] = {}

    def allows(self, who: bytes, to: bytes, time: int) -> bool:
        last, tokens = self._tokens.get((who, to), (time, float(_UNREACHABLE_BURST)))
        tokens = min(tokens + (time - last) / SECOND, _UNREACHABLE_BURST)
        allowed = tokens >= 1
        self._tokens[who, to] = (time, tokens - 1 if allowed else tokens)
        return allowed


class NetworkModel:
    """Puts packets on the wire, in order of time, with the answers that they get.

    Args:
        chance: of the delays of answers.
        snap: bytes kept of each frame.
        cookies: victims answer every SYN (SYN cookies), instead of 256 half-open connections at most.
    """

    def __init__(self, chance: Chance, snap: int, *, cookies: bool = False) -> None:
        self._chance = chance
        self._snap = snap
        self._cookies = cookies
        self._limit = _Limit()
        self._half_open: dict[bytes, deque[int]] = {}

    def carry(self, packets: Iterable[SentPacket]) -> Iterator[WireFrame]:
        """Frames in order of time; `packets` come in order of time."""
        pending: list[tuple[int, int, WireFrame]] = []
        for number, sent in enumerate(packets):
            while pending and pending[0][0] <= sent.time:
                yield heapq.heappop(pending)[2]
            frame = as_frame(sent, self._snap)
            yield frame
            for order, answer in enumerate(self._answers(sent, frame)):
                heapq.heappush(pending, (answer.time, number * 8 + order, answer))
        while pending:
            yield heapq.heappop(pending)[2]

    def _answers(self, sent: SentPacket, frame: WireFrame) -> Iterator[WireFrame]:
        if sent.kind == RAW or sent.dst[0] >> 4 == 0xE:
            return
        if sent.kind == ARP:
            yield from self._arp_reply(sent)
        elif not is_local(sent.dst):
            yield from self._unreachable(sent, frame, GATEWAY, 0.00045)
        elif sent.kind == UDP:
            yield from self._udp_reply(sent, frame)
        elif sent.kind == ECHO and sent.dst in BY_IP:
            reply = sent._replace(src=BY_IP[sent.dst], dst=sent.src.ip, flags=1, attacker="")
            yield self._later(reply, 0.003 if sent.dst != GATEWAY.ip else 0.0005)
        elif sent.kind == TCP and sent.dst in BY_IP:
            yield from self._tcp_reply(sent)

    def _later(self, answer: SentPacket, delay: float) -> WireFrame:
        return as_frame(answer._replace(time=answer.time + self._chance.around(delay, delay / 6)), self._snap)

    def _arp_reply(self, sent: SentPacket) -> Iterator[WireFrame]:
        owner = BY_IP.get(sent.dst)
        if owner is not None and owner is not sent.src:
            data = frames.arp(2, owner.mac, owner.ip, sent.src.mac, sent.src.ip)
            time = sent.time + self._chance.around(0.0003, 0.00003)
            yield WireFrame(time, frames.MIN_FRAME, frames.pad(data), "")

    def _unreachable(
        self, sent: SentPacket, frame: WireFrame, by: LanHost, delay: float
    ) -> Iterator[WireFrame]:
        """An ICMP error that quotes the packet: port unreachable from its target, else network."""
        if not self._limit.allows(by.ip, sent.src.ip, sent.time):
            return
        size = min(sent.length - 14, 576 - 28)
        if sent.kind == TCP and sent.length == frames.MIN_FRAME:
            size = 44
        quoted = frame.data[14 : 14 + min(size, _QUOTED)]
        more = size - len(quoted)
        body = frames.icmp(3, 3 if by.ip == sent.dst else 0, bytes(4), quoted)
        packet = frames.ipv4(by.ip, sent.src.ip, frames.ICMP, body, more=more)
        data = frames.ethernet(sent.src.mac, by.mac, frames.TYPE_IPV4, packet)
        time = sent.time + self._chance.around(delay, delay / 8)
        yield WireFrame(time, max(len(data) + more, frames.MIN_FRAME), frames.pad(data), "")

    def _udp_reply(self, sent: SentPacket, frame: WireFrame) -> Iterator[WireFrame]:
        if sent.dst == GATEWAY.ip and sent.dport == 53:
            if sent.answered:
                back = sent._replace(src=GATEWAY, dst=sent.src.ip, sport=53, dport=sent.sport, attacker="")
                yield self._later(back, 0.0022)
        elif sent.dst in BY_IP and sent.sport != 1_900:  # nobody asked for it, unless it is an SSDP answer
            yield from self._unreachable(sent, frame, BY_IP[sent.dst], 0.0006)

    def _tcp_reply(self, sent: SentPacket) -> Iterator[WireFrame]:
        """SYN-ACK from an open port, RST from a closed one; the attack's own sessions answer themselves."""
        if sent.answered or sent.flags & (frames.RST | frames.FIN):
            return
        victim = BY_IP[sent.dst]
        is_open = sent.dport in OPEN_PORTS.get(victim.ip, ())
        syn = sent.flags & (frames.SYN | frames.ACK) == frames.SYN
        flags = frames.SYN | frames.ACK if syn and is_open else frames.RST | (frames.ACK if syn else 0)
        back = SentPacket(
            *(sent.time, TCP, victim, sent.src.ip, frames.MIN_FRAME, sent.dport, sent.sport, flags),
            number=sent.number,
        )
        if not flags & frames.SYN or self._cookies:
            yield self._later(back, 0.0004)
        elif self._has_room(victim, sent.time):
            for delay in (0, *_RETRIES):
                yield self._later(back._replace(time=sent.time + delay * SECOND), 0.0004)

    def _has_room(self, victim: LanHost, time: int) -> bool:
        half_open = self._half_open.setdefault(victim.ip, deque())
        while half_open and half_open[0] <= time:
            half_open.popleft()
        if len(half_open) >= _BACKLOG:
            return False
        half_open.append(time + _HALF_OPEN_S * SECOND)
        return True
