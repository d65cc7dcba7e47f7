"""Values of match fields and parameters: between the apps' notation and P4Runtime's byte strings.

P4Runtime's canonical form is the shortest big-endian string, at least one byte (specification 8.3).
"""

import ipaddress
import re

from apps.p4runtime_ctrl.errors import EntryError

MAC_BITS = 48
ADDRESS_BITS = 128
_IPV4_BITS = 32
_HIGH_BITS = ((1 << ADDRESS_BITS) - 1) ^ ((1 << _IPV4_BITS) - 1)
_MAC = re.compile(r"[0-9a-fA-F]{2}([:-][0-9a-fA-F]{2}){5}")


def canonical(value: int) -> bytes:
    """The shortest big-endian byte string of a value that is not negative."""
    return value.to_bytes(max(1, (value.bit_length() + 7) // 8), "big")


def number(data: bytes) -> int:
    """The value of a byte string, canonical or not."""
    return int.from_bytes(data, "big")


def parse(value: object, width: int, *, where: str) -> int:
    """The number that an app meant by `value`, checked against a width in bits.

    Takes an int, bool, bytes, or text: a number (decimal, 0x..), a MAC address, an IPv4 or IPv6
    address.  Raises `EntryError` naming `where`, the value and the reason.
    """
    if isinstance(value, (bool, int)):
        found = int(value)
    elif isinstance(value, bytes):
        found = number(value)
    elif isinstance(value, str):
        found = _parse_text(value.strip(), where)
    else:
        raise EntryError(f"{where}: {value!r} is not a number, text or bytes")
    if found < 0 or found >> width:
        raise EntryError(f"{where}: {value!r} does not fit into {width} bits")
    return found


def _parse_text(text: str, where: str) -> int:
    if _MAC.fullmatch(text):
        return int(re.sub("[:-]", "", text), 16)
    try:
        if "." in text or ":" in text:
            return int(ipaddress.ip_address(text))
        return int(text, 0)
    except ValueError:
        raise EntryError(f"{where}: {text!r} is not a number, MAC or IP address") from None


def is_ipv4(value: object) -> bool:
    """Whether text is an IPv4 address (its 32 bits are the low ones of a 128-bit field)."""
    if not isinstance(value, str):
        return False
    try:
        ipaddress.IPv4Address(value.strip())
    except ValueError:
        return False
    return True


def parse_prefix(value: object, length: object, width: int, *, where: str) -> tuple[int, int]:
    """Value and prefix length; that of an IPv4 address in a 128-bit field counts from bit 96.

    Raises `EntryError` for bits behind the prefix.
    """
    found = parse(value, width, where=where)
    bits = parse(length, 16, where=f"{where} prefix length")
    if width == ADDRESS_BITS and is_ipv4(value):
        if bits > _IPV4_BITS:
            raise EntryError(f"{where}: prefix length {bits} of {value!r} is over {_IPV4_BITS}")
        bits += ADDRESS_BITS - _IPV4_BITS
    if bits > width:
        raise EntryError(f"{where}: prefix length {bits} is over the width of {width} bits")
    if found & ((1 << (width - bits)) - 1):
        raise EntryError(f"{where}: {value!r} has bits beyond its prefix length {bits}; clear them")
    return found, bits


def prefix_pair(value: object, width: int) -> tuple[object, object]:
    """Address and prefix length of `[address, length]`, `10.0.0.0/8` or a bare (full) address."""
    if isinstance(value, (list, tuple)) and len(value) == 2:
        return value[0], value[1]
    if isinstance(value, str) and "/" in value:
        first, _, second = value.partition("/")
        return first, second
    return value, _IPV4_BITS if width == ADDRESS_BITS and is_ipv4(value) else width


def parse_masked(value: object, mask: object, width: int, *, where: str) -> tuple[int, int]:
    """Value and mask; an IPv4 mask in a 128-bit field covers the (zero) high bits too."""
    found = parse(value, width, where=where)
    bits = parse(mask, width, where=f"{where} mask")
    if width == ADDRESS_BITS and is_ipv4(mask) and bits:
        bits |= _HIGH_BITS
    if found & ~bits:
        raise EntryError(f"{where}: {value!r} has bits outside its mask {mask!r}; clear them")
    return found, bits


def shown(value: int, width: int) -> str:
    """A value as text: MAC and IP addresses by their width, else decimal; too wide a one, of a switch, as it is."""
    if value >> width:
        return hex(value)
    if width == MAC_BITS:
        return ":".join(f"{byte:02x}" for byte in value.to_bytes(6, "big"))
    if width == ADDRESS_BITS:
        if value >> _IPV4_BITS == 0:
            return str(ipaddress.IPv4Address(value))
        return str(ipaddress.IPv6Address(value))
    return str(value) if width <= _IPV4_BITS else hex(value)
