"""Options of the app `flow_records`."""

import re
from ipaddress import ip_address
from typing import Final

import msgspec

from flow_records.columns import MOST_SAMPLING

MOST_EXPORTERS: Final = 256
_NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")
_LEAST_LIFETIME_S: Final = 10.0


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the collector."""

    listen: str = "127.0.0.1"
    """Address to listen on: that of the network in which the exporters are; `::` listens on all."""
    ports: tuple[int, ...] = (2055, 4739, 6343)
    """UDP ports. Each takes all protocols; these are the usual ones of NetFlow, IPFIX and sFlow."""
    exporters: dict[str, str] = {}
    """Exporters whose datagrams are accepted: name, as it stands in keys, to IP address."""
    any_exporter: bool = False
    """Accept datagrams of every address, under its address as name; for trials in a lab."""
    sampling: dict[str, int] = {}
    """Exporter to sampling rate (1 of so many packets), for exporters that do not tell theirs."""
    archive: bool = False
    """Keep flow records in Data Archives, too: some 150 bytes a record, before compression."""
    template_s: float = 1800.0
    """Seconds after which a template that is not repeated is forgotten."""
    queue: int = 8192
    """Datagrams that may wait to be decoded; further ones are dropped and counted."""

    def __post_init__(self) -> None:
        if not self.ports or not all(0 <= port <= 0xFFFF for port in self.ports):
            raise ValueError(f"ports={list(self.ports)}: one or more of 0 to 65535")
        _check_address("listen", self.listen)
        if len(self.exporters) > MOST_EXPORTERS:
            raise ValueError(f"exporters: {len(self.exporters)}; {MOST_EXPORTERS} at most")
        for name, address in self.exporters.items():
            if not _NAME.fullmatch(name):
                raise ValueError(f"exporters: {name!r} is no name; letters, digits, _ and -, 64 at most")
            _check_address(f"exporters.{name}", address)
        if len({ip_address(address) for address in self.exporters.values()}) < len(self.exporters):
            raise ValueError("exporters: two names have the same address")
        for name, rate in self.sampling.items():
            if not 1 <= rate <= MOST_SAMPLING:
                raise ValueError(f"sampling.{name}={rate}: 1 to {MOST_SAMPLING}")
        if not self.template_s >= _LEAST_LIFETIME_S:
            raise ValueError(f"template_s={self.template_s}: at least {_LEAST_LIFETIME_S:g} s")
        if self.queue < 1:
            raise ValueError(f"queue={self.queue}: at least 1")


def _check_address(what: str, text: str) -> None:
    try:
        ip_address(text)
    except ValueError:
        raise ValueError(f"{what}={text!r} is not an IP address") from None


def segment_of(address: str) -> str:
    """An address as a segment of a key: `192.0.2.1` is `192_0_2_1`, `2001:db8::1` is `2001-db8--1`."""
    return address.replace(".", "_").replace(":", "-")
