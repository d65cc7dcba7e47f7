"""For tests of apps and controllers: a service or a switch in this process, or a pipeline of real processes.

    from sdnator.testing import AppRun
    import my_package.service

    def test_an_odd_packet_raises_an_alert():
        with AppRun(my_package.service, threshold=2.0) as app:
            app.feed("network.packets.p4runtime_ctrl.s1.all", batch)
            (alert,) = app.wait_for("network.anomaly.my_detector.alert")
            assert alert.value["score"] > 2.0

    AppRun           an app's service, fed and read through DUE on memory://: no server, no file, no other process
    SwitchDouble     the embedded switch in this process, with ports in memory
    P4RuntimeClient  talks to a switch as a controller does; EntryBuilder makes entries by their names
    SwitchTarget     a switch as a process that can be killed, stopped and started again
    ControllerRun    Data Updates, Coordinator, switch and controller as processes; Heard: what they said
    Cable            a connection between controller and switch that can be cut

Traffic comes from `sdnator.testing.packet_rows` (columns), `.query_traffic` (frames of attacks) and `.switch_traffic`
(entries and frames for a switch); `.capture_samples`, `.table_samples` and `.switch_entities` hold genuine inputs.
`sdnator.testing.oracles` computes what the product does the slow and obvious way.

AssertionError
├── NothingWritten   the app did not write what the test waited for
└── TookTooLong      a condition did not hold in time
"""

from sdnator.testing.app_run import AppRun, NothingWritten
from sdnator.testing.cable import Cable
from sdnator.testing.controller_run import Bystander, ControllerRun, Heard
from sdnator.testing.p4runtime_client import EntryBuilder, P4RuntimeClient
from sdnator.testing.switch_double import SwitchDouble
from sdnator.testing.switch_target import SwitchTarget
from sdnator.testing.waiting import TookTooLong, wait_for

__all__ = [
    "AppRun",
    "Bystander",
    "Cable",
    "ControllerRun",
    "EntryBuilder",
    "Heard",
    "NothingWritten",
    "P4RuntimeClient",
    "SwitchDouble",
    "SwitchTarget",
    "TookTooLong",
    "wait_for",
]
