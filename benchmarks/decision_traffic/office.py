"""An office: people at PCs behind a router to the Internet, servers, printers and a monitoring host.

Imitated: pages of many short TLS and QUIC connections to a few popular and a long tail of hosts seen once,
names, mail, SSH by hand and by cron, file server, printing, Windows broadcasts, monitoring that pings and polls
every host each minute (and some machine that is no longer there), an update server and a proxy, telephones with
calls, mail and web from outside to one published server, people who come and go (weekends off), hosts that stop
answering for minutes, an uplink that is dead for minutes on one day of four, drives of machines that are gone,
mistyped passwords, refused and lost connections, ICMP errors, large downloads.  Everything differs by seed.

Not imitated: Wi-Fi with several machines on one port, guests, and scans from the Internet (the router has none of
its ports open but those of the published server).
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from benchmarks.decision_traffic import habits, office_services
from benchmarks.decision_traffic.hosts import Host, ip_number
from benchmarks.decision_traffic.network import Habit, Network, Slice, machine_address
from benchmarks.decision_traffic.schedule import Random, chance, hour_of_day, is_weekend
from benchmarks.decision_traffic.traffic import Ints
from benchmarks.decision_traffic.web import Browsing, Popularity, background, browsing, downloads, push

_PC_VENDORS: Final = (0x484D7E, 0xF8B156, 0x54BF64, 0x3C5282, 0xE454E8)
_SERVER_PORTS: Final = {
    "file server": (22, 139, 445),
    "server": (22, 25, 80, 143, 443, 993),
    "update server": (22, 80, 3128, 8530),
    "build server": (21, 22, 80, 8080),
    "monitor": (22, 3000),
}


def office(seed: int) -> Network:
    """The office of a seed: 20 to 32 PCs, 15 to 30 packets a second averaged over a week."""
    random = chance(seed, "office")
    prefix = ip_number("10.0.0.0") | int(random.integers(1, 250)) << 16 | int(random.integers(0, 250)) << 8
    hosts = _hosts(random, prefix)
    gateway = hosts[0]
    network = Network("office", seed, prefix, gateway, hosts, {})
    return Network("office", seed, prefix, gateway, hosts, _habits(network, random))


def _hosts(random: Random, prefix: int) -> list[Host]:
    numbers = iter((random.permutation(180) + 20).tolist())
    hosts: list[Host] = []

    def add(
        name: str,
        kind: str,
        vendor: int,
        *ports: int,
        filtered: bool = False,
        always_on: bool = True,
    ) -> None:
        number = 1 if kind == "gateway" else next(numbers)
        mac, port = machine_address(random, vendor), len(hosts) + 1
        hosts.append(Host(name, mac, prefix | number, port, kind, frozenset(ports), filtered, always_on))

    add("router", "gateway", 0x00C0CA, 53, 80, 443)
    for kind, ports in _SERVER_PORTS.items():
        add(kind, kind, 0x0050B6, *ports)
    for number in range(int(random.integers(2, 4))):
        add(f"printer {number + 1}", "printer", 0x00206B, 21, 23, 80, 515, 631, 9_100)
    for number in range(int(random.integers(3, 7))):
        add(f"telephone {number + 1}", "telephone", 0x805EC0, 80)
    for number in range(int(random.integers(20, 33))):
        vendor = int(random.choice(_PC_VENDORS))
        stays = bool(random.random() < 0.55)
        add(f"PC {number + 1}", "pc", vendor, filtered=True, always_on=stays)
    return hosts


def _habits(network: Network, random: Random) -> dict[str, Habit]:
    popular = Popularity(network, random)
    found: dict[str, Habit] = {"bridge": habits.bridge(network.gateway)}
    found["multicast groups"] = habits.group_queries(network.gateway, network.of_kind("printer", "telephone"))
    found["neighbours"] = habits.neighbours6(network.hosts[1:], random.uniform(120, 260))
    for host in network.hosts:
        for number, habit in enumerate(_of_every_host(network, host, random)):
            found[f"{host.name} {number}"] = habit if host.always_on else _by_day(habit)
    for host in network.of_kind("pc"):
        found |= _of_a_pc(network, host, popular, random)
    found |= office_services.of_servers(network, popular, random)
    found |= office_services.of_monitor(network, random)
    found |= office_services.misfits(network, random)
    found |= office_services.of_telephones(network, random)
    return found


def _of_every_host(network: Network, host: Host, random: Random) -> Sequence[Habit]:
    gateway = network.gateway
    if host is gateway:
        return [habits.arp_refresh(gateway, network.hosts[1:], 60 * len(network.hosts), random)]
    servers = [gateway, *network.of_kind("file server", "server")]
    some = list(network.hosts)
    peers = [*servers, *(some[int(row)] for row in random.integers(0, len(some), 2))]
    peers = [peer for peer in peers if peer is not host]
    return [
        habits.arp_refresh(host, peers, random.uniform(15, 60), random),
        habits.renew_lease(host, gateway, random.uniform(3_000, 14_400), random),
        habits.keep_time(
            host, network.outside(_time_server(random)), random.choice([64, 256, 1_024, 3_600]), random
        ),
    ]


def _time_server(random: Random) -> Ints:
    """The address of a time server."""
    return np.array([ip_number("162.159.200.0") + int(random.integers(1, 250))], np.int64)


def _by_day(habit: Habit) -> Habit:
    """Only while a machine that is switched off at night is on."""

    def by_day(now: Slice) -> None:
        if 7 <= hour_of_day(now.start) < 19 and not is_weekend(now.start):
            habit(now)

    return by_day


def _in_the_morning(habit: Habit) -> Habit:
    def mornings(now: Slice) -> None:
        if 7 <= hour_of_day(now.start) < 9 and not is_weekend(now.start):
            habit(now)

    return mornings


def _of_a_pc(network: Network, host: Host, popular: Popularity, random: Random) -> dict[str, Habit]:
    arrives, stays = random.normal(8.6, 0.7), random.normal(8.8, 0.9)
    taste = Browsing(
        pages_per_hour=float(random.lognormal(np.log(9), 0.6)),
        arrives=arrives,
        leaves=arrives + stays,
        weekends=bool(random.random() < 0.08),
        quic=float(random.uniform(0.05, 0.35)),
    )
    found: dict[str, Habit] = {
        f"{host.name} pages": browsing(network, host, popular, taste),
        f"{host.name} background": background(network, host, popular, random),
        f"{host.name} push": push(host, popular, random),
        f"{host.name} names": office_services.windows_names(network, host, random),
        f"{host.name} mail": office_services.mail_client(network, host, taste, random),
        f"{host.name} files": office_services.files(network, host, taste, random),
        f"{host.name} downloads": downloads(host, popular, taste),
        f"{host.name} print": office_services.printing(network, host, taste),
    }
    if random.random() < 0.6:
        answering = network.of_kind("printer")
        period = random.uniform(120, 900)
        found[f"{host.name} ssdp"] = habits.ssdp_seeker(host, answering, period, random)
    if random.random() < 0.5:
        found[f"{host.name} mdns"] = habits.mdns_speaker(host, random.uniform(4, 30), random)
    if not host.always_on:
        found[f"{host.name} joins"] = _in_the_morning(habits.joins(host, network.gateway, 0.5))
    return found
