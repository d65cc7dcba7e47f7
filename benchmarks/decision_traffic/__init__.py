"""Traffic for `benchmarks.decisions`: benign networks, benign novelty and attacks as packet columns.

networks ──► chunks of an hour ─┐
novelty  ──► from a time on ────┼─► merge ─► Traffic (columns of apps.packets, attack id of each packet)
attacks  ──► with their truth ──┤                └─► capture_writer ─► PCAP + labels
real     ──► captures, mapped ──┘

No packet is an object: each habit of a network draws its packets of an hour as arrays.  The same seed gives
the same packets, wherever a reading begins.

Imitated: who speaks to whom, when, how much and in which order; flags, sequence numbers, lengths and answers of
TCP, UDP, ICMP and ARP; failures and retries.  Not imitated: payloads, TCP's congestion control (segments are
spaced, not clocked by acknowledgements), fragments, VLANs, and IPv6 beyond neighbour discovery and mDNS.
"""
