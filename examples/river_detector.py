"""River's HalfSpaceTrees as an app: scores every packet by its length and its TCP port, and learns from it."""
# ruff: noqa: F403, F405 - the paper's way of importing

from river.anomaly import HalfSpaceTrees  # pip install "sdnator[river]"

trees = HalfSpaceTrees(seed=1, window_size=200, limits={"length": (0, 1514), "port": (-1, 65535)})


def score(length: int, port: int) -> float:
    """The packet's score, 0 to 1; then the trees learn from it."""
    packet = {"length": length, "port": port}
    found: float = trees.score_one(packet)  # type: ignore[no-untyped-call]
    trees.learn_one(packet)  # type: ignore[no-untyped-call]
    return found


# [wrapper]
from sdnator_due import *

SCORE = "network.anomaly.half_space_trees.score"
due.init("half_space_trees", PRODUCER | CONSUMER, capabilities=[Capability(SCORE, archive="always")])
due.observe("network.packets.*.*.all").subscribe(
    lambda item: due.write(
        SCORE, [*map(score, item.value["length"].tolist(), item.value["tcp_dport"].tolist())]
    )
)
# [/wrapper]
input("Enter to stop\n")
