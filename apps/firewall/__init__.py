"""From evidence and archive history to decisions, with reasons.

evidence ─────────► policy/sequential_test, decider (enough?) ───────┐
alerts ───────────► policy/rules (the rule of seconds) ──────────────┤
SYNs, handshakes ─► syn/syn_defence (guard at once, block later) ────┼─► policy/block_lifecycle ──► Decision
ARP ──────────────► arp/arp_bindings (claims of others' addresses) ──┤        ▲            ▲
operators ────────► policy/instructions ─────────────────────────────┘   evidence/    confirmations,
                                                                         history      drop counters
SYN-ACKs ─────────► syn/syn_ack_buffer ──► RST frames for half-open connections

`incidents/` keeps what was seen of one attacker or one victim, and what was done.  `service`, `evidence/archive` and
the sinks of `enforcement/` do the I/O.
"""
