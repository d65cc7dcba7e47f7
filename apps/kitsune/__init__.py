"""Kitsune: packets become anomaly scores, and scores become alerts.

    record batch ─► afterimage ─► kitnet ─► threshold ─► senders ─► alerts
         │          100 features  score     anomalous?   anomalous  reasons
         │                          │                    seconds
         └─► behaviour/, victims ───┴─► what exceeds training ─► evidence

`detector` connects these parts and does no I/O; `service` does it, with `kept_model` and `model_file`.
The method is Kitsune (Mirsky et al., NDSS 2018); the parameters follow its published implementation.
"""
