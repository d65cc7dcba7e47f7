"""Counter values of blocks in the state item: all of them while they are few."""

from typing import Any, Final

_FEW: Final = 256


class BlockCounters:
    """Counter values by handle; with many blocks only those that changed since the last call."""

    def __init__(self) -> None:
        self.shown: list[dict[str, Any]] = []
        self._packets: dict[str, int] = {}

    def take(self, readings: list[dict[str, Any]]) -> None:
        """New readings of all blocks, `{"id", "handle", "packets", "bytes"}` each."""
        if len(readings) <= _FEW:
            self.shown = readings
        else:
            self.shown = [each for each in readings if self._packets.get(each["handle"]) != each["packets"]]
        self._packets = {each["handle"]: each["packets"] for each in readings}
