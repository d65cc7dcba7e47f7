"""Who is blocked: answers to a blocked sender are no offence of those who answer.

The switch makes no copies of a blocked sender's packets, so a conversation that he begins is not seen
here.  Where his packets reach the other side all the same (in a replay the capture holds the answers
to them; on a network, those that were under way), a SYN-ACK, RST, ICMP error or UDP answer would look
as if nobody had asked for it.
"""

from apps.messages import Decision

Address = tuple[int, int, int]


class Blocked:
    """Blocks in force, as the firewall's decisions say.  Pure."""

    def __init__(self) -> None:
        self._by_id: dict[str, tuple[str, str]] = {}
        self._targets: set[tuple[str, str]] = set()

    def decide(self, decision: Decision) -> None:
        """Take a decision of the firewall; a dry run blocks nobody."""
        if decision.dry_run or decision.action not in {"block", "unblock"}:
            return
        if decision.action == "block":
            self._by_id[decision.id] = (decision.switch, decision.target.address)
        else:
            self._by_id.pop(decision.id, None)
        self._targets = set(self._by_id.values())

    def __bool__(self) -> bool:
        return bool(self._targets)

    def covers(self, switch: str, mac: str, address: str) -> bool:
        """Whether a sender with this MAC or address is blocked on the switch."""
        return (switch, mac) in self._targets or (switch, address) in self._targets
