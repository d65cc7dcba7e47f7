"""What a client may do at the P4Runtime server, by the name (CN) of the certificate that it shows.

    --tls-rights controller=tables,packet-out,pipeline --tls-rights viewer=
                     │                                            └─ reads only
                     └─ name of the client's certificate

Reading is for every name that is listed; a name that is not is refused.  Who may not write tables may be primary
of the P4Runtime role of its own name only, so that it takes no controller's place.
"""

from collections.abc import Iterable, Mapping
from typing import Final

from dataplane.p4runtime.listening import ServerError
from dataplane.p4runtime.status import Denied

TABLES: Final = "tables"
"""Write: entries of every kind."""
PACKET_OUT: Final = "packet-out"
PIPELINE: Final = "pipeline"
"""Set the forwarding pipeline."""
RIGHTS: Final = (TABLES, PACKET_OUT, PIPELINE)
DEFAULT: Final = ("controller=tables,packet-out,pipeline", "operator=tables,packet-out", "viewer=")
"""Those that `sdnator cert init` makes certificates for."""
_COMMON_NAME: Final = "x509_common_name"

Peer = Mapping[str, Iterable[bytes]]
"""What gRPC knows of a client's certificate: property to values."""


class CertificateRights:
    """Rights by name.

    Args:
        options: NAME=RIGHT,RIGHT.

    Raises:
        ServerError: an option that cannot be read.
    """

    def __init__(self, options: Iterable[str] = DEFAULT) -> None:
        self._rights: dict[str, frozenset[str]] = {}
        for option in options:
            name, equals, rest = option.partition("=")
            found = frozenset(filter(None, rest.split(",")))
            if not name or not equals or not found <= set(RIGHTS):
                raise ServerError(f"--tls-rights {option}: give NAME= and some of {','.join(RIGHTS)}")
            self._rights[name] = found

    @property
    def roles(self) -> list[str]:
        """P4Runtime roles that go with names."""
        return [name for name, rights in self._rights.items() if rights and TABLES not in rights]

    def name_of(self, peer: Peer) -> str:
        """The name that a client's certificate gives it.  Raises Denied where it has no rights at all."""
        names = [each.decode("utf-8", "replace") for each in peer.get(_COMMON_NAME, ())]
        if len(names) != 1 or names[0] not in self._rights:
            shown = ", ".join(map(repr, names)) or "no name"
            raise Denied(
                f"a certificate of {shown} has no rights here: start the switch with --tls-rights NAME=…"
            )
        return names[0]

    def require(self, peer: Peer, right: str) -> None:
        """Let a call pass that needs a right; empty: reading.  Raises Denied."""
        name = self.name_of(peer)
        if right and right not in self._rights[name]:
            raise Denied(f"the certificate of {name!r} does not give the right {right!r}")

    def require_stream(self, peer: Peer) -> None:
        """Let a stream be opened.  Raises Denied for those who may only read: they could become primary."""
        name = self.name_of(peer)
        if not self._rights[name]:
            raise Denied(f"the certificate of {name!r} gives the right to read only, without a stream")

    def require_claim(self, peer: Peer, role: str) -> None:
        """Let a client stand for primary of a P4Runtime role.  Raises Denied."""
        name = self.name_of(peer)
        if TABLES not in self._rights[name] and role != name:
            raise Denied(f"the certificate of {name!r} allows the role {name!r} only")
