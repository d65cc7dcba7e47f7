"""Queries: their language, catalogue and dataflow."""
