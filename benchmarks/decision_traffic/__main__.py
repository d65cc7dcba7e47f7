"""What the generator makes: rates of networks, novelty and attacks; or a capture with labels.

    python -m benchmarks.decision_traffic [--hours H] [--seed N]
    python -m benchmarks.decision_traffic --out FILE.pcap --network house [--attack NUMBER] [--hours H] [--seed N]

With `--out`, the attack begins at three quarters of the time.
"""

import argparse
import time
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.decision_traffic.attacks import ATTACKS
from benchmarks.decision_traffic.capture_writer import to_capture, write_captures
from benchmarks.decision_traffic.network import Network
from benchmarks.decision_traffic.networks import HELD_BACK_NETWORKS, NETWORKS
from benchmarks.decision_traffic.novelty import NOVELTIES
from benchmarks.decision_traffic.traffic import SECOND, Traffic, merge

_ALL: Final = {**NETWORKS, **HELD_BACK_NETWORKS}


def main() -> None:
    options = _options()
    if options.out is not None:
        _write(options)
        return
    networks = [make(options.seed) for make in _ALL.values()]
    print(f"networks, seed {options.seed}, {options.hours:g} h of capture time")
    for network in networks:
        _network_row(network, options.hours)
    print("\nnovelty" + " " * 34 + "".join(f"{network.name:>26}" for network in networks))
    for name, make in NOVELTIES.items():
        cells = "".join(f"{_rates(make(network, 1, 7_200)):>26}" for network in networks)
        print(f"{name:<41}{cells}")
    print("\nattack" + " " * 35 + "".join(f"{network.name:>26}" for network in networks))
    for spec in ATTACKS:
        cells = ""
        for network in networks:
            made = spec.traffic(network, 1, 7_200) if spec.fits(network) else None
            cells += f"{_rates(made[0], made[1].packets) if made else '-':>26}"
        mark = "*" if spec.held_back else " "
        print(f"{spec.number:>3}{mark} {spec.name:<36}{cells}")
    print("\npackets in seconds (of the attack / with answers); * held back")


def _network_row(network: Network, hours: float) -> None:
    begun, packets, busiest = time.process_time(), 0, 0
    hourly = []
    for part in network.chunks(0, hours * 3_600):
        packets += len(part)
        hourly.append(len(part) / 3_600)
        if len(part):
            second = (part.columns["time_us"] - part.first_us) // SECOND
            busiest = max(busiest, int(np.bincount(second).max()))
    lasted = time.process_time() - begun
    print(
        f"{network.name:<8}{len(network.hosts):>4} hosts{packets:>12,} packets"
        f"{packets / hours / 3_600:>8.1f}/s (hours {min(hourly):.1f} to {max(hourly):.1f}/s, "
        f"busiest second {busiest:,}), made at {packets / lasted:,.0f} packets per CPU second"
    )


def _rates(traffic: Traffic, packets: int | None = None) -> str:
    seconds = (traffic.last_us - traffic.first_us) / SECOND
    counted = f"{len(traffic):,}" if packets is None else f"{packets:,}/{len(traffic):,}"
    return f"{counted} in {seconds:,.0f} s"


def _write(options: argparse.Namespace) -> None:
    network = _ALL[options.network](options.seed)
    end = options.hours * 3_600
    if options.attack is None:
        write_captures(network.chunks(0, end), options.out)
        return
    spec = next((spec for spec in ATTACKS if spec.number == options.attack), None)
    if spec is None or not spec.fits(network):
        raise SystemExit(f"no attack {options.attack} in {network.name}; the list shows which there are")
    attack, truth = spec.traffic(network, 1, 0.75 * end)
    whole = merge(*network.chunks(0, end), attack).between(0, end)
    to_capture(whole.columns, whole.attack, options.out)
    print(truth)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.decision_traffic", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--hours", type=float, default=24, help="capture time; default: %(default)s")
    parser.add_argument("--seed", type=int, default=1, help="of the network; default: %(default)s")
    parser.add_argument("--out", type=Path, help="write a capture and its labels instead")
    parser.add_argument("--network", choices=sorted(_ALL), default="house", help="for --out")
    parser.add_argument("--attack", type=int, help="number of an attack to write with --out")
    return parser.parse_args()


if __name__ == "__main__":
    main()
