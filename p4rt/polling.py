"""How gRPC waits for its sockets; to be said before gRPC is loaded, so programs import p4rt first of all.

gRPC 1.80 gave Python's channels and servers threads of their own for that (its EventEngine).  Whoever waits
for a message is then woken by a thread that was woken by the socket: a stream of small messages, as
packet-ins are, loses a third and more of its rate.  The former way, in which the waiting thread looks at the
socket itself, is still there, and chosen here for the versions that this was measured with.  Who sets
GRPC_EXPERIMENTS keeps his own choice.
"""

import os
from importlib.metadata import version

VARIABLE = "GRPC_EXPERIMENTS"
FORMER_WAY = "-event_engine_client,-event_engine_listener"
_SINCE, _UNTIL = (1, 80), (1, 85)


def choose() -> None:
    """Set the variable, if this version of gRPC knows what it says."""
    release = tuple(int(part) for part in version("grpcio").split(".")[:2])
    if _SINCE <= release <= _UNTIL:
        os.environ.setdefault(VARIABLE, FORMER_WAY)


choose()
