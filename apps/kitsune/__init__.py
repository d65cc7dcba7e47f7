"""Kitsune: packets become anomaly scores, and scores become alerts.

    record batch ─► afterimage ─► kitnet ─► threshold ─► senders ─► alerts
                    100 features  score     the line     hot seconds  reasons

`detector` joins the parts and is pure; `service` is the only file with I/O.
The method is Kitsune (Mirsky et al., NDSS 2018); the figures follow its published implementation.
"""
