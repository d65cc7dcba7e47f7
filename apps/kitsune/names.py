"""Addresses as text, as tshark and inet_ntop write them."""

import functools
from itertools import groupby

_TEXTS = 4_096
"""As many as a busy network has at a time: in hours it meets ever new ones, of which each takes a quarter of a kilobyte."""


@functools.lru_cache(maxsize=_TEXTS)
def mac_text(mac: int) -> str:
    """A MAC address in lower case with colons."""
    return mac.to_bytes(6, "big").hex(":")


@functools.lru_cache(maxsize=_TEXTS)
def ip_text(version: int, hi: int, lo: int) -> str:
    """An IP address: IPv4 dotted, IPv6 compressed, empty for none."""
    if version == 4:
        return _dotted(lo)
    return _compressed(hi << 64 | lo) if version == 6 else ""


def _dotted(address: int) -> str:
    return ".".join(map(str, address.to_bytes(4, "big")))


def _compressed(address: int) -> str:
    """The first of the longest runs of zero words becomes `::`; IPv4 inside IPv6 stays dotted."""
    words = [address >> shift & 0xFFFF for shift in range(112, -16, -16)]
    start, length = _longest_zeros(words)
    if start == 0 and (length == 6 or (length == 5 and words[5] == 0xFFFF)):
        return f"::{'ffff:' if length == 5 else ''}{_dotted(address & 0xFFFFFFFF)}"
    texts = [f"{word:x}" for word in words]
    if length < 2:
        return ":".join(texts)
    return ":".join(texts[:start]) + "::" + ":".join(texts[start + length :])


def _longest_zeros(words: list[int]) -> tuple[int, int]:
    best, at = (0, 0), 0
    for is_zero, run in groupby(words, key=lambda word: word == 0):
        length = len(list(run))
        if is_zero and length > best[1]:
            best = (at, length)
        at += length
    return best
