"""Blocks of the firewall as nftables sets of this host, in a table of their own."""
