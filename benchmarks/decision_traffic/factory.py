"""A factory: controllers that are polled all day and night, and a few people; held back from tuning.

Imitated: Modbus polls on connections that stay open (a request, a response and an acknowledgement every few
seconds), cyclic multicast of drives, cameras that push pictures by RTP, a historian that copies in batches, programming of a
controller with bursts, controllers in maintenance that do not answer (the poller tries again every few seconds), panels,
a mail and web server seen from outside, and a handful of PCs as in the office.

Not imitated: redundancy protocols of industrial rings, real-time Ethernet other than IP, and shift changes.
"""

from typing import Final

import numpy as np

from benchmarks.decision_traffic import habits, office_services, packets
from benchmarks.decision_traffic.flows import SOUND, Fate, Talk, connect, talk, unanswered
from benchmarks.decision_traffic.hosts import Host, ends, group, ip_number
from benchmarks.decision_traffic.network import Habit, Network, Slice, machine_address
from benchmarks.decision_traffic.packets import ACK, PSH
from benchmarks.decision_traffic.schedule import (
    Random,
    chance,
    every,
    hour_of_day,
    lognormal,
    poisson,
    spread_ms,
    within,
)
from benchmarks.decision_traffic.traffic import HOUR, SECOND, Ints
from benchmarks.decision_traffic.web import Browsing, Popularity, background, browsing, downloads, push

MODBUS: Final = 502
DRIVES: Final = group("239.192.1.32")
BATCH: Final = Talk(exchanges=8, request=(90_000, 0.9), response=(300, 0.5), think_s=(0.1, 0.8), gap_us=120)
PROGRAM: Final = Talk(exchanges=60, request=(700, 0.8), response=(240, 0.9), think_s=(0.03, 1.2))
PANEL: Final = Talk(exchanges=4, request=(200, 0.5), response=(1_400, 0.9), think_s=(0.4, 0.8))


def factory(seed: int) -> Network:
    """The factory of a seed: 8 to 14 controllers, 20 to 40 packets a second."""
    random = chance(seed, "factory")
    prefix = ip_number("172.16.0.0") | int(random.integers(0, 15)) << 16 | int(random.integers(0, 250)) << 8
    hosts = _hosts(random, prefix)
    bare = Network("factory", seed, prefix, hosts[0], hosts, {})
    return Network("factory", seed, prefix, hosts[0], hosts, _Factory(bare, random).habits())


def _hosts(random: Random, prefix: int) -> list[Host]:
    numbers = iter((random.permutation(200) + 10).tolist())
    hosts: list[Host] = []

    def add(name: str, kind: str, vendor: int, *ports: int, filtered: bool = False) -> None:
        number = 1 if kind == "gateway" else next(numbers)
        mac = machine_address(random, vendor)
        hosts.append(Host(name, mac, prefix | number, len(hosts) + 1, kind, frozenset(ports), filtered))

    add("router", "gateway", 0x000A8A, 53, 443)
    add("poller", "poller", 0x0050B6, 22, 4_840)
    add("historian", "file server", 0x0050B6, 22, 445, 1_433)
    add("mail and web", "server", 0x0050B6, 22, 25, 80, 443)
    for number in range(int(random.integers(8, 15))):
        add(f"controller {number + 1}", "controller", 0x001B1B, 80, 102, MODBUS)
    for number in range(int(random.integers(2, 4))):
        add(f"panel {number + 1}", "panel", 0x00A045, 21, 23, 80)
    for number in range(int(random.integers(2, 5))):
        add(f"camera {number + 1}", "camera", 0xACCC8E, 23, 80, 554)
    for number in range(int(random.integers(1, 3))):
        add(f"printer {number + 1}", "printer", 0x00206B, 80, 9_100)
    for number in range(int(random.integers(4, 8))):
        add(f"PC {number + 1}", "pc", 0x3C5282, filtered=True)
    return hosts


class _Factory:
    """The habits of one factory; its constants are drawn once."""

    def __init__(self, network: Network, random: Random) -> None:
        self.network = network
        self.random = random
        self.popular = Popularity(network, random)
        self.poller = network.of_kind("poller")[0]
        self.store = network.of_kind("file server")[0]

    def habits(self) -> dict[str, Habit]:
        network, random, gateway = self.network, self.random, self.network.gateway
        found: dict[str, Habit] = {"bridge": habits.bridge(gateway)}
        found["neighbours"] = habits.neighbours6(network.hosts, random.uniform(60, 150))
        found["members"] = habits.group_queries(gateway, network.of_kind("controller"))
        controllers = network.of_kind("controller")
        found["pings"] = habits.pings(self.poller, controllers, random.uniform(10, 30), random, number=2)
        found["absent"] = habits.arp_for_absent(self.poller, network.prefix | 5, 30, random)
        found |= office_services.misfits(network, random)
        for host in network.hosts[1:]:
            peers = [peer for peer in (gateway, self.poller, self.store) if peer is not host]
            found[f"{host.name} arp"] = habits.arp_refresh(host, peers, random.uniform(20, 90), random)
            found[f"{host.name} time"] = habits.keep_time(
                host, gateway.ends, random.choice([16, 64, 300]), random
            )
        for number, host in enumerate(controllers):
            found[f"{host.name} polled"] = self.polled(host)
            if number % 3 == 0:
                found[f"{host.name} cycle"] = self.cycle(host)
        for host in network.of_kind("camera"):
            found[f"{host.name} pictures"] = self.pictures(host)
        for host in network.of_kind("pc"):
            found |= self.of_a_pc(host)
        return found | {"history": self.history, "panels": self.panels, "programming": self.programming}

    def polled(self, controller: Host) -> Habit:
        """Modbus on a connection that stays open; out of order for minutes on some days."""
        period, phase = float(self.random.uniform(1.6, 4.5)), self.random.random()
        sport, size = int(self.random.integers(49_152, 65_535)), int(self.random.integers(20, 240))
        poller = self.poller

        def habit(now: Slice) -> None:
            time = every(now.random, now.start, now.end, period, spread_s=0.02, phase=phase)
            if now.random.random() < 0.01:
                broken = now.start + int(now.random.integers(0, HOUR))
                lasting = int(now.random.integers(60, 1_500)) * SECOND
                away = (time >= broken) & (time < broken + lasting)
                self.retry(now, controller, time[away])
                time = time[~away]
            turn = np.round(time / (period * SECOND)).astype(np.int64)
            seq, ack = 500 + 12 * turn, 700 + size * turn
            out: dict[str, int] = {"sport": sport, "dport": MODBUS}
            back: dict[str, int] = {"sport": MODBUS, "dport": sport}
            tape, ask, tell = now.tape, poller.ends, controller.ends
            packets.tcp(tape, time, ask, tell, flags=PSH | ACK, seq=seq, ack=ack, length=78, **out)
            later = time + spread_ms(now.random, len(time), 2, 18)
            answer = size + 66
            packets.tcp(tape, later, tell, ask, flags=PSH | ACK, seq=ack, ack=seq + 12, length=answer, **back)
            packets.tcp(
                tape, later + 350, ask, tell, flags=ACK, seq=seq + 12, ack=ack + size, length=66, **out
            )

        return habit

    def retry(self, now: Slice, controller: Host, time: Ints) -> None:
        """New connections to a controller that does not answer, one in five seconds or so."""
        some = time[:: max(1, int(5 * SECOND / max(int(np.diff(time).mean()), 1)))] if len(time) > 1 else time
        connections = connect(now.random, some, self.poller.ends, controller.ends, MODBUS)
        unanswered(now.tape, now.random, connections, tries=2)

    def cycle(self, controller: Host) -> Habit:
        """A drive tells its state to a group."""
        period, size = float(self.random.uniform(0.4, 1.5)), int(self.random.integers(40, 500))

        def habit(now: Slice) -> None:
            time = every(now.random, now.start, now.end, period, spread_s=0.002)
            packets.udp(now.tape, time, controller.ends, DRIVES, sport=2_222, dport=2_222, payload=size)

        return habit

    def pictures(self, camera: Host) -> Habit:
        """A picture every few seconds by RTP to the historian, several datagrams each."""
        period, count = float(self.random.uniform(8, 25)), int(self.random.integers(4, 16))
        sport = int(self.random.integers(5_000, 20_000)) * 2

        def habit(now: Slice) -> None:
            base = every(now.random, now.start, now.end, period, spread_s=0.03, phase=0.4)
            parts = lognormal(now.random, count, 0.3, len(base), 60)
            time = np.repeat(base, parts) + within(parts) * 1_100
            packets.udp(now.tape, time, camera.ends, self.store.ends, sport=sport, dport=5_004, payload=1_390)

        return habit

    def of_a_pc(self, host: Host) -> dict[str, Habit]:
        network, random = self.network, self.random
        taste = Browsing(
            pages_per_hour=4, arrives=6.0, leaves=float(random.choice([14, 22])), weekends=True, quic=0.2
        )
        return {
            f"{host.name} pages": browsing(network, host, self.popular, taste),
            f"{host.name} background": background(network, host, self.popular, random),
            f"{host.name} push": push(host, self.popular, random),
            f"{host.name} names": office_services.windows_names(network, host, random),
            f"{host.name} mail": office_services.mail_client(network, host, taste, random),
            f"{host.name} files": office_services.files(network, host, taste, random),
            f"{host.name} print": office_services.printing(network, host, taste),
            f"{host.name} downloads": downloads(host, self.popular, taste),
        }

    def history(self, now: Slice) -> None:
        """The poller copies what it has read to the historian every ten minutes."""
        time = every(now.random, now.start, now.end, 600, spread_s=3)
        connections = connect(now.random, time, self.poller.ends, self.store.ends, 1_433)
        talk(now.tape, now.random, connections, BATCH, SOUND)

    def panels(self, now: Slice) -> None:
        """Panels fetch pages from controllers."""
        panels = ends(self.network.of_kind("panel"))
        controllers = ends(self.network.of_kind("controller"))
        time = poisson(now.random, now.start, now.end, 120)
        client = panels.at(now.random.integers(0, len(panels.ip), len(time)))
        server = controllers.at(now.random.integers(0, len(controllers.ip), len(time)))
        talk(
            now.tape,
            now.random,
            connect(now.random, time, client, server, 80),
            PANEL,
            Fate(refused=0.01, dead=0.004),
        )

    def programming(self, now: Slice) -> None:
        """Somebody loads a program into one controller after the other."""
        if not 6 <= hour_of_day(now.start) < 20 or now.random.random() > 0.15:
            return
        controllers = self.network.of_kind("controller")
        chosen = now.random.permutation(len(controllers))[: int(now.random.integers(1, 6))]
        time = now.start + np.sort(now.random.integers(0, 3_000 * SECOND, len(chosen)))
        client = self.network.of_kind("pc")[0].ends
        connections = connect(now.random, time, client, ends(controllers).at(chosen), 102)
        talk(now.tape, now.random, connections, PROGRAM, Fate(refused=0.05))
