"""From evidence and archive history to decisions, with reasons.

alerts ───────────► policy/rules (block this sender?) ───────────────┐
SYNs, handshakes ─► syn/syn_defence (guard at once, block later) ────┼─► policy/block_lifecycle ──► Decision
ARP ──────────────► arp/arp_bindings (claims of others' addresses) ──┤        ▲            ▲
operators ────────► policy/instructions ─────────────────────────────┘   evidence/    confirmations,
                                                                         history      drop counters
SYN-ACKs ─────────► syn/syn_ack_buffer ──► RST frames for half-open connections

`service`, `evidence/archive` and `enforcement/event_sink` do the I/O.
"""
