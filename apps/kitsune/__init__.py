"""Kitsune: packets become anomaly scores, and scores become alerts.

    record batch ─► afterimage ─► kitnet ─► threshold ─► senders ─► alerts
                    100 features  score     anomalous?   anomalous  reasons
                                                         seconds

`detector` connects these parts and does no I/O; `service` is the only file with I/O.
The method is Kitsune (Mirsky et al., NDSS 2018); the parameters follow its published implementation.
"""
