"""Addresses as text, as tshark writes them."""

import functools
import socket

_TEXTS = 65_536


@functools.lru_cache(maxsize=_TEXTS)
def mac_text(mac: int) -> str:
    """Lower case, colons."""
    return mac.to_bytes(6, "big").hex(":")


@functools.lru_cache(maxsize=_TEXTS)
def ip_text(version: int, hi: int, lo: int) -> str:
    """IPv4 dotted, IPv6 compressed, empty for no address."""
    if version == 4:
        return socket.inet_ntop(socket.AF_INET, lo.to_bytes(4, "big"))
    if version == 6:
        return socket.inet_ntop(socket.AF_INET6, hi.to_bytes(8, "big") + lo.to_bytes(8, "big"))
    return ""
