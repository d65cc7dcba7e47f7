"""Blocks outside a running pipeline: the archive's view, panic on a switch, nftables, reasons."""
