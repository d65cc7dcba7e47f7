"""Operators over batches of packets on the host."""
