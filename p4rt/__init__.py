"""P4Runtime's messages and service on current protobuf: the wire that switch and controller share.

The generated modules of the `p4runtime` wheel were made by an old protoc and are refused by every
protobuf since 4 (only its slow pure-Python back end takes them).  The same files carry their
serialized file descriptors, though, and those are all that protobuf needs.  This package reads the
descriptors out of the wheel's source text, without running it, and registers them.

    dataplane (server) ──┐
                         ├── p4rt ── descriptors of the p4runtime wheel ── protobuf (upb)
    p4runtime_ctrl ──────┘

Nothing here is ours but the registering; both ends import it, as both would import generated code.
"""

from p4rt import polling as polling  # isort: skip  # before anything loads gRPC
from p4rt.channels import INSECURE, ChannelSecurity, InsecureChannel, open_channel
from p4rt.messages import p4data, p4info, p4runtime, p4types, status
from p4rt.service import P4RuntimeStub, add_p4runtime_servicer, or_none, stream_of_bytes

__all__ = [
    "INSECURE",
    "ChannelSecurity",
    "InsecureChannel",
    "P4RuntimeStub",
    "add_p4runtime_servicer",
    "open_channel",
    "or_none",
    "p4data",
    "p4info",
    "p4runtime",
    "p4types",
    "status",
    "stream_of_bytes",
]
