"""A bridge between two sites that have Data Updates and a Coordinator of their own.

    near site                        bridge                              far site
    ─────────                        ──────                              ────────
    Coordinator ◄── interest in K ── Engine   Engine ◄── assignment K ── Coordinator ◄── somebody wants K
    producer ── frames of K ──► FrameForwarder ── frames, unchanged ────► readers

What crosses is declared twice: an operator allows key patterns for each direction, and of these only what somebody
at the other site wants is sent, once, however many want it there.  Frames keep their writer, numbers and times, so
that readers count gaps and recognise repeats as if there were no bridge.
"""
