"""Sources that have completed a handshake: the switch lets their SYNs through without a challenge.

The most recent ones are kept, as many as fit.  Pure: changes are returned as table updates.
"""

import ipaddress
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any, Final

from apps.messages import TableUpdate

HANDSHAKES: Final = "network.handshake.sonata.tcp"
TABLE: Final = "ingress.known_sources"
DAY: Final = 86_400_000_000_000
_BATCH: Final = 200
"""Updates of one command."""


class KnownSources:
    """The `limit` sources with the most recent handshakes; times are capture time in ns.

    Args:
        limit: most sources.
        days: capture time after which a source whose last handshake it was is no longer known.
    """

    def __init__(self, limit: int, days: int = 30) -> None:
        self._limit = limit
        self._held = days * DAY
        self._seen: OrderedDict[str, int] = OrderedDict()
        self._added: OrderedDict[str, None] = OrderedDict()
        self._dropped: OrderedDict[str, None] = OrderedDict()

    def __len__(self) -> int:
        return len(self._seen)

    def __iter__(self) -> Iterator[str]:
        return iter(self._seen)

    def __contains__(self, source: object) -> bool:
        return source in self._seen

    def times(self) -> list[tuple[str, int]]:
        """Each source and its last handshake, the most recent last."""
        return list(self._seen.items())

    def learn(self, source: str, at: int) -> None:
        """Record a completed handshake of this source."""
        if source not in self._seen:
            self._added[source] = None
            if source in self._dropped:  # it is still in the switch
                del self._dropped[source], self._added[source]
        self._seen[source] = max(at, self._seen.get(source, 0))
        self._seen.move_to_end(source)
        while len(self._seen) > self._limit or next(iter(self._seen.values())) < at - self._held:
            self._drop(next(iter(self._seen)))

    def _drop(self, source: str) -> None:
        del self._seen[source]
        if source in self._added:
            del self._added[source]
        else:
            self._dropped[source] = None

    def changes(self) -> list[TableUpdate]:
        """Table updates since the last call; deletions first."""
        updates = [_update("delete", source) for source in self._dropped]
        updates += [_update("insert", source) for source in self._added]
        self._dropped.clear()
        self._added.clear()
        return updates

    def everything(self) -> list[TableUpdate]:
        """All sources, for a switch that has none of them."""
        return [_update("insert", source) for source in self._seen]


def _update(kind: Any, source: str) -> TableUpdate:
    match = {"is_ipv4": int(ipaddress.ip_address(source).version == 4), "src": source}
    return TableUpdate(kind=kind, table=TABLE, match=match, action="" if kind == "delete" else "known")


def in_batches(updates: Iterable[TableUpdate]) -> Iterable[tuple[TableUpdate, ...]]:
    """Commands small enough for one write to a switch."""
    rest = iter(updates)
    while batch := tuple(islice(rest, _BATCH)):
        yield batch
