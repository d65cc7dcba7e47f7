"""Evidence that somebody plants in the name of another blocks who plants it, never who is named."""

import numpy as np
import pytest

from apps.firewall.policy.rules import Rules
from apps.packets import PACKET_COLUMNS
from benchmarks.decision_traffic.traffic import Traffic
from benchmarks.decisions_core import DecisionRun
from tests.apps.kitsune.behaviour.test_behaviour import SYN, batch, handshake, packet

HOST, SERVER, ATTACKER, ROUTER = 0x0A000005, 0x0A000001, 0x0A000042, 0x0A0000FE
OUTSIDE = [0x08000000 + n for n in range(8)]
UNSEEN = 0x09090909


def traffic(rows):
    columns = batch(sorted(rows, key=lambda row: row["time_us"]))
    return Traffic({name: columns[name] for name in PACKET_COLUMNS}, np.zeros(len(rows), np.int32))


def training():
    """Twenty minutes: hosts talk to a server, and with the outside behind the router."""
    rows = []
    for at in range(0, 1_200, 5):
        for client in (HOST, ATTACKER):
            rows += handshake(at + client % 7 / 10, client, SERVER, 30_000 + at, 80)
            far = OUTSIDE[at % 8]
            outward = handshake(at + 1 + client % 7 / 10, client, far, 31_000 + at, 443)
            rows += [through_router(row) for row in outward]
    return rows


def through_router(row):
    """Outside addresses have the router's MAC and port."""
    row = dict(row)
    if row["ip_src_lo"] >> 24 != 10:
        row |= {"eth_src": ROUTER, "port": ROUTER & 0xFF}
    if row["ip_dst_lo"] >> 24 != 10:
        row["eth_dst"] = ROUTER
    return row


def test_a_bot_is_blocked_at_its_first_probe():
    """No stack begins a connection with the destination's address; a telnet client's SYN leads to nothing."""
    rows = training()
    run = DecisionRun(len(rows), Rules())
    run.feed(traffic(rows))
    client = through_router(packet(1_210, HOST, UNSEEN, 50_000, 23, SYN) | {"tcp_seq": 4_711})
    run.feed(traffic([client]))
    assert not run.decided
    probe = through_router(packet(1_220, ATTACKER, UNSEEN, 50_000, 23, SYN) | {"tcp_seq": UNSEEN})
    run.feed(traffic([probe]))
    (decided,) = run.decided
    assert (decided.target.kind, decided.target.port) == ("mac", ATTACKER & 0xFF)
    assert "as Mirai does" in decided.reason


@pytest.mark.parametrize(
    ("name", "steals_mac"),
    [(HOST, False), (HOST, True), (OUTSIDE[0], False), (UNSEEN, False)],
    ids=["a neighbour", "a neighbour and its MAC", "a known site", "an unknown site"],
)
def test_a_scan_in_anothers_name(name, steals_mac):
    """The scan comes from the attacker's port; the block holds there, and what is named goes on elsewhere."""
    rows = training()
    run = DecisionRun(len(rows), Rules())
    run.feed(traffic(rows))
    mac = name if steals_mac else ATTACKER
    false = {"eth_src": mac, "port": ATTACKER & 0xFF}
    scan = [packet(1_210 + n / 50, name, SERVER, 50_000, 1_000 + n, SYN) | false for n in range(200)]
    stopped = run.feed(traffic(scan))
    assert stopped.sum() > 50
    targets = [each.target for each in run.decided if each.target is not None]
    assert targets
    assert all(target.kind == "mac" and target.port == ATTACKER & 0xFF for target in targets)
    genuine = [through_router(row) for row in handshake(1_220, name, SERVER, 40_000, 80)]
    assert not run.feed(traffic(genuine)).any()
