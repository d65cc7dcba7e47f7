"""A detector that knows nothing of SDNator, wrapped as an app: it scores every packet and publishes the scores."""
# ruff: noqa: F403, F405 - the paper's way of importing

from detector import MeanDetector  # type: ignore[import-not-found] # any class with proc_next_packet(); here examples/detector.py

# [wrapper]
from sdnator_due import *

SCORE = "network.anomaly.foreign.score"
detector = MeanDetector()
due.init("foreign", PRODUCER | CONSUMER, capabilities=[Capability(SCORE, archive="always")])
packets = due.observe("network.packets.*.*.all")
packets.subscribe(
    lambda item: due.write(SCORE, [detector.proc_next_packet(x) for x in item.value["length"].tolist()])
)
# [/wrapper]
input("Enter to stop\n")
