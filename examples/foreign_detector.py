"""A detector that knows nothing of SDNator, wrapped as an app: it scores every packet batch and publishes the scores."""

from detector import Detector  # any class with proc_next_packet(); here examples/detector.py

# [wrapper]
from sdnator_due import *

detector = Detector()
due.init(
    "foreign",
    PRODUCER | CONSUMER,
    capabilities=[Capability("network.anomaly.foreign.score", archive="always")],
)
due.observe("network.packets.*.*.all").subscribe(
    lambda item: due.write(
        "network.anomaly.foreign.score", [detector.proc_next_packet(p) for p in item.value["length"].tolist()]
    )
)
# [/wrapper]
input("Enter to stop\n")
