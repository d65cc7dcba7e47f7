"""Who may write: primary and backups of each role (P4Runtime 1.4, section 5.3 and 5.4).

    stream A ── update(role, election id) ──► Arbitration ──► Notice for A, B, …
    stream B ── leaves ───────────────────►      │
    Write    ── check(role, election id) ───►    └─ per role: clients, highest id ever seen, primary

A client whose id is at least the highest ever seen becomes primary.  When it leaves, the role has no
primary until someone sends an update with an id that is high enough.  Pure: no stream, lock or clock.
"""

from dataclasses import dataclass, field

from dataplane.p4runtime.status import Denied, InvalidArgument, MissingEntity, Precondition

_OK, _NO_PRIMARY, _BACKUP = 0, 5, 6
DEFAULT_ROLE = ""


@dataclass(frozen=True, slots=True)
class ArbitrationUpdate:
    """What one client is told: `code` 0 = you are primary, 6 = somebody else is, 5 = nobody is.

    election_id: the highest id seen for the role, or None where there was no primary yet
    """

    client: int
    role: str
    code: int
    election_id: int | None


@dataclass(slots=True)
class _Role:
    clients: dict[int, int | None] = field(default_factory=dict)
    highest: int | None = None
    primary: int | None = None


class Arbitration:
    """The clients of one device."""

    def __init__(self) -> None:
        self._roles: dict[str, _Role] = {}
        self._role_of: dict[int, str] = {}

    def update(self, client: int, role: str, election_id: int | None) -> list[ArbitrationUpdate]:
        """Take in a MasterArbitrationUpdate; the notices are to be sent in order.

        client: a number that names the stream
        election_id: 128 bits, or None where unset: that client never becomes primary

        Raises InvalidArgument (id in use by another client) and Precondition (a stream may not change
        its role); the stream must then be ended.
        """
        known = self._role_of.get(client)
        if known is not None and known != role:
            raise Precondition(f"this stream has role {known!r}; open another one for role {role!r}")
        state = self._roles.setdefault(role, _Role())
        others = (number for other, number in state.clients.items() if other != client)
        if election_id is not None and election_id in others:
            raise InvalidArgument(f"election id {election_id} is in use by another client of role {role!r}")
        self._role_of[client] = role
        state.clients[client] = election_id
        if election_id is not None and (state.highest is None or election_id >= state.highest):
            state.highest = election_id
            state.primary = client
            return self._tell_all(role, state)
        if state.primary == client:
            state.primary = None
            return self._tell_all(role, state)
        return [self._notice(role, state, client)]

    def leave(self, client: int) -> list[ArbitrationUpdate]:
        """A stream has ended; a client that never sent an update is no error."""
        role = self._role_of.pop(client, None)
        if role is None:
            return []
        state = self._roles[role]
        del state.clients[client]
        if state.primary != client:
            return []
        state.primary = None
        return self._tell_all(role, state)

    def role_of(self, client: int) -> str | None:
        """The client's role, None before its first update."""
        return self._role_of.get(client)

    def primary(self, role: str = DEFAULT_ROLE) -> int | None:
        """The client that is primary of a role."""
        state = self._roles.get(role)
        return None if state is None else state.primary

    def primaries(self) -> list[int]:
        """The primary clients of all roles that have one."""
        return [state.primary for state in self._roles.values() if state.primary is not None]

    def is_primary(self, client: int) -> bool:
        """Whether this client is the primary of its role."""
        role = self._role_of.get(client)
        return role is not None and self.primary(role) == client

    def check(self, role: str, election_id: int) -> None:
        """Let a Write or SetForwardingPipelineConfig pass.

        Raises Missing (no client ever had this role) or Denied (not the primary's election id).
        """
        state = self._roles.get(role)
        if state is None:
            if role != DEFAULT_ROLE:
                raise MissingEntity(f"role {role!r} is unknown: no stream has claimed it")
            raise Denied("no primary: open a stream and send a MasterArbitrationUpdate first")
        if state.primary is None:
            raise Denied(f"role {role!r} has no primary now; the highest election id seen is {state.highest}")
        if state.clients[state.primary] != election_id:
            raise Denied(f"election id {election_id} is not the primary's of role {role!r}")

    def _tell_all(self, role: str, state: _Role) -> list[ArbitrationUpdate]:
        # the new primary hears last: by then nobody else believes to be it
        order = sorted(state.clients, key=lambda client: client == state.primary)
        return [self._notice(role, state, client) for client in order]

    @staticmethod
    def _notice(role: str, state: _Role, client: int) -> ArbitrationUpdate:
        code = _NO_PRIMARY if state.primary is None else _OK if state.primary == client else _BACKUP
        return ArbitrationUpdate(client, role, code, state.highest)
