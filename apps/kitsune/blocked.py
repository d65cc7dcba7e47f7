"""Blocked senders: hosts that answer a blocked sender are not held responsible for the answers.

The switch makes no copies of a blocked sender's packets, so a conversation that it begins is not seen
here.  If its packets reach the other side all the same (in a replay the capture holds the answers
to them; on a network, those that were under way), a SYN-ACK, RST, ICMP error or UDP answer would look
unsolicited.
"""

from apps.messages import Decision

MOST = 65_536
"""Most blocks that are remembered; beyond that the oldest is forgotten."""


class Blocked:
    """The blocks in force according to the firewall's decisions.  Pure."""

    def __init__(self) -> None:
        self._by_id: dict[str, tuple[str, str]] = {}
        self.targets: frozenset[tuple[str, str]] = frozenset()
        """Pairs of switch (`*`: all) and address."""
        self.changes = 0
        """Number of decisions applied."""

    def decide(self, decision: Decision) -> None:
        """Apply a decision of the firewall; dry runs are ignored."""
        if decision.dry_run or decision.action not in {"block", "unblock"}:
            return
        if decision.action == "block":
            self._by_id[decision.id] = (decision.switch, decision.target.address)
            if len(self._by_id) > MOST:
                del self._by_id[next(iter(self._by_id))]
        else:
            self._by_id.pop(decision.id, None)
        self.targets = frozenset(self._by_id.values())
        self.changes += 1

    def __len__(self) -> int:
        return len(self._by_id)

    def __bool__(self) -> bool:
        return bool(self.targets)

    def covers(self, switch: str, mac: str, address: str) -> bool:
        """Whether a sender with this MAC or address is blocked on the switch."""
        switches = (switch, "*")
        return any((each, name) in self.targets for each in switches for name in (mac, address))
