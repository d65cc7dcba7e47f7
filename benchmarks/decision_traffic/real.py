"""Real traffic: the benign part of the Mirai capture as a network, and captured attacks, mapped into a LAN.

Packets are read with the product's own capture reader, as `sdnator detect` reads them; those of the Mirai table are
rebuilt first, as for `sdnator replay` (the table has no TCP flags, so they are guessed from lengths).  Times are moved, MACs and
addresses are replaced: the attacker becomes a host of the wanted kind, those it attacked become hosts of the network,
its router the network's.  Lengths, ports, flags, gaps and answers are the capture's.

Assumed: what each device of the Mirai capture is and which TCP services it has (the capture does not tell), and that
each is on a switch port of its own.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Final

import numpy as np

from apps.packets import PACKET_COLUMNS
from benchmarks.data_folder import data_file
from benchmarks.decision_traffic.hosts import BROADCAST_MAC, Host, ip_number
from benchmarks.decision_traffic.network import Network, Slice
from benchmarks.decision_traffic.scene import Scene
from benchmarks.decision_traffic.traffic import Array, Ints, Tape, Traffic
from benchmarks.decision_traffic.truth import (
    AttackerIs,
    AttackSpec,
    AttackTruth,
    Identity,
    Kind,
    Remedy,
    told,
)
from sdnator.capture.packet_sources import Batch, CaptureSource, frame_batch
from sdnator.capture.tshark_tsv import read_rows
from sdnator.datasets.rebuild import frame

BENIGN: Final = "kitsune/mirai_38k.tsv.gz"
_MACS: Final = ("eth_src", "eth_dst", "arp_src_mac", "arp_dst_mac")
_ADDRESSES: Final = ("ip_src_lo", "ip_dst_lo", "arp_src_ip", "arp_dst_ip")

_DEVICES: Final = (
    ("4c09d4c6127b", 1, "gateway", (53, 80)),
    ("5ccf7f05f2c6", 108, "camera", (23, 80)),
    ("34c3d2e0fcc9", 113, "camera", (23, 80, 554)),
    ("3c330098eefd", 110, "drive", (21, 22, 80, 445)),
    ("00166c7f8220", 115, "recorder", (23, 80)),
    ("e0b94d087123", 112, "doorbell", (80,)),
    ("48022e018315", 109, "camera", (80,)),
    ("408d5c4b991d", 101, "pc", (22,)),
    ("34ea34f10483", 104, "thermostat", (80,)),
    ("00ec04569303", 126, "recorder", (80,)),
    ("50c7bf1c9ca6", 120, "plug", (9_999,)),
    ("50c7bf1c9cc6", 119, "plug", (9_999,)),
    ("c412f5db4ae2", 105, "camera", (80,)),
    ("dc20083aebe8", 111, "television", (8_009,)),
    ("b827ebe1a9f6", 118, "board", (22,)),
    ("d46e0e2c15d4", 196, "pc", ()),
    ("00016cd5635c", 103, "pc", ()),
)
_SWITCH_MAC: Final = "00141c28d606"


def real_network(folder: Path) -> Network:
    """The house of the Mirai capture: 38,363 benign packets in its first 1,404.6 s, and silence behind them.

    Args:
        folder: of the test data (`benchmarks.data_folder`).

    Raises:
        SystemExit: the capture is not there.
    """
    columns = _columns(data_file(folder, BENIGN))
    prefix = ip_number("192.168.2.0")
    hosts = [
        Host(
            f"{kind} .{number}",
            int(mac, 16),
            prefix | number,
            place + 1,
            kind,
            frozenset(ports),
            filtered=not ports,
            always_on=number not in {103, 111, 196},
        )
        for place, (mac, number, kind, ports) in enumerate(_DEVICES)
    ]
    ports = {host.mac: host.port for host in hosts} | {int(_SWITCH_MAC, 16): len(hosts) + 1}
    time = columns["time_us"] - columns["time_us"][0]
    told_columns = {**columns, "port": _mapped(columns["eth_src"], ports, default=len(hosts) + 2)}

    def capture(now: Slice) -> None:
        _put(now.tape, time, told_columns, np.flatnonzero((time >= now.start) & (time < now.end)))

    return Network("mirai", 0, prefix, hosts[0], hosts, {"capture": capture}, has_internet=False)


@dataclass(frozen=True, kw_only=True)
class _Capture:
    """A captured attack and who is who in it."""

    file: str
    attacker: str
    """MAC."""
    router: str = ""
    """MAC behind which outside addresses are."""
    prefix: str = ""
    """LAN of the capture; its other addresses become addresses of the network's LAN."""
    only_arp: bool = False
    """Other packets of the attacker are none of the attack."""
    only_broadcast: bool = False


def real_attacks(folder: Path) -> Sequence[AttackSpec]:
    """The captured attacks; numbers from 201 on.  Seeds choose who in the network plays which part.

    Raises:
        SystemExit: a capture is not there.
    """
    found = []
    for number, (name, kind, attacker_is, rate, remedies, capture) in enumerate(_CAPTURES, 201):
        path = data_file(folder, f"captures/{capture.file}")
        found.append(
            AttackSpec(
                number=number,
                name=f"real: {name}",
                kind=kind,
                attacker_is=attacker_is,
                rate=rate,
                held_back=name in _HELD_BACK,
                needs=(),
                make=partial(_make, path, capture, remedies),
                seeds=(1,),
            )
        )
    return found


_LOCAL: Final[tuple[Remedy, ...]] = ("block_sender", "block_address")
_CAPTURES: Final[Sequence[tuple[str, Kind, AttackerIs, float, tuple[Remedy, ...], _Capture]]] = (
    (
        "ssh guessing", "guessing", "new", 6, _LOCAL,
        _Capture(file="ssh_guessing.pcap", attacker="0a0027000000"),
    ),
    (
        "ftp guessing", "guessing", "known", 10, _LOCAL,
        _Capture(file="ftp_bruteforce.pcap", attacker="0a0027000000"),
    ),
    (
        "ack scan", "scan", "known", 800, _LOCAL,
        _Capture(file="ps-tcp_ack.pcap", attacker="6c709fabf0b2"),
    ),
    (
        "syn ping sweep", "scan", "new", 280, _LOCAL,
        _Capture(file="hs-tcp_synPingSweepRand.pcapng", attacker="000c2920a87f", router="005056f09dfe"),
    ),
    (
        "icmp sweep through the router", "scan", "known", 230, _LOCAL,
        _Capture(file="hs-icmpScan.pcap", attacker="000c2920a87f", router="005056f09dfe"),
    ),
    (
        "udp sweep, slow", "scan", "new", 10, _LOCAL,
        _Capture(file="hs-udpScan.pcap", attacker="000c298c1904", router="005056f09dfe"),
    ),
    (
        "arp poisoning, slow", "spoofing", "new", 0.3, _LOCAL,
        _Capture(file="na-arpSpoofing.pcap", attacker="00e04d3c257b"),
    ),
    (
        "arp scan", "scan", "known", 160, _LOCAL,
        _Capture(
            file="slips-test8-malicious.pcap", attacker="50ed3c39bcd9", router="d858d7006711", prefix="192.168.1.0",
            only_arp=True, only_broadcast=True,
        ),
    ),
    (
        "icmp sweep of the lan", "scan", "new", 15, _LOCAL,
        _Capture(
            file="slips-test12-icmp-portscan.pcap", attacker="50ed3c39bcd9", router="68ff7bdca217",
            prefix="192.168.1.0",
        ),
    ),
    (
        "syn flood, one source", "flood", "outside", 1_000, ("block_address", "guard", "meter"),
        _Capture(file="synflood_one_source.pcap", attacker="020000000001", router="020000000001"),
    ),
    (
        "syn flood, forged sources", "flood", "outside forging", 1_600, ("guard", "meter"),
        _Capture(file="synflood_spoofed.pcap", attacker="44f4770fea49", router="44f4770fea49"),
    ),
)  # fmt: skip
_HELD_BACK: Final = frozenset({"ftp guessing", "icmp sweep through the router", "arp poisoning, slow"})


def _make(
    path: Path,
    capture: _Capture,
    remedies: tuple[Remedy, ...],
    spec: AttackSpec,
    network: Network,
    seed: int,
    start_s: float,
) -> tuple[Traffic, AttackTruth]:
    scene = Scene(spec, network, seed, start_s)
    columns = _columns(path)
    is_attack = columns["eth_src"] == int(capture.attacker, 16)
    if capture.only_arp:
        is_attack &= columns["arp_op"] == 1
    if capture.only_broadcast:
        is_attack &= columns["eth_dst"] == BROADCAST_MAC
    _cast(scene, capture, columns)
    time = columns["time_us"] - columns["time_us"][0] + scene.start
    _put(scene.tape, time, columns, np.arange(len(time)), np.where(is_attack, scene.ident, 0))
    traffic = scene.tape.traffic()
    truth = told(
        traffic,
        spec,
        scene.ident,
        attackers=scene.attackers,
        victims=scene.victims,
        innocents=scene.innocents,
        remedies=remedies,
        forged=spec.attacker_is == "outside forging",
    )
    return traffic, truth


def _cast(scene: Scene, capture: _Capture, columns: dict[str, Array]) -> None:
    """Put hosts of the network in the places of those in the capture (in place)."""
    network = scene.network
    attacker = int(capture.attacker, 16)
    router = int(capture.router, 16) if capture.router else -1
    macs = {router: network.gateway.mac} if capture.router else {}
    addresses: dict[int, int] = {}
    ports = {host.mac: host.port for host in network.hosts}
    if router != attacker:
        host = scene.local()
        macs[attacker], ports[host.mac] = host.mac, host.port
        addresses |= dict.fromkeys(_addresses(columns, attacker)[:1], host.ip)
        others = [each for each in network.hosts[1:] if each.ip != host.ip and not each.filtered]
    else:
        forged = scene.spec.attacker_is == "outside forging"
        source = 0 if forged else int(columns["ip_src_lo"][0])
        scene.attackers.append(Identity(network.uplink_port, network.gateway.mac, source))
        others = network.of_kind("server") or network.of_kind("camera")
    parts = _others(columns, {attacker, router})
    order = scene.random.permutation(len(others))
    for place, mac in enumerate(parts):
        part = others[int(order[place % len(others)])]
        macs[mac] = part.mac
        addresses |= dict.fromkeys(_addresses(columns, mac)[:1], part.ip)
        scene.victims.append(part.ip)
    if scene.spec.kind == "spoofing":
        _deceive(scene, columns, parts, macs, addresses)
    old = ip_number(capture.prefix) if capture.prefix else -1
    for name in _ADDRESSES:
        columns[name] = _moved(columns[name].astype(np.int64), addresses, old, network.prefix)
    for name in _MACS:
        columns[name] = _mapped(columns[name], macs)
    columns["port"] = _mapped(columns["eth_src"], ports, default=network.uplink_port)


def _deceive(
    scene: Scene, columns: dict[str, Array], parts: list[int], macs: dict[int, int], addresses: dict[int, int]
) -> None:
    """The first of those deceived becomes the gateway; what the attacker claims becomes the other's address."""
    gateway = scene.network.gateway
    macs[parts[0]] = gateway.mac
    scene.victims[0] = gateway.ip
    hosts = {host.mac: host for host in scene.network.hosts}
    addresses.clear()
    for told_mac, other in ((parts[0], parts[1]), (parts[1], parts[0])):
        owner = hosts[macs[other]]
        rows = np.flatnonzero(columns["eth_dst"] == told_mac)
        addresses[int(columns["arp_src_ip"][rows[0]])] = owner.ip
        scene.innocents.append(Identity.of(owner))


def _others(columns: dict[str, Array], known: set[int]) -> list[int]:
    """MACs of the capture beside attacker and router, in the order in which they appear."""
    found: dict[int, None] = {}
    for mac in np.stack([columns["eth_dst"], columns["eth_src"]], axis=1).ravel().tolist():
        if not mac >> 40 & 1 and mac not in known:
            found[mac] = None
    return list(found)


def _addresses(columns: dict[str, Array], mac: int) -> list[int]:
    """Addresses of a MAC, the most frequent first: of its own packets, else of packets to it."""
    found: Counter[int] = Counter()
    for side, names in (("eth_src", ("ip_src_lo", "arp_src_ip")), ("eth_dst", ("ip_dst_lo",))):
        rows = np.flatnonzero(columns[side] == mac)
        for name in names:
            found.update(address for address in columns[name][rows].tolist() if address)
        if found:
            break
    return [address for address, _ in found.most_common()]


def _mapped(column: Array, table: dict[int, int], *, default: int | None = None) -> Ints:
    values, rows = np.unique(column, return_inverse=True)
    changed = [table.get(value, value if default is None else default) for value in values.tolist()]
    found: Ints = np.array(changed, np.int64)[rows]
    return found


def _moved(column: Ints, table: dict[int, int], old: int, new: int) -> Ints:
    moved = np.where((column >> 8 == old >> 8) & (old > 0), new | (column & 255), column)
    values, rows = np.unique(column, return_inverse=True)
    exact = np.array([table.get(value, -1) for value in values.tolist()], np.int64)[rows]
    found: Ints = np.where(exact >= 0, exact, moved)
    return found


def _put(tape: Tape, time: Ints, columns: dict[str, Array], rows: Ints, attack: Array | int = 0) -> None:
    others = {name: columns[name][rows] for name in PACKET_COLUMNS if name not in _NOT_COPIED}
    tape.add(time[rows], attack=attack if isinstance(attack, int) else attack[rows], **others)


_NOT_COPIED: Final = frozenset({"time_us", "sequence", "arrival"})


def _columns(path: Path) -> dict[str, Array]:
    """A copy of the columns of a capture."""
    return dict(_read(path))


@lru_cache(maxsize=16)
def _read(path: Path) -> dict[str, Array]:
    source = CaptureSource(path)
    batches = [_rebuilt(path)] if source.is_table else list(source)
    columns = {name: np.concatenate([batch[name] for batch in batches]) for name in PACKET_COLUMNS}
    order = np.argsort(columns["time_us"], kind="stable")
    return {name: column[order] for name, column in columns.items()}


def _rebuilt(path: Path) -> Batch:
    """Frames of a table as `sdnator dataset rebuild` makes them: the table itself has no TCP flags."""
    rows = list(read_rows(path))
    whole = tuple(frame(row) for row in rows)
    times = np.array([row.time_ns for row in rows], np.int64)
    return frame_batch(whole, tuple(map(len, whole)), times, 0)
