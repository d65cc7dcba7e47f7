"""From evidence and archive history to decisions, with reasons.

alerts ───────────► policy (enough, and may it be blocked?) ─┐
SYNs, handshakes ─► syn_defence (guard at once, block later) ─┼─► ledger (ids, ends, caps, probation) ──► Decision
ARP ──────────────► bindings (who claims another's address) ─┤        ▲                ▲
people ───────────► instructions ────────────────────────────┘   history      confirmations, drop counters
SYN-ACKs ─────────► half_open ──► RST frames for what a flood left at a server

service, archive and outlets do the I/O.
"""
