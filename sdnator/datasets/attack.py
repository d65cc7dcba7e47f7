"""An infection with Mirai: break-in, scanning, command-and-control, floods.

    break-in ─► ARP sweep ─► telnet scan ………………………………………………………►
                             heartbeat to the intruder ……………………►
                                    UDP flood … SYN flood … ACK flood … (again)

Every packet here belongs to the attack and names its sender.  What victims answer, and what the
infected camera sends for its own purposes, is benign and made elsewhere.

Source of the behaviour: Antonakakis et al., Understanding the Mirai Botnet, USENIX Security 2017:
stateless SYN scan with the target's address as sequence number, port 23 nine times of ten, else 2323.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from sdnator.datasets import frames
from sdnator.datasets import hosts as h
from sdnator.datasets.traffic import ARP, SECOND, TCP, UDP, Chance, SentPacket

TELNET, TELNET_ALTERNATIVE, COMMAND_PORT = 23, 2_323, 48_101
FLOODS: Final = ("udp", "syn", "ack")


@dataclass(frozen=True)
class AttackPlan:
    """What the intruder wants."""

    floods: tuple[str, ...] = FLOODS
    scan: bool = True
    scan_rate: tuple[float, float] = (15, 30)
    """Telnet probes a second, from … to."""
    flood_rate: tuple[float, float] = (60, 140)
    """Packets a second, from … to."""
    flood_seconds: tuple[float, float] = (25, 45)
    answer_all: bool = False
    """The victim of a SYN flood answers every SYN with a SYN-ACK, and that of an ACK flood with RSTs."""


def traffic(seed: int, start: int, end: int, plan: AttackPlan) -> list[SentPacket]:
    """All attack packets from `start` to `end` (µs), in order of time."""
    parts = [_break_in(Chance(seed, 2, 0), start), _commands(Chance(seed, 2, 1), start + 6 * SECOND, end)]
    if plan.scan:
        parts.append(_arp_sweep(Chance(seed, 2, 2), start + 8 * SECOND, end))
        parts.append(_telnet_scan(Chance(seed, 2, 3), start + 14 * SECOND, end, plan))
    if plan.floods:
        parts.append(_floods(Chance(seed, 2, 4), start + 60 * SECOND, end, plan))
    sent = [packet for part in parts for packet in part if start <= packet.time < end]
    sent.sort(key=lambda packet: packet.time)
    return sent


def _from(src: h.LanHost, packet: SentPacket) -> SentPacket:
    return packet._replace(attacker=src.mac_text)


def _segment(
    time: int, src: h.LanHost, dst: h.LanHost, ports: tuple[int, int], flags: int, *, size: int = 0
) -> SentPacket:
    """A segment of a session between the intruder and the camera, with `size` bytes of payload."""
    length = max(54 + size, frames.MIN_FRAME) if not flags & frames.SYN else 74
    return SentPacket(
        time,
        TCP,
        src,
        dst.ip,
        length,
        *ports,
        flags,
        payload=bytes(size),
        attacker=src.mac_text,
        answered=True,
    )


def _session(
    chance: Chance,
    time: int,
    client: h.LanHost,
    server: h.LanHost,
    *,
    port: int,
    talk: tuple[tuple[bool, int], ...],
    pace: tuple[float, float] = (0.02, 0.25),
) -> Iterator[SentPacket]:
    """A TCP session; `talk` = (from the client?, bytes) in turn, each acknowledged."""
    sport = chance.port()
    out, back = (sport, port), (port, sport)
    syn, ack, push = frames.SYN, frames.ACK, frames.PSH | frames.ACK
    yield _segment(time, client, server, out, syn)
    yield _segment(time + 400, server, client, back, syn | ack)
    yield _segment(time + 800, client, server, out, ack)
    for from_client, size in talk:
        time += chance.between(*pace)
        if from_client:
            yield _segment(time, client, server, out, push, size=size)
            yield _segment(time + 500, server, client, back, ack)
        else:
            yield _segment(time, server, client, back, push, size=size)
            yield _segment(time + 500, client, server, out, ack)
    yield _segment(time + 2_000, client, server, out, frames.FIN | ack)
    yield _segment(time + 2_500, server, client, back, frames.FIN | ack)


def _break_in(chance: Chance, start: int) -> Iterator[SentPacket]:
    """Logs in over telnet after a few guesses, has the camera fetch its new program from the intruder."""
    for packet in (
        SentPacket(start, ARP, h.INTRUDER, h.INFECTED.ip, frames.MIN_FRAME),
        SentPacket(start + 3 * SECOND, ARP, h.INFECTED, h.INTRUDER.ip, frames.MIN_FRAME),
    ):
        yield _from(packet.src, packet)
    login = tuple((bool(turn % 2), chance.number(6, 40)) for turn in range(16))
    yield from _session(chance, start + 200_000, h.INTRUDER, h.INFECTED, port=TELNET, talk=login)
    yield from _download(chance, start + 4 * SECOND, chance.number(30, 45), (0.0009, 0.0025))


def _download(chance: Chance, start: int, segments: int, pace: tuple[float, float]) -> Iterator[SentPacket]:
    """The camera asks the intruder for a program and gets it in `segments` full segments."""
    talk = ((True, 120), *((False, 1_448) for _ in range(segments)))
    yield from _session(chance, start, h.INFECTED, h.INTRUDER, port=80, talk=talk, pace=pace)


def _commands(chance: Chance, start: int, end: int) -> Iterator[SentPacket]:
    """Registers with the intruder, two bytes there and back about once a minute, now and then a new program."""
    sport = chance.port()
    out, back = (sport, COMMAND_PORT), (COMMAND_PORT, sport)
    yield _segment(start, h.INFECTED, h.INTRUDER, out, frames.SYN)
    yield _segment(start + 400, h.INTRUDER, h.INFECTED, back, frames.SYN | frames.ACK)
    yield _segment(start + 800, h.INFECTED, h.INTRUDER, out, frames.ACK)
    for at in chance.every(60, 1, start, end):
        yield _segment(at, h.INFECTED, h.INTRUDER, out, frames.PSH | frames.ACK, size=2)
        yield _segment(at + 700, h.INTRUDER, h.INFECTED, back, frames.PSH | frames.ACK, size=2)
    for at in chance.every(150, 10, start + 100 * SECOND, end):
        yield from _download(chance, at, chance.number(140, 190), (0.015, 0.03))


def _arp_sweep(chance: Chance, start: int, end: int) -> Iterator[SentPacket]:
    """Who has each address of the LAN, again and again."""
    for sweep in (start, *chance.every(75, 10, start + 60 * SECOND, end)):
        at = sweep
        for number in chance.pick(1, 254, 254):
            yield _from(
                h.INFECTED, SentPacket(at, ARP, h.INFECTED, bytes((192, 168, 2, number)), frames.MIN_FRAME)
            )
            at += chance.number(20_000, 180_000)


def _telnet_scan(chance: Chance, start: int, end: int, plan: AttackPlan) -> Iterator[SentPacket]:
    """SYNs to random addresses, one in five of them on the LAN, from one source port."""
    rate = chance.between(*plan.scan_rate) / SECOND
    at, sport = float(start), chance.port()
    while at < end:
        if chance.happens(0.2):
            dst = bytes((192, 168, 2, chance.number(2, 254)))
        else:
            dst = bytes((chance.number(1, 223), *(chance.number(0, 255) for _ in range(3))))
        port = TELNET_ALTERNATIVE if chance.happens(0.1) else TELNET
        yield _from(h.INFECTED, _tcp(int(at), dst, (sport, port), frames.SYN, int.from_bytes(dst, "big")))
        at += _wait(chance) * SECOND / rate


def _wait(chance: Chance) -> float:
    """Waiting time of a Poisson process of rate one, never longer than four."""
    return min(-math.log(chance.number(1, 1 << 30) / (1 << 30)), 4.0)


def _tcp(time: int, dst: bytes, ports: tuple[int, int], flags: int, number: int) -> SentPacket:
    length = 74 if flags & frames.SYN else frames.MIN_FRAME
    return SentPacket(time, TCP, h.INFECTED, dst, length, *ports, flags, number)


def _floods(chance: Chance, start: int, end: int, plan: AttackPlan) -> Iterator[SentPacket]:
    """The floods of the plan in turn, with pauses, again and again."""
    at, turn = start, 0
    while at < end:
        until = min(at + chance.between(*plan.flood_seconds), end)
        yield from _flood(chance, at, until, plan.floods[turn % len(plan.floods)], plan)
        at, turn = until + chance.between(25, 60), turn + 1


def _flood(chance: Chance, start: int, end: int, kind: str, plan: AttackPlan) -> Iterator[SentPacket]:
    gap = SECOND / (chance.between(*plan.flood_rate) / SECOND)
    ack_victim = h.PC.ip if plan.answer_all else h.CLOUD[0]
    at = float(start)
    while at < end:
        number, sport = chance.number(0, 0xFFFF_FFFF), chance.number(1_024, 65_535)
        if kind == "udp":
            packet = SentPacket(int(at), UDP, h.INFECTED, h.DOORBELL.ip, 554, sport, chance.number(1, 65_535))
        else:
            flags, dst = (frames.SYN, h.PC.ip) if kind == "syn" else (frames.ACK, ack_victim)
            packet = _tcp(int(at), dst, (sport, 80), flags, number)
        yield _from(h.INFECTED, packet)
        at += gap * (0.5 + chance.number(0, 1_000) / 1_000)
