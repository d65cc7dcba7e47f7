"""River's HalfSpaceTrees as a source of evidence: what it finds counts in the firewall's decisions."""
# ruff: noqa: F403, F405 - the paper's way of importing

import math
import sys
from collections.abc import Iterator

from river.anomaly import HalfSpaceTrees  # pip install "sdnator[river]"

from apps.evidence import Evidence
from apps.messages import Sender
from due import Item

LEARN_S = float(sys.argv[1]) if len(sys.argv) > 1 else 600.0
"""Seconds of capture time in which traffic is taken to be benign."""

trees = HalfSpaceTrees(seed=1, window_size=200, limits={"length": (0, 1514), "port": (-1, 65535)})
learnt = {"from": -1.0, "highest": 0.0}
odd_seconds: set[tuple[int, int, int]] = set()


def findings(item: Item) -> Iterator[Evidence]:
    """Evidence against the senders of packets that are odder than any packet of the time of learning."""
    batch, switch = item.value, item.key.split(".")[3]
    for row in range(len(batch)):
        time_us, port, mac = int(batch["time_us"][row]), int(batch["port"][row]), int(batch["eth_src"][row])
        packet = {"length": int(batch["length"][row]), "port": int(batch["tcp_dport"][row])}
        score: float = trees.score_one(packet)  # type: ignore[no-untyped-call]
        learnt["from"] = time_us / 1e6 if learnt["from"] < 0 else learnt["from"]
        if time_us / 1e6 < learnt["from"] + LEARN_S:
            trees.learn_one(packet)  # type: ignore[no-untyped-call]
            # before two windows of 200 the trees know nothing
            learnt["packets"] = learnt.get("packets", 0) + 1
            learnt["highest"] = max(learnt["highest"], score if learnt["packets"] > 400 else 0.0)
        elif score > learnt["highest"] and (port, mac, time_us // 1_000_000) not in odd_seconds:
            # packets of one second say one thing: no second of LEARN_S was like this one, so ln(LEARN_S) nats
            odd_seconds.add((port, mac, time_us // 1_000_000))
            address = mac.to_bytes(6).hex(":")
            yield Evidence(
                id=f"half_space_trees-{time_us}-{address}",
                kind="unlike_training",
                source="odd_packets",
                sender=Sender(switch=switch, port=port, mac=address),
                nats=math.log(max(LEARN_S, 2.0)),
                since=time_us * 1_000,
                event_time=time_us * 1_000,
                packets=1,
                first_packet=int(batch["arrival"][row]),
                text=f"a packet of {address} scored {score:.2f}; at most {learnt['highest']:.2f} while learning",
            )


# [wrapper]
from sdnator_due import *

FOUND = "network.evidence.half_space_trees.odd_packets"
said = Capability(FOUND, delivery="reliable", archive="always")
due.init("half_space_trees", PRODUCER | CONSUMER, capabilities=[said])
due.observe("network.packets.*.*.all").subscribe(
    lambda item: [due.write(FOUND, one.to_value(), event_time=one.event_time) for one in findings(item)]
)
# [/wrapper]
input("Enter to stop\n")
