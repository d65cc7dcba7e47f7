"""A stand-in for somebody else's detector: the deviation of a packet's length from the running mean."""


class MeanDetector:
    """Scores one packet at a time."""

    def __init__(self) -> None:
        self._mean = 0.0
        self._count = 0

    def proc_next_packet(self, length: float) -> float:
        """How unusual this packet is."""
        self._count += 1
        self._mean += (length - self._mean) / self._count
        return abs(length - self._mean)
