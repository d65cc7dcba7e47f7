"""Data sets: captures that are generated, spliced, rebuilt from a table, or fetched by name.

mirai_like ──► benign, attack ──► frames ──► OUT.pcap + OUT.labels.csv
splice     BENIGN + ATTACK ──► OUT.pcap + OUT.labels.csv
rebuild    MIRAI.tsv[.gz] ──► OUT.pcap
catalogue, named_fetch ──► fetch ──► unpacking ──► capture, labels ──► local_sets (where they are, checksums)
flow_tables ──► flow_labels: labels of packets from labels of flows
fetch      URL ──► a file, resumable, with its checksum
"""
