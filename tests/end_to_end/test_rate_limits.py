"""Floods and scans whose sources are forged or innocent, from the capture to the switch: limited at once, and nothing else."""

import json

import numpy as np
import pytest

from benchmarks.decision_traffic.attacks import ATTACKS
from benchmarks.decision_traffic.capture_writer import to_capture
from benchmarks.decision_traffic.networks import NETWORKS
from benchmarks.decision_traffic.traffic import merge
from tests.end_to_end.command import sdnator

SECONDS = 600.0
BEGIN_S = 570.0
AFTER_S = 5.0
"""An effective remedy comes within this time of the attack's first packet."""
SCAN = 4
FLOODS = {28: ("TCP to port 443 but SYNs", "tcp-ack/443"), 29: ("UDP from port 53", "from-udp/53")}


def replayed(tmp_path, number):
    """An office under attack, replayed: what the command says, the whole traffic, and the truth about the attack."""
    office = NETWORKS["office"](1)
    spec = next(each for each in ATTACKS if each.number == number)
    attack, truth = spec.traffic(office, 1, BEGIN_S)
    benign = merge(*office.chunks(0, SECONDS))
    whole = merge(benign, attack).between(0, SECONDS)
    capture, labels = tmp_path / "attack.pcap", tmp_path / "attack.labels.csv"
    to_capture(whole.columns, whole.attack, capture)
    train = len(benign.between(0, SECONDS / 2))
    done = sdnator("replay", capture, "--labels", labels, "--train", str(train), "--json", seconds=1_500)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout), whole, truth


def is_limited(found, whole, truth):
    """The one limit came soon, drops nearly all of the attack, and hits nobody else."""
    (limit,) = found["limits"]
    assert limit["effect"] == "limited"
    assert limit["decided"] - truth.first_us / 1e6 < AFTER_S
    mine = np.flatnonzero(whole.attack == truth.id)
    rest = mine[whole.columns["time_us"][mine] / 1e6 > limit["decided"] + 1]
    assert found["attack_limited"] >= 0.9 * len(rest) > 0
    assert (found["blocks"], found["benign_dropped"], found["benign_limited"]) == ([], 0, 0)
    return limit


@pytest.mark.timeout(1_800)
@pytest.mark.parametrize("number", FLOODS)
def test_a_flood_is_limited_and_its_victims_other_traffic_passes(tmp_path, number):
    """An office is flooded with forged ACKs, and with answers of name servers: the real switch drops them."""
    found, whole, truth = replayed(tmp_path, number)
    words, service = FLOODS[number]
    limit = is_limited(found, whole, truth)
    assert limit["packets"] == words
    (flood,) = [each for each in found["incidents"] if each["service"] == service]
    assert flood["kind"] == "flood"
    assert limit["address"] in flood["victims"]
    assert flood["cost"]["metered"] == found["packets_limited"] == found["packets_dropped"]


@pytest.mark.timeout(1_800)
def test_a_scan_in_anybodys_name_is_slowed_down_and_services_go_on(tmp_path):
    """From the Internet, by SYNs alone: what the victim serves is known from handshakes, and left alone."""
    found, whole, truth = replayed(tmp_path, SCAN)
    limit = is_limited(found, whole, truth)
    assert limit["packets"].startswith("SYNs to ports other than ")
    (scan,) = [each for each in found["incidents"] if each["mitigated"]]
    assert scan["kind"] == "scan"
    assert limit["address"] in scan["victims"]
    assert scan["cost"]["metered"] == found["packets_limited"] == found["packets_dropped"]
