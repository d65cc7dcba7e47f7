"""Switches on one side, DUE on the other: the P4Runtime controller.

    switch ══gRPC══ connection ──PacketIn──► packet_in ──record batch──► DUE
       ▲                │
       └──Write── switch ◄── desired_state ◄── blocks      ◄── decisions of the firewall
                                           ◄── telemetry   ◄── what DUE's consumers want
                                           ◄── p4info      ◄── commands of any app, by name

`desired_state` is what a switch should hold; `switch` keeps a real one equal to it, whatever breaks.
`service` owns threads and DUE, `connection` the sockets; everything else is data in, data out.
"""
