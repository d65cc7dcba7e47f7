"""The one place that opens channels to switches: a Unix socket, TLS both ways, or what somebody has allowed in words.

    open_channel(address, security) ─┬─ unix:/PATH          plain: the socket's mode says who connects
                                     ├─ ca is given         TLS; the own certificate shows who we are
                                     ├─ insecure            plain TCP: everybody on the way reads and changes it
                                     └─ neither             InsecureChannel, which says what to write

Whoever reaches the P4Runtime port of a switch without TLS can become its primary controller, on 127.0.0.1 every
user of the machine.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc

UNIX = "unix:"


class InsecureChannel(ValueError):
    """The channel would be open to others, or a file for its TLS cannot be used."""


@dataclass(frozen=True, kw_only=True)
class ChannelSecurity:
    """How channels to one switch are secured; nothing said: by a Unix socket only."""

    ca: str = ""
    """File of the CA certificate that signed the switch's; empty: no TLS."""
    certificate: str = ""
    """File of the own certificate, which names the role."""
    key: str = ""
    """File of its key."""
    insecure: bool = False
    """Without TLS over TCP: a switch that has none, as BMv2, in a lab."""

    def check(self, address: str) -> None:
        """Refuse what `open_channel` would refuse.  Raises InsecureChannel."""
        if address.startswith(UNIX):
            return
        if self.ca:
            _credentials(self)
            return
        if self.insecure:
            return
        raise InsecureChannel(
            f"switch at {address}: P4Runtime over TCP needs TLS: set tls_ca, tls_certificate and tls_key in "
            "[p4runtime_ctrl] (`sdnator cert init` makes the files); for a switch without TLS in a lab write "
            "insecure = true in its [[switches]], or give --insecure"
        )


INSECURE = ChannelSecurity(insecure=True)
"""For switches without TLS that the product itself starts on loopback, and those of tests."""


def open_channel(
    address: str, security: ChannelSecurity | None = None, options: Sequence[tuple[str, Any]] = ()
) -> grpc.Channel:
    """A channel to a switch; connects at the first call.

    Args:
        address: HOST:PORT or unix:/PATH.
        security: what the settings say of the switch; None: nothing.
        options: of gRPC.

    Raises:
        InsecureChannel: TCP without TLS that nobody has allowed, or a file that cannot be read.
    """
    chosen = security or ChannelSecurity()
    if chosen.ca and not address.startswith(UNIX):
        return grpc.secure_channel(address, _credentials(chosen), options=tuple(options))
    chosen.check(address)
    return grpc.insecure_channel(address, options=tuple(options))


def _credentials(security: ChannelSecurity) -> grpc.ChannelCredentials:
    if bool(security.certificate) != bool(security.key):
        raise InsecureChannel("tls_certificate and tls_key belong together: give both")
    try:
        ca, key, certificate = (
            Path(name).read_bytes() if name else None
            for name in (security.ca, security.key, security.certificate)
        )
    except OSError as error:
        raise InsecureChannel(f"TLS file {error.filename}: {error.strerror}") from error
    return grpc.ssl_channel_credentials(ca, key, certificate)
