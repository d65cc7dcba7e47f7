"""Services that may be protected: an address and a TCP port."""

import ipaddress
from typing import Self

import msgspec

from apps.messages import Target


class TcpService(msgspec.Struct, frozen=True, order=True):
    """A TCP service; the address in its canonical spelling."""

    address: str
    port: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """`192.0.2.1:80` or `[2001:db8::1]:80`; raises ValueError that names the valid forms."""
        address, _, port = text.rpartition(":")
        try:
            canonical = str(ipaddress.ip_address(address.removeprefix("[").removesuffix("]")))
        except ValueError:
            canonical = ""
        if not canonical or not port.isdecimal() or not 0 < int(port) < 65_536:
            raise ValueError(f"service {text!r}: give ADDRESS:PORT, such as 192.0.2.1:80 or [2001:db8::1]:80")
        return cls(canonical, int(port))

    @property
    def target(self) -> Target:
        """The service as it appears in decisions."""
        return Target(kind="ip", address=self.address, port=self.port)

    def __str__(self) -> str:
        return f"[{self.address}]:{self.port}" if ":" in self.address else f"{self.address}:{self.port}"
