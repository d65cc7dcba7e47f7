"""The embedded P4Runtime switch: BMv2 JSON for v1model, compiled to C, between ports and controllers.

controllers ══gRPC══ p4runtime/ server ─► device ─► pipeline ── compiler/ ─► C, loaded once per program
                            ▲               │
                   packet-ins, digests   tables, registers, packet-outs
                            │               ▼
ports/ ── frames ──► packet_loop ─────► the program ── frames ──► ports/

`v1model/` reads the JSON and holds the tables; `compiler/` makes the program that runs; `bmv2` starts BMv2 in place of
all this.  `python -m dataplane` is the process.
"""
