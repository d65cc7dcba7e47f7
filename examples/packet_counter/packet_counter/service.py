"""Packets in, one count a period out.

network.packets.*.*.all ──► PacketCounter ──► network.traffic.packet_counter.count
"""

import sys
from collections.abc import Sequence
from typing import Any

import msgspec

import due.service
from due import Capability, Engine, Interest, Item

COUNT = "network.traffic.packet_counter.count"
INTERESTS = (Interest("network.packets.*.*.all"),)
CAPABILITIES = (Capability(COUNT, archive="always"),)


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the packet counter."""

    every: int = 1000
    """Packets between two counts."""


class PacketCounterService:
    """The app as `due.service.run` drives it."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine = engine
        self._settings = settings
        self._seen = 0
        self._told = 0

    def start(self) -> None:
        """Subscribe."""
        self._engine.observe("network.packets.*.*.all").subscribe(self._count)

    def tick(self) -> None:
        """Nothing to do between packets."""

    def stop(self) -> None:
        """Nothing is left to write."""

    def health(self) -> dict[str, Any]:
        """Packets so far."""
        return {"packets": self._seen}

    def _count(self, item: Item) -> None:
        self._seen += len(item.value)
        if self._seen - self._told >= self._settings.every:
            self._told = self._seen
            self._engine.write(COUNT, {"packets": self._seen}, event_time=item.event_time)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the app until a signal ends it."""
    return due.service.run("packet_counter", PacketCounterService, Settings, INTERESTS, CAPABILITIES, argv)


if __name__ == "__main__":
    sys.exit(main())
