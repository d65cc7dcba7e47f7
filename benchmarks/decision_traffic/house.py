"""A house full of devices whose uplink is dead, like the benign part of the shared Mirai capture.

Imitated, with the capture's figures in mind (27 packets/s in bursts, mean length 84 bytes, UDP 53 %, TCP 17 %, ICMP
unreachable 14.5 %, ICMP echo 8 %, ARP 5 %): cameras with rounds of UDP keep-alives to cloud hosts that never answer,
SYNs and their retries, name questions that the gateway mostly answers, its ICMP errors that quote
what it cannot forward (at most one a second for each host), pings between devices, spanning tree, SSDP,
mDNS, NTP without answers, smart plugs; and people: a PC that looks at cameras, copies to a network drive and logs in
there by SSH, a telephone that comes and goes, attempts to go online in vain, devices that restart, the web pages of devices.

Not imitated: an uplink that comes back.
"""

from typing import Final

import numpy as np

from benchmarks.decision_traffic import habits, packets
from benchmarks.decision_traffic.flows import Fate, Talk, connect, talk, unanswered
from benchmarks.decision_traffic.hosts import Ends, Host, ends, ip_number
from benchmarks.decision_traffic.network import Habit, Network, Slice, machine_address, public_addresses
from benchmarks.decision_traffic.packets import TCP, UDP
from benchmarks.decision_traffic.schedule import (
    Random,
    chance,
    every,
    hour_of_day,
    poisson,
    spread_ms,
    within,
)
from benchmarks.decision_traffic.traffic import SECOND, Column, Ints

WATCHING: Final = Talk(
    exchanges=40, request=(150, 0.3), response=(9_000, 0.6), think_s=(0.5, 0.5), gap_us=300, linger_s=(1, 1)
)
DEVICE_PAGE: Final = Talk(exchanges=3, response=(1_800, 1.0), think_s=(0.3, 1.0))
COPY: Final = Talk(exchanges=25, request=(300, 0.6), response=(20_000, 1.6), think_s=(0.04, 1.6), gap_us=90)
LOGIN: Final = Talk(
    exchanges=70, request=(52, 0.2), response=(90, 0.9), think_s=(0.4, 1.2), server_first=True
)
TELNET: Final = Talk(
    exchanges=20, request=(4, 0.5), response=(40, 1.0), think_s=(0.5, 0.9), server_first=True
)


def house(seed: int) -> Network:
    """The house of a seed: 15 to 22 devices, 15 to 30 packets a second."""
    random = chance(seed, "house")
    prefix = ip_number("192.168.0.0") | int(random.integers(1, 250)) << 8
    hosts = _hosts(random, prefix)
    bare = Network("house", seed, prefix, hosts[0], hosts, {}, has_internet=False)
    return Network("house", seed, prefix, hosts[0], hosts, _House(bare, random).habits(), has_internet=False)


def _hosts(random: Random, prefix: int) -> list[Host]:
    numbers = iter((random.permutation(120) + 100).tolist())
    hosts: list[Host] = []

    def add(name: str, kind: str, vendor: int, *ports: int, always_on: bool = True) -> None:
        number = 1 if kind == "gateway" else next(numbers)
        mac = machine_address(random, vendor)
        hosts.append(
            Host(
                name,
                mac,
                prefix | number,
                len(hosts) + 1,
                kind,
                frozenset(ports),
                filtered=kind == "telephone",
                always_on=always_on,
            )
        )

    add("gateway", "gateway", 0x4C09D4, 53, 80)
    for number in range(int(random.integers(3, 6))):
        add(f"camera {number + 1}", "camera", 0x5CCF7F, 23, 80, 554)
    add("doorbell", "doorbell", 0xE0B94D, 80)
    add("recorder", "recorder", 0x00166C, 23, 80, 8_000)
    add("thermostat", "thermostat", 0x34EA34, 80)
    for number in range(int(random.integers(3, 7))):
        add(f"plug {number + 1}", "plug", 0x50C7BF, 9_999)
    add("drive", "drive", 0x001132, 21, 22, 80, 445)
    add("board", "board", 0xB827EB, 22)
    add("television", "television", 0xDC2008, 8_008, 8_009)
    for number in range(int(random.integers(1, 3))):
        add(f"PC {number + 1}", "pc", 0x408D5C, 22)
    for number in range(int(random.integers(1, 3))):
        add(f"telephone {number + 1}", "telephone", 0x3C3300, always_on=False)
    return hosts


class _House:
    """The habits of one house; its constants are drawn once."""

    def __init__(self, network: Network, random: Random) -> None:
        self.network = network
        self.random = random
        self.gateway = network.gateway.ends
        self.cloud = network.outside(public_addresses(random, 14))
        self.cloud_port = int(random.choice([10_240, 32_100, 10_001, 6_100]))

    def habits(self) -> dict[str, Habit]:
        network, random = self.network, self.random
        found: dict[str, Habit] = {"bridge": habits.bridge(network.gateway)}
        found["neighbours"] = habits.neighbours6(network.hosts, random.uniform(150, 500))
        found["groups"] = habits.group_queries(network.gateway, network.of_kind("television", "drive"))
        television = network.of_kind("television")
        found["announce"] = habits.ssdp_announcer(network.gateway, random.uniform(20, 60), random)
        found["announce tv"] = habits.ssdp_announcer(television[0], random.uniform(60, 300), random)
        for number, camera in enumerate(network.of_kind("camera")):
            found[f"{camera.name} keep-alive"] = self.keep_alive(camera, number)
            found[f"{camera.name} connect"] = self.connects(camera, number)
        for host in network.of_kind("doorbell", "recorder", "thermostat", "plug"):
            found[f"{host.name} asks"] = self.asks(host)
            found[f"{host.name} connect"] = self.connects(host, 5)
        for number, host in enumerate(network.hosts):
            if host is not network.gateway:
                found |= self.of_every_host(host, number)
        return found | self.of_people()

    def of_every_host(self, host: Host, number: int) -> dict[str, Habit]:
        random, gateway = self.random, self.network.gateway
        peers = [gateway, gateway, self.network.hosts[1 + number % 4]]
        peers = [peer for peer in peers if peer is not host]
        found: dict[str, Habit] = {
            f"{host.name} arp": habits.arp_refresh(host, peers, random.uniform(40, 140), random),
            f"{host.name} lease": habits.renew_lease(host, gateway, random.uniform(1_800, 7_200), random),
            f"{host.name} restarts": habits.joins(host, gateway, 0.15 if not host.always_on else 0.02),
        }
        if random.random() < 0.7:
            server = self.cloud.at(random.integers(0, 14, 1))
            period = float(random.choice([64, 128, 300, 600]))
            found[f"{host.name} time"] = habits.keep_time(host, server, period, random, answered=False)
        if random.random() < 0.4:
            found[f"{host.name} mdns"] = habits.mdns_speaker(host, random.uniform(6, 60), random)
        return found

    def keep_alive(self, camera: Host, number: int) -> Habit:
        """Rounds of ten datagrams to each cloud host, half a second apart, from a fresh port for each round."""
        random = self.random
        count, cycle = int(random.integers(3, 7)), float(random.choice([9.05, 24.3, 31.0, 47.0]))
        if number == 0:
            count, cycle = 5, 9.05
        clouds = random.permutation(14)[:count]
        size, phase = int(random.integers(28, 60)), random.random()

        def habit(now: Slice) -> None:
            base = every(now.random, now.start, now.end, cycle, spread_s=0.05, phase=phase)
            port = now.random.integers(32_768, 61_000, len(base))
            row = np.repeat(np.arange(len(base)), 10 * count)
            place = within(np.full(len(base), 10 * count))
            time = (
                base[row]
                + (place // count) * 500_000
                + (place % count) * now.random.integers(1, 160, len(row))
            )
            cloud = self.cloud.at(clouds[place % count])
            packets.udp(
                now.tape, time, camera.ends, cloud, sport=port[row], dport=self.cloud_port, payload=size
            )
            self.complain(now, time, camera, UDP, port[row], self.cloud_port, size + 42)

        return habit

    def complain(
        self, now: Slice, time: Ints, host: Host, proto: int, sport: Column, dport: Column, length: int
    ) -> None:
        """ICMP errors of the gateway about these packets: in some seconds none, in others one."""
        if not len(time):
            return
        order = np.argsort(time, kind="stable")
        second = time[order] // SECOND
        first = np.concatenate([[True], second[1:] != second[:-1]])
        chosen = order[first & (now.random.random(len(time)) < 0.55)]
        at = time[chosen] + spread_ms(now.random, len(chosen), 0.3, 2.5)
        ports = [np.broadcast_to(value, len(time))[chosen] for value in (sport, dport)]
        packets.unreachable(
            now.tape,
            at,
            self.gateway,
            host.ends,
            code=packets.NET,
            proto=proto,
            sport=ports[0],
            dport=ports[1],
            length=length,
        )

    def connects(self, host: Host, number: int) -> Habit:
        """Tries to reach cloud hosts by TCP, with retries that differ by vendor."""
        random = self.random
        count = int(random.integers(1, 8)) if number else 2
        cycle = 3.6 if number == 0 else float(random.uniform(12, 120))
        clouds, tries = random.permutation(14)[:count], int(random.integers(2, 5))
        ports, phase = random.choice([80, 443, 8_000, 8_080, 8_280, 21_047], count), random.random()

        def habit(now: Slice) -> None:
            base = every(now.random, now.start, now.end, cycle, spread_s=cycle / 12, phase=phase)
            row = np.repeat(np.arange(len(base)), count)
            place = within(np.full(len(base), count))
            time = base[row] + place * now.random.integers(800, 9_000, len(row))
            server = self.cloud.at(clouds[place])
            connections = connect(now.random, time, host.ends, server, ports[place])
            unanswered(now.tape, now.random, connections, tries=tries)
            self.complain(now, time, host, TCP, connections.sport, ports[place], 74)

        return habit

    def asks(self, host: Host) -> Habit:
        """Asks for the same few names, of the gateway and of servers that are out of reach."""
        random = self.random
        cycle, names = float(random.uniform(3, 25)), int(random.integers(1, 4))
        outside, phase = random.random() < 0.35, random.random()
        servers = self.cloud.at(random.integers(0, 14, 2))

        def habit(now: Slice) -> None:
            base = every(now.random, now.start, now.end, cycle, spread_s=cycle / 10, phase=phase)
            row = np.repeat(np.arange(len(base)), names)
            time = base[row] + within(np.full(len(base), names)) * 9_000
            habits.ask_names(
                now.tape,
                now.random,
                time,
                host.ends,
                self.gateway,
                both=0.2,
                unanswered=0.06,
                wait_ms=(0.3, 4),
            )
            if outside:
                who = servers.at(now.random.integers(0, 2, len(time)))
                sport = now.random.integers(1_024, 65_535, len(time))
                packets.udp(now.tape, time + 40, host.ends, who, sport=sport, dport=53, payload=38)
                self.complain(now, time, host, UDP, sport, 53, 80)

        return habit

    def of_people(self) -> dict[str, Habit]:
        """What people do with their devices; more in the evening."""
        network, random = self.network, self.random
        pcs, cameras = network.of_kind("pc"), network.of_kind("camera", "recorder")
        drive, board = network.of_kind("drive")[0], network.of_kind("board")[0]
        pages = [host for host in network.hosts if 80 in host.open_ports]
        plugs, phones = network.of_kind("plug"), network.of_kind("telephone")
        found: dict[str, Habit] = {
            "ping": habits.pings(pcs[0], cameras[:1], 1.01, random, length=74),
            "ping 2": habits.pings(cameras[-1], [network.gateway], 178, random, number=10),
            "seek": habits.ssdp_seeker(pcs[0], [network.gateway], random.uniform(120, 600), random),
            "absent": habits.arp_for_absent(pcs[0], network.prefix | 99, random.uniform(90, 400), random),
        }
        for host in pcs + phones:
            found[f"{host.name} tries"] = self.tries(host)
        for name, clients, servers, port, what, per_hour in (
            ("watch", pcs, cameras, 80, WATCHING, 1.6),
            ("stream", phones + pcs, cameras, 80, WATCHING, 0.8),
            ("pages", pcs + phones, pages, 80, DEVICE_PAGE, 3.0),
            ("copy", pcs, [drive], 445, COPY, 2.0),
            ("login", pcs, [drive, board], 22, LOGIN, 0.6),
            ("configure", pcs, network.serving(23), 23, TELNET, 0.06),
            ("cast", phones, network.of_kind("television"), 8_009, DEVICE_PAGE, 0.7),
            ("switch", phones + pcs, plugs, 9_999, DEVICE_PAGE, 2.5),
            ("backup", [board], [drive], 445, COPY, 0.5),
        ):
            found[name] = self.visits(clients, servers, port, what, per_hour * random.uniform(0.6, 1.5))
        return found

    def tries(self, host: Host) -> Habit:
        """Somebody, or a program, tries to go online: a dozen hosts within seconds, in vain."""
        per_hour = float(self.random.uniform(0.6, 2.5))
        hosts = self.network.outside(public_addresses(self.random, 120))

        def habit(now: Slice) -> None:
            random = now.random
            hour = hour_of_day(now.start)
            level = 2.0 if 17 <= hour < 23 else 0.2 if hour < 7 else 1.0
            begun = poisson(random, now.start, now.end, per_hour * level)
            counts = random.geometric(1 / 9, len(begun))
            time = np.repeat(begun, counts) + random.integers(0, 12 * SECOND, int(counts.sum()))
            habits.ask_names(now.tape, random, time, host.ends, self.gateway, wait_ms=(0.3, 4))
            server = hosts.at(random.integers(0, 120, len(time)))
            connections = connect(random, time + 8_000, host.ends, server, 443)
            unanswered(now.tape, random, connections, tries=3)
            self.complain(now, connections.time, host, TCP, connections.sport, 443, 74)

        return habit

    @staticmethod
    def visits(clients: list[Host], servers: list[Host], port: int, what: Talk, per_hour: float) -> Habit:
        """Connections between devices of the house."""
        left, right = ends(clients), ends(servers)

        def habit(now: Slice) -> None:
            hour = hour_of_day(now.start)
            level = 2.0 if 17 <= hour < 23 else 0.15 if hour < 6 else 1.0
            time = poisson(now.random, now.start, now.end, per_hour * level)
            client = _row(now.random, left, len(time))
            server = _row(now.random, right, len(time))
            other = np.flatnonzero(client.spread(len(time)).ip != server.spread(len(time)).ip)
            connections = connect(now.random, time[other], client.at(other), server.at(other), port)
            talk(
                now.tape, now.random, connections, what, Fate(dead=0.01, refused=0.015, slow=0.01, lost=0.003)
            )

        return habit


def _row(random: Random, rows: Ends, count: int) -> Ends:
    return rows.at(random.integers(0, len(rows.ip), count))
