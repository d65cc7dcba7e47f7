"""Switches on one side, DUE on the other: the P4Runtime controller.

    switch ══gRPC══ connection ──packet-ins, digests──► packet_publisher ──record batches──► DUE
       ▲            (stream)     packet_in, digest_in: messages → columns; loss_tracker: lost packet-ins
       │
       └──Write, Read── session ◄── desired_switch ◄── entry_updates ◄── decisions of the firewall,
                        (calls)                                          commands of any app
                                                   ◄── classifier ◄── demand ◄── interests of consumers

`state/desired_switch` keeps the desired state of a switch and reconciles the real one with it;
`state/desired_state` compares the two.  `southbound/p4info` and `values` turn names into P4Runtime's numbers;
`telemetry/match_regions` intersects overlapping match conditions.  `service` owns DUE, `worker` the thread of
each switch, `connection` and `session` the sockets; all other modules are without I/O, but for `watchdog`.
"""
