"""Benign traffic of a house full of devices whose uplink is dead.

Every function is one device, or one habit of several: it yields what is sent from `start` to `end`.
Periods, sizes and destinations resemble the first 38,363 packets of the public Mirai capture: 27
packets a second in bursts, half of them UDP keep-alives to dead cloud hosts.
"""

from collections.abc import Callable, Iterator
from typing import Final

from sdnator.datasets import frames
from sdnator.datasets import hosts as h
from sdnator.datasets.traffic import ARP, ECHO, RAW, SECOND, TCP, UDP, Chance, SentPacket, burst, query

Device = Callable[[Chance, int, int], Iterator[SentPacket]]


def traffic(seed: int, start: int, end: int, news: int) -> list[SentPacket]:
    """All benign packets from `start` to `end` (µs), in order of time; from `news` on there is a new habit."""
    sent = [
        packet
        for number, device in enumerate((*DEVICES, media_player))
        for packet in device(Chance(seed, 1, number), news if device is media_player else start, end)
        if start <= packet.time < end
    ]
    sent.sort(key=lambda packet: packet.time)
    return sent


def _udp(time: int, src: h.LanHost, dst: bytes, length: int, ports: tuple[int, int]) -> SentPacket:
    return SentPacket(time, UDP, src, dst, length, *ports)


def _ask(
    time: int, src: h.LanHost, server: bytes, name: str, sport: int, *, answered: bool = False
) -> SentPacket:
    question = query(name, sport)
    return SentPacket(
        time, UDP, src, server, 42 + len(question), sport, 53, payload=question, answered=answered
    )


def _syn(time: int, src: h.LanHost, dst: bytes, sport: int, dport: int, *, length: int = 74) -> SentPacket:
    return SentPacket(
        time, TCP, src, dst, length, sport, dport, frames.SYN, number=(time * 2_654_435_761) & 0xFFFF_FFFF
    )


def _keep_alive(
    chance: Chance, src: h.LanHost, clouds: tuple[bytes, ...], times: Iterator[int], port: int
) -> Iterator[SentPacket]:
    """A round of 40-byte datagrams to every cloud host, back to back."""
    for time in times:
        at = time
        for cloud in clouds:
            yield _udp(at, src, cloud, 82, (port, 10_240))
            at += chance.number(1, 3) if chance.happens(0.7) else chance.number(100, 700)


def camera_wired(chance: Chance, start: int, end: int) -> Iterator[SentPacket]:
    """Keep-alives every half second in rounds of ten, and two TCP connections that never succeed."""
    for cycle in chance.every(9.05, 0.02, start, end):
        times = (cycle + number * SECOND // 2 + chance.number(0, 4_000) for number in range(10))
        yield from _keep_alive(chance, h.CAMERA_WIRED, h.CLOUD[:5], burst(times, end), chance.port())
    for cycle in chance.every(3.6, 0.02, start, end):
        ports = (chance.number(10_000, 40_000), chance.number(10_000, 40_000))
        for delay in (0.0, 0.5, 1.0):
            at = cycle + chance.around(delay, 0.002)
            yield _syn(at, h.CAMERA_WIRED, h.CLOUD[15], ports[0], 8_280, length=60)
            yield _syn(at + chance.number(2, 240), h.CAMERA_WIRED, h.CLOUD[14], ports[1], 80, length=60)


def camera_cloud(chance: Chance, start: int, end: int) -> Iterator[SentPacket]:
    """Five seconds of keep-alives to eight cloud hosts, then TCP to eleven with retries; pings now and then."""
    services = (80, 443, 8_000, 8_080, 21_047)
    clouds = h.CLOUD[:8] + h.CLOUD[9:13]
    for cycle in chance.every(24.3, 0.15, start, end):
        times = (cycle + number * 505_000 + chance.number(0, 3_000) for number in range(10))
        yield from _keep_alive(chance, h.CAMERA_CLOUD, h.CLOUD[:8], burst(times, end), chance.port())
        for number, cloud in enumerate(clouds):
            port, service = chance.port(), services[number % len(services)]
            opened = cycle + chance.around(5.6, 0.01)
            for delay in (0, 995_000, 2_996_000, 7_004_000):
                yield _syn(opened + delay + chance.number(0, 9_000), h.CAMERA_CLOUD, cloud, port, service)
    for cycle in chance.every(178, 0.5, start, end):
        for number in range(10):
            at = cycle + number * SECOND + chance.number(0, 1_500)
            yield SentPacket(at, ECHO, h.CAMERA_CLOUD, h.GATEWAY.ip, 98, number=number)


def doorbell(chance: Chance, start: int, end: int) -> Iterator[SentPacket]:
    """Nine connections every 12.7 s, a name asked every 5 s, a ping every 30 s."""
    targets = ((4, 8_000), (3, 443), (2, 80), (1, 8_080), (0, 21_047), (0, 443), (2, 80), (4, 8_000), (8, 80))
    for cycle in chance.every(12.7, 0.15, start, end):
        at = cycle
        for number, (cloud, service) in enumerate(targets):
            port = chance.port()
            at += chance.number(1_000, 4_000) if number != 5 else chance.around(0.1, 0.004)
            yield _syn(at, h.DOORBELL, h.CLOUD[cloud], port, service)
            for delay in (990_000, 2_990_000) if number > 5 else ():
                yield _syn(at + delay + chance.number(0, 9_000), h.DOORBELL, h.CLOUD[cloud], port, service)
    for at in chance.every(5.1, 0.3, start, end):
        name = ("time.doorbell.example", "cloud.doorbell.example", "p.doorbell.example")[chance.number(0, 2)]
        yield _ask(at, h.DOORBELL, h.GATEWAY.ip, name, chance.port())
    for number, at in enumerate(chance.every(30.1, 0.02, start, end)):
        yield SentPacket(at, ECHO, h.DOORBELL, h.GATEWAY.ip, 98, number=number)


def monitor(chance: Chance, start: int, end: int) -> Iterator[SentPacket]:
    """Asks for a long name every two seconds (answered) and for short ones; announces itself by SSDP."""
    port = 2_440
    for at in chance.every(2.0, 0.03, start, end):
        port = port + 1 if port < 4_900 else 1_024
        yield _ask(
            at, h.MONITOR, h.GATEWAY.ip, f"{'x' * 20}.{'registration' * 2}.example.lan", port, answered=True
        )
        yield _ask(at + chance.around(0.022, 0.006), h.MONITOR, h.GATEWAY.ip, "www.monitoring.example", port)
        yield _ask(
            at + chance.around(0.99, 0.008), h.MONITOR, h.GATEWAY.ip, "www.monitoring.example", port - 4
        )
    for at in chance.every(5.05, 0.1, start, end):
        yield _ask(at, h.MONITOR, h.GATEWAY.ip, "time.example", port, answered=chance.happens(0.4))
    for at in chance.every(30.0, 0.01, start, end):
        when = at
        for size in (429, 469, 471):
            yield _udp(when, h.MONITOR, h.SSDP_GROUP, size, (1_215, 1_900))
            when += chance.number(2, 1_500)


def pinged_dome(chance: Chance, start: int, end: int) -> Iterator[SentPacket]:
    """A PC pings the dome camera every second."""
    for number, at in enumerate(chance.every(1.013, 0.007, start, end)):
        yield SentPacket(at, ECHO, h.PC, h.DOME.ip, 74, number=number)


def _resolver(
    chance: Chance, src: h.LanHost, names: tuple[str, ...], *, period: float, start: int, end: int
) -> Iterator[SentPacket]:
    """Asks three servers in turn, two of them outside, and gets no answer."""
    servers = (h.GATEWAY.ip, *h.DNS_PUBLIC)
    for cycle in chance.every(period, period / 12, start, end):
        name, port, at = names[chance.number(0, len(names) - 1)], chance.port(), cycle
        for server in servers:
            yield _ask(at, src, server, name, port)
            at += chance.around(period / 4, period / 60)


def _web_retries(chance: Chance, src: h.LanHost, period: float, start: int, end: int) -> Iterator[SentPacket]:
    """Seven connections to a dead web server, 0.11 s apart, each tried again after three seconds."""
    for cycle in chance.every(period, period / 20, start, end):
        for number in range(7):
            at, port = cycle + number * 113_000 + chance.number(0, 8_000), chance.port()
            yield _syn(at, src, h.CLOUD[13], port, 80)
            yield _syn(at + 3_003_000 + chance.number(0, 900), src, h.CLOUD[13], port, 80)


def _seek_absent(chance: Chance, src: h.LanHost, start: int, end: int) -> Iterator[SentPacket]:
    """Asks once a second, for minutes at a time, who has the address of a device that is gone."""
    for cycle in chance.every(240, 30, start, end):
        times = (
            cycle + number * SECOND + chance.number(0, 12_000) for number in range(chance.number(50, 75))
        )
        for at in burst(times, end):
            yield SentPacket(at, ARP, src, h.address(h.ABSENT), frames.MIN_FRAME)


def _search(chance: Chance, src: h.LanHost, period: float, start: int, end: int) -> Iterator[SentPacket]:
    """SSDP searches that nobody answers."""
    for at in chance.every(period, period / 5, start, end):
        yield _udp(at, src, h.SSDP_GROUP, 179, (chance.port(), 1_900))


def dome(chance: Chance, start: int, end: int) -> Iterator[SentPacket]:
    names = ("www.dome-camera.example.net", "time.dome.example", "log.dome.example")
    yield from _resolver(chance, h.DOME, names, period=3.9, start=start, end=end)
    yield from _web_retries(chance, h.DOME, 85, start, end)
    yield from _seek_absent(chance, h.DOME, start, end)
    yield from _search(chance, h.DOME, 38, start, end)


def recorder(chance: Chance, start: int, end: int) -> Iterator[SentPacket]:
    names = ("sync.recorder.example.net", "time.recorder.example", "registration.recorder.example")
    yield from _resolver(chance, h.RECORDER, names, period=4.5, start=start, end=end)
    yield from _web_retries(chance, h.RECORDER, 100, start, end)
    yield from _seek_absent(chance, h.RECORDER, start, end)
    yield from _search(chance, h.RECORDER, 75, start, end)
    for at in chance.every(600, 60, start, end):
        yield _udp(at, h.RECORDER, h.SSDP_GROUP, 1_468, (3_702, 3_702))
        yield _igmp(at + chance.around(2, 0.5), h.RECORDER)


def _igmp(time: int, src: h.LanHost) -> SentPacket:
    """A report of group membership, with the router alert option left out."""
    body = frames.icmp(0x22, 0, bytes.fromhex("00000001"), bytes.fromhex("04000000efffFFfa"))  # same layout
    packet = frames.ipv4(src.ip, h.IGMP_GROUP, frames.IGMP, body, ttl=1)
    data = frames.ethernet(h.mac_towards(h.IGMP_GROUP), src.mac, frames.TYPE_IPV4, packet)
    return SentPacket(time, RAW, src, h.IGMP_GROUP, frames.MIN_FRAME, payload=data)


def plugs(chance: Chance, start: int, end: int) -> Iterator[SentPacket]:
    """Three smart plugs: two ask for their cloud and the time every ten seconds, one in groups of five."""
    for plug in (h.PLUG_A, h.PLUG_B):
        for at in chance.every(10.01, 0.01, start, end):
            yield _ask(at, plug, h.GATEWAY.ip, "devs.plug.example", chance.port())
        for at in chance.every(13.0, 2.0, start, end):
            yield _ask(at, plug, h.GATEWAY.ip, "time.plug.example.net", chance.port())
    port = 1_256
    for cycle in chance.every(8.0, 2.0, start, end):
        port = port + 1 if port < 4_900 else 1_024
        name = ("eu.disc.plug-cloud.example.net", "eu.ctl.plug-cloud.example.com")[port & 1]
        for delay in (0.0, 0.95, 1.0, 2.0, 3.95):
            yield _ask(cycle + chance.around(delay, 0.01), h.PLUG_OLD, h.GATEWAY.ip, name, port)


def camera_p2p(chance: Chance, start: int, end: int) -> Iterator[SentPacket]:
    """Looks for its three rendezvous servers every 40 s, asks two name servers in turn."""
    port = chance.port()
    for number, at in enumerate(chance.every(40.4, 0.02, start, end)):
        for size, count in ((60, 3), (90, 3)) if number % 7 == 0 else ((90, 3),):
            for cloud in h.CLOUD[16 : 16 + count]:
                yield _udp(at + chance.number(0, 900), h.CAMERA_P2P, cloud, size, (port, 32_100))
    for number, at in enumerate(chance.every(10.1, 0.3, start, end)):
        yield _ask(at, h.CAMERA_P2P, (h.GATEWAY.ip, h.DNS_PUBLIC[0])[number % 2], "p2p.camera.example", 3_126)


def small_devices(chance: Chance, start: int, end: int) -> Iterator[SentPacket]:
    """A webcam, a thermostat and a single-board computer that ask for names; a clock that asks for the time."""
    for at in chance.every(20, 8, start, end):
        yield _ask(at, h.WEBCAM, h.GATEWAY.ip, "api.webcam.example.net", chance.port())
    for cycle in chance.every(25.0, 0.03, start, end):
        port = chance.port()
        for delay in (0, 5_004_000):
            yield _ask(cycle + delay, h.THERMOSTAT, h.GATEWAY.ip, "hub.thermostat.example", port)
        yield _ask(
            cycle + 10_020_000,
            h.THERMOSTAT,
            h.GATEWAY.ip,
            f"{'hub.thermostat.' * 3}example",
            port + 1,
            answered=True,
        )
    for cycle in chance.every(400, 40, start, end):
        for number in range(6):
            for _ in range(2):
                at = cycle + number * 5 * SECOND + chance.number(0, 250)
                yield _ask(
                    at,
                    h.SINGLE_BOARD,
                    h.GATEWAY.ip,
                    "0.debian.pool.time.example",
                    chance.port(),
                    answered=number % 3 == 2,
                )
    for cycle in chance.every(280, 20, start, end):
        for number, server in enumerate(chance.pick(0, len(h.TIME_SERVERS) - 1, 3)):
            yield _udp(
                cycle + number * 2 * SECOND + chance.number(0, 4_000),
                h.CLOCK,
                h.TIME_SERVERS[server],
                90,
                (chance.port(), 123),
            )


def infrastructure(chance: Chance, start: int, end: int) -> Iterator[SentPacket]:
    """Spanning tree every 2 s, loop tests every 10 s, discovery every minute; router advertisements."""
    tree = frames.llc(bytes.fromhex("0180c2000000"), h.SWITCH.mac, b"\x42\x42\x03" + bytes(35))
    loop = frames.ethernet(h.SWITCH.mac, h.SWITCH.mac, frames.TYPE_LOOPBACK, b"\0\0\1\0")
    found = frames.llc(
        bytes.fromhex("01000ccccccc"), h.SWITCH.mac, bytes.fromhex("aaaa0300000c2000") + bytes(362)
    )
    for data, period, spread in ((tree, 2.0, 0.001), (loop, 10.0, 0.001), (found, 60.0, 0.1)):
        for at in chance.every(period, spread, start, end):
            yield SentPacket(at, RAW, h.SWITCH, h.SSDP_GROUP, max(len(data), frames.MIN_FRAME), payload=data)
    for at in chance.every(8.0, 0.02, start, end):
        yield _neighbour(at, 136, 86)
    for at in chance.every(42, 6, start, end):
        yield _neighbour(at, 134, 110)


def _neighbour(time: int, kind: int, length: int) -> SentPacket:
    """The gateway says over IPv6 that it is there."""
    src, dst = h.address("fe80::1"), h.address("ff02::1")
    link = h.GATEWAY.mac
    body = {  # RFC 4861: advertisement of a neighbour, of a router; both end with the link-layer address
        136: bytes(4) + src + b"\x02\x01" + link,
        134: bytes(12)
        + b"\x19\x03"
        + bytes(22)
        + b"\x05\x01"
        + bytes(2)
        + b"\0\0\x05\xdc"
        + b"\x01\x01"
        + link,
    }[kind]
    message = frames.icmp6(src, dst, kind, 0, body)
    packet = frames.ipv6(src, dst, frames.ICMP6, message, hops=255)
    data = frames.ethernet(bytes.fromhex("333300000001"), h.GATEWAY.mac, frames.TYPE_IPV6, packet)
    return SentPacket(time, RAW, h.GATEWAY, dst, length, payload=data)


SSDP_SIZES: Final = (360, 374, 356, 380, 382, 380, 372, 368, 388, 333, 340)


def ssdp_bursts(chance: Chance, start: int, end: int) -> Iterator[SentPacket]:
    """The gateway announces its eleven services twice, a second apart, about every five minutes."""
    for cycle in chance.every(323, 1.5, start, end):
        for repeat in range(2):
            at = cycle + repeat * 1_001_000
            for size in SSDP_SIZES:
                yield _udp(at, h.GATEWAY, h.SSDP_GROUP, size, (1_900, 1_900))
                at += chance.number(300, 640)


def media_player(chance: Chance, start: int, end: int) -> Iterator[SentPacket]:
    """The PC looks for media servers every few minutes; the gateway answers with all its services."""
    for cycle in chance.every(170, 40, start, end):
        port, at = chance.port(), cycle
        for _ in range(3):
            yield _udp(at, h.PC, h.SSDP_GROUP, 179, (port, 1_900))
            at += chance.number(90_000, 110_000)
        for size in SSDP_SIZES:
            yield _udp(at, h.GATEWAY, h.PC.ip, size + 20, (1_900, port))
            at += chance.number(2_000, 9_000)


def neighbours(chance: Chance, start: int, end: int) -> Iterator[SentPacket]:
    """Every device renews the gateway's hardware address twice a minute, and the gateway theirs."""
    for host in h.LAN_HOSTS[1:-1]:
        slow = 4 if host in {h.SINGLE_BOARD, h.CLOCK, h.WEBCAM} else 1
        for at in chance.every(34 * slow, 7, start, end):
            yield SentPacket(at, ARP, host, h.GATEWAY.ip, frames.MIN_FRAME, flags=1)
        for at in chance.every(42 * slow, 6, start, end):
            yield SentPacket(at, ARP, h.GATEWAY, host.ip, frames.MIN_FRAME, flags=1)
    for one, other in ((h.DOME, h.PC), (h.PC, h.DOME)):
        for at in chance.every(31, 4, start, end):
            yield SentPacket(at, ARP, one, other.ip, frames.MIN_FRAME, flags=1)


DEVICES: Final[tuple[Device, ...]] = (
    *(camera_wired, camera_cloud, doorbell, monitor, pinged_dome, dome, recorder, plugs),
    *(camera_p2p, small_devices, infrastructure, ssdp_bursts, neighbours),
)
"""The order is part of the seed: add at the end."""
