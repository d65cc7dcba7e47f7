"""The Coordinator: which app gets what from whom, and which instance of an app does the work.

registrations, heartbeats ─► service ─► admission ─► registry ─► assignments: keys, rates, active instance, shards
                                │                       │ ▲
                                │                       │ └─ matching, selection, sharding
                                │                       └──► views ─► api, metrics   checkpoint, events ─► archive
                                └── active_standby: of several Coordinators one is active

`service`, `api`, `checkpoint`, `readers` and `retention` do the I/O.  All state is soft: it is rebuilt from heartbeats
and the newest checkpoint while data keeps flowing.
"""
