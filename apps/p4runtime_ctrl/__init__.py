"""Switches on one side, DUE on the other: the P4Runtime controller.

    switch ══gRPC══ connection ──packet-ins, digests──► outbound ──record batches──► DUE
       ▲            (stream)        packet_in, digest_in: messages → columns; progress: losses
       │
       └──Write, Read── session ◄── switch ◄── orders     ◄── decisions of the firewall (blocks, guard),
                        (calls)   (desired                    commands of any app
                                   state)  ◄── telemetry  ◄── demand ◄── what DUE's consumers want

`switch` keeps what a switch should hold and brings a real one there, whatever broke; `desired_state`
is the comparison, `p4info` and `values` turn names into P4Runtime's numbers, `boxes` is the geometry of
overlapping conditions.  `service` owns DUE and the threads, `connection` and `session` the sockets;
everything else is data in, data out.
"""
