"""The supervisor that starts all processes of the product: for `up`, `replay`, demos, tests and benchmarks.

    PartSpec, PartSpec, … ──► Supervisor ──start──► Part ──► PartProcess: Child, or the embedded Valkey
                                  │ watch             │
                                  │                   ├─ ready line  (standard output)
                                  ├─ LogKeeper        ├─ heartbeats  (an inherited pipe)
                                  │  rotates logs     └─ its end     (pidfd)
                                  └─ tell: lines for the console

A part that dies is restarted after a growing pause; one that sends no heartbeats is killed first.  Only the
first start and the stop block.
"""

from sdnator.supervisor.child import Child
from sdnator.supervisor.part import PartReport
from sdnator.supervisor.spec import LogLimits, PartProcess, PartSpec, RestartPolicy
from sdnator.supervisor.supervisor import Supervisor

__all__ = ["Child", "LogLimits", "PartProcess", "PartReport", "PartSpec", "RestartPolicy", "Supervisor"]
