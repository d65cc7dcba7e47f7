"""Which instance of a sharded app works on which shard.  Pure.

    newest heartbeats: offered, held ──► ShardTable.settle ──► given: shard to instance
                                              │
               withdrawn from a living instance: waits until its heartbeats say that it holds it no more

No shard is ever given to an instance while another one that lives may still work on it, and no shard moves without
need: only from an instance that has ended, or where two instances differ by more than one shard.
"""

from collections import Counter
from collections.abc import Iterable, Mapping

from due.membership import MOST_SHARDS, Heartbeat, ShardGrant


class ShardTable:
    """The shards of one app."""

    def __init__(self) -> None:
        self.given: dict[str, ShardGrant] = {}
        """Shard to the instance that works on it."""
        self._withdrawn: dict[str, tuple[str, int | None]] = {}
        """Shard to the instance that may still hold it, and the version that told it; None: not yet told."""

    def settle(self, members: Mapping[str, Heartbeat], number: int, *, unknown: bool = False) -> bool:
        """Give, withdraw and balance shards.

        Args:
            members: the newest heartbeat of each living instance.
            number: of new grants.
            unknown: there may be living instances of which nothing was heard yet; what nobody is known to hold waits.

        Returns:
            Whether `given` has changed.
        """
        before = dict(self.given)
        offers = _offers(members)
        self._confirm(members)
        self._drop(members, offers)
        holders = self._holders(members)
        self._adopt(members, holders, offers)
        planned = self._plan(members, offers)
        for shard, instance in planned.items():
            others = holders.get(shard, set()) - {instance}
            if not others and (shard in holders or not unknown):
                self.given[shard] = ShardGrant(instance, number)
                self._withdrawn.pop(shard, None)
        return self.given != before

    def told(self, version: int) -> None:
        """`given` was sent with these Assignments."""
        for shard, (instance, told) in self._withdrawn.items():
            if told is None:
                self._withdrawn[shard] = (instance, version)

    def _confirm(self, members: Mapping[str, Heartbeat]) -> None:
        """Forget withdrawals that their instances have obeyed, or did not survive."""
        for shard, (instance, version) in list(self._withdrawn.items()):
            beat = members.get(instance)
            if beat is None or (version is not None and beat.version >= version and shard not in beat.held):
                del self._withdrawn[shard]

    def _drop(self, members: Mapping[str, Heartbeat], offers: Mapping[str, list[str]]) -> None:
        for shard, grant in list(self.given.items()):
            if grant.instance not in members:
                del self.given[shard]
            elif grant.instance not in offers.get(shard, ()):
                self._withdraw(shard)

    def _withdraw(self, shard: str) -> None:
        self._withdrawn[shard] = (self.given.pop(shard).instance, None)

    def _holders(self, members: Mapping[str, Heartbeat]) -> dict[str, set[str]]:
        """By shard the living instances that may work on it."""
        holders: dict[str, set[str]] = {}
        for name, beat in members.items():
            for shard in beat.held:
                holders.setdefault(shard, set()).add(name)
        for shard, grant in self.given.items():
            holders.setdefault(shard, set()).add(grant.instance)
        for shard, (name, _) in self._withdrawn.items():
            holders.setdefault(shard, set()).add(name)
        return holders

    def _adopt(
        self,
        members: Mapping[str, Heartbeat],
        holders: Mapping[str, set[str]],
        offers: Mapping[str, list[str]],
    ) -> None:
        """What a single instance works on already, because an earlier Coordinator said so, stays with it."""
        for shard, names in holders.items():
            if shard in self.given or shard in self._withdrawn or len(names) != 1:
                continue
            name = next(iter(names))
            if name in offers.get(shard, ()):
                self.given[shard] = ShardGrant(name, members[name].held[shard])

    def _plan(self, members: Iterable[str], offers: Mapping[str, list[str]]) -> dict[str, str]:
        """An instance for each shard that has none; withdraws shards where one instance has too many."""
        load = Counter(dict.fromkeys(members, 0))
        load.update(grant.instance for grant in self.given.values())
        planned: dict[str, str] = {}
        for shard in sorted(offers.keys() - self.given.keys()):
            planned[shard] = min(offers[shard], key=lambda name: (load[name], name))
            load[planned[shard]] += 1
        for shard in sorted(self.given):
            busiest = self.given[shard].instance
            idlest = min(offers[shard], key=lambda name: (load[name], name))
            if load[busiest] - load[idlest] > 1:
                self._withdraw(shard)
                planned[shard] = idlest
                load[busiest] -= 1
                load[idlest] += 1
        return planned


def _offers(members: Mapping[str, Heartbeat]) -> dict[str, list[str]]:
    """By shard the instances that could work on it, in order."""
    offers: dict[str, list[str]] = {}
    for name in sorted(members):
        for shard in members[name].offered:
            offers.setdefault(shard, []).append(name)
    return {shard: offers[shard] for shard in sorted(offers)[:MOST_SHARDS]}
