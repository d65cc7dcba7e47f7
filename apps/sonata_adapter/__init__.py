"""Telemetry by key: a query that somebody observes is installed in the switch, and its results are written.

keys wanted ─► keys ─► planner/ ─┬─► controller_updates ─► the controller: classifier bits, counting stages
               query/: language  │
                                 └─► host/: operators on batches ◄── switch/: what the switch counted ◄── controller
                                        │                         ◄── copied packets, frames
                                        └─► results; evidence/: what exceeds training

`control` connects these parts and does no I/O; `service` does it.  The method is Sonata (Gupta et al., SIGCOMM 2018).
"""
