"""Data sets: captures that are generated, spliced, rebuilt from a table, or fetched.

mirai_like ──► benign, attack ──► frames ──► OUT.pcap + OUT.labels.csv
splice     BENIGN + ATTACK ──► OUT.pcap + OUT.labels.csv
rebuild    MIRAI.tsv[.gz] ──► OUT.pcap
fetch      URL ──► a file, resumable, with its checksum
"""
