"""Counts packets by protocol: an app of SDNator that lives in a package of its own."""
