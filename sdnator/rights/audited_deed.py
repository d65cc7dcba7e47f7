"""What the audit trail keeps: who did what, and from where."""

from collections import deque

from apps.messages import Message, Name, Words

AUDITED = "network.audit.*.*"
COMMANDS = "network.audit.operator.command"
"""What was done on the command line."""
REFUSED = "refused to sign in"
_MINUTE = 60.0


class AuditedDeed(Message, frozen=True, kw_only=True):
    """`network.audit.<app>.<place>`: something that a person did."""

    who: Name
    """Name of the user; `owner`: who holds the token or came by a link."""
    deed: Words
    source: Name = ""
    """Address of the browser; empty: not known."""
    instruction: Name = ""
    """Id of the instruction that told an app to do it; empty: none did."""
    unnoted: int = 0
    """Refused sign-ins so far that were too many to be kept."""


class MinuteLimit:
    """Lets so many pass in a minute."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._passed: deque[float] = deque()

    def pass_on(self, now: float) -> bool:
        """Whether one more may pass; `now` in seconds."""
        while self._passed and now - self._passed[0] >= _MINUTE:
            self._passed.popleft()
        if len(self._passed) >= self._most:
            return False
        self._passed.append(now)
        return True
