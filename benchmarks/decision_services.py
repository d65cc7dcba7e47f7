"""Services of generated traffic, as the product knows them: from completed handshakes.

SYN-ACK of a service ─► half open ─► ACK of the client: the service is known
"""

import ipaddress
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from benchmarks.decision_traffic.traffic import Traffic

_FIN, _SYN, _RST, _ACK = 0x01, 0x02, 0x04, 0x10
_NAMES: Final = ("ip_src_lo", "tcp_sport", "ip_dst_lo", "tcp_dport")
Services = dict[str, set[int]]
"""TCP ports by address."""


def services_of(traffic: Traffic) -> Services:
    """The services of IPv4 hosts with which somebody has completed a handshake.

    Args:
        traffic: packets in order of time.
    """
    columns = traffic.columns
    flags = columns["tcp_flags"]
    is_tcp = (columns["tcp_sport"] >= 0) & (columns["quoted"] == 0) & (columns["ip_version"] == 4)
    opened: dict[tuple[int, ...], int] = {}
    for row, ends in _ends(columns, is_tcp & (flags & (_SYN | _ACK | _RST) == _SYN | _ACK)):
        opened.setdefault(ends, row)
    found: Services = {}
    for row, (client, sport, server, port) in _ends(
        columns, is_tcp & (flags & (_SYN | _ACK | _RST | _FIN) == _ACK)
    ):
        begun = opened.get((server, port, client, sport))
        if begun is not None and begun < row:
            found.setdefault(str(ipaddress.IPv4Address(server)), set()).add(port)
    return found


def _ends(columns: dict[str, npt.NDArray[Any]], chosen: npt.NDArray[np.bool_]) -> Any:
    """Row and (source, its port, destination, its port) of packets."""
    rows = np.flatnonzero(chosen)
    return zip(
        rows.tolist(), zip(*(columns[name][rows].tolist() for name in _NAMES), strict=True), strict=True
    )
