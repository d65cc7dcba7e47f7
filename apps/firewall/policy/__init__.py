"""Rules for blocking, and the life cycle of a block."""
