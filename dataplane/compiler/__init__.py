"""From the typed tree to something that runs: generated C, compiled once per program and kept in a cache.

tree ── layout (what is kept of a packet) ── simplify (masks that do nothing) ── control (nested blocks)
                                                                 └── c_code ── c_machine

The tests compare it with a generator of Python, `tests/naive/p4`.
"""
