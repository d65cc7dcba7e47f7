"""Random entries and frames, from a seed: what the twin and sameness tests feed to two switches."""

from collections.abc import Callable
from random import Random

from dataplane.v1model.tables import Exact, Lpm, Match, MatchValue, Optional, Range, TableEntry, Ternary
from dataplane.v1model.tree import ActionSpec, KeySpec, MatchKind, TableSpec

Maker = Callable[[Random], bytes]
_COMMON = (0x0A000001, 0x0A000002, 80, 443, 6, 17, 0, 1, 2, 3, 4, 0x800, 0x020000000001)


def ethernet(etype: int, payload: bytes) -> bytes:
    """A frame between two fixed addresses, with an EtherType."""
    return bytes.fromhex("020000000002 020000000001") + etype.to_bytes(2, "big") + payload


def frame(
    what: int, a: int = 0, b: int = 0, c: int = 0, d: int = 0, e: int = 0, *, rest: bytes = b""
) -> bytes:
    """A frame of features.p4's own type; the header is 20 bytes behind Ethernet."""
    parts = [(what, 1), (a, 1), (b, 1), (c, 2), (d, 4), (e, 8), (0, 2)]
    return ethernet(0x88B5, b"".join(v.to_bytes(n, "big") for v, n in parts) + rest)


class Chooser:
    """Values that meet: entries and frames draw from one pool."""

    def __init__(self, seed: int) -> None:
        self.random = Random(seed)
        self.pool = [self.random.getrandbits(128) for _ in range(8)] + list(_COMMON)

    def value(self, width: int) -> int:
        """A value of so many bits, often one that others have as well."""
        full = (1 << width) - 1
        chance = self.random.random()
        if chance < 0.5:
            return self.random.choice(self.pool) & full
        return self.random.randint(0, 4) & full if chance < 0.85 else self.random.getrandbits(width)

    def params(self, action: ActionSpec) -> tuple[int, ...]:
        """A value for each parameter."""
        return tuple(self.value(p.width) for p in action.params)

    def match(self, key: KeySpec, *, optional: bool = False) -> MatchValue:
        """What an entry asks of one key; `optional`: nothing at all in four of ten."""
        full = (1 << key.width) - 1
        value = self.value(key.width)
        if key.kind is MatchKind.EXACT:
            return Exact(value)
        if key.kind is MatchKind.LPM:
            length = min(self.random.choice([0, 8, 24, 32, self.random.randint(0, key.width)]), key.width)
            return Lpm(value & (full ^ (full >> length)), length)
        if optional or key.kind is MatchKind.OPTIONAL:
            anything = self.random.random() < 0.4
            if key.kind is MatchKind.OPTIONAL:
                return Optional(None if anything else value)
            return Ternary(0, 0) if anything else Ternary(value, full)
        if key.kind is MatchKind.TERNARY:
            prefix = full ^ (full >> self.random.randint(0, key.width))
            mask = self.random.choice([0, 0, full, full, prefix, self.random.getrandbits(key.width)])
            return Ternary(value & mask, mask)
        low, high = sorted((value, self.random.getrandbits(key.width)))
        return Range(low, high) if self.random.random() < 0.7 else Range(0, full)

    def entry(self, spec: TableSpec, number: int, actions: list[ActionSpec] | None = None) -> TableEntry:
        """Priorities differ: what wins at equal ones is nobody's promise."""
        action = self.random.choice(actions or list(spec.actions))
        match: Match = tuple(self.match(key) for key in spec.keys)
        priority = self.random.randint(1, 5) * 1000 + number if spec.needs_priority else 0
        return TableEntry(match, action.name, self.params(action), priority)

    def spoil(self, data: bytes) -> bytes:
        """Now and then some bytes flipped, or the end cut off."""
        spoiled = bytearray(data)
        if spoiled and self.random.random() < 0.3:
            for _ in range(self.random.randint(1, 4)):
                spoiled[self.random.randrange(len(spoiled))] = self.random.getrandbits(8)
            if self.random.random() < 0.3:
                del spoiled[self.random.randrange(len(spoiled) + 1) :]
        return bytes(spoiled)


def feature_frame(random: Random) -> bytes:
    """A frame for features.p4."""
    kind = random.random()
    if kind < 0.6:
        return _test_frame(random)
    if kind < 0.75:
        return _ipv4_frame(random)
    if kind < 0.9:
        count = random.randint(1, 4)
        labels = [random.randint(1, 5) << 12 | random.getrandbits(3) << 9 for _ in range(count)]
        labels[-1] |= 1 << 8
        return ethernet(0x88B6, b"".join(label.to_bytes(4, "big") for label in labels) + b"payload")
    return ethernet(0x9000 + random.randint(0, 5), b"\x12\x34" + random.randbytes(random.randint(0, 20)))


def _test_frame(random: Random) -> bytes:
    what = random.randint(0, 21)
    # more rounds of recirculation grow exponentially where a table floods
    a = random.randint(0, 2) if what == 18 else random.choice([0, 1, 2, 3, 5, 7, 9, 60, 255])
    rest = random.randbytes({7: 9, 8: 144}.get(what, random.randint(0, 60)))
    c, d = random.choice([0, 1, random.getrandbits(16)]), random.choice([0, 5, random.getrandbits(32)])
    return frame(what, a, random.getrandbits(8), c, d, random.getrandbits(64), rest=rest)


def _ipv4_frame(random: Random) -> bytes:
    ihl = random.choice([5, 5, 6, 8, 15, 4])
    addresses = bytes([10, 0, 0, random.randint(1, 2), 10, 0, 0, random.randint(1, 3)])
    rest = random.randbytes(max(0, 4 * ihl - 20) + random.randint(0, 20))
    return ethernet(0x0800, bytes([0x40 | ihl, 0]) + random.randbytes(10) + addresses + rest)


def network_frame(random: Random) -> bytes:
    """A frame as hosts send them, for the programs that parse networks."""
    ends = bytes([2, 0, 0, 0, 0, random.randint(1, 3), 2, 0, 0, 0, 0, random.randint(1, 3)])
    tag = b"\x81\0\0" + bytes([random.randint(1, 3)]) if random.random() < 0.2 else b""
    source, target = (bytes([10, 0, 0, random.randint(1, 4)]) for _ in range(2))
    kind = random.random()
    if kind < 0.7:
        return ends + tag + b"\x08\0" + _ipv4(random, source, target)
    if kind < 0.85:
        protocol, body = _transport(random, source, target)
        extension = bytes([protocol, 0]) + bytes(6) if random.random() < 0.3 else b""
        following = 0 if extension else 58 if protocol == 1 else protocol
        body = extension + body
        head = b"\x60\0\0\0" + len(body).to_bytes(2, "big") + bytes([following, 64])
        return ends + tag + b"\x86\xdd" + head + bytes(12) + source + bytes(12) + target + body
    return ends + tag + b"\x08\x06\0\1\x08\0\6\4\0\1" + ends[6:] + source + bytes(6) + target


def _ipv4(random: Random, source: bytes, target: bytes) -> bytes:
    protocol, body = _transport(random, source, target)
    options = b"\7\4\0\0" if random.random() < 0.15 else b""
    fragment = random.choice([0, 0, 0, 0x4000, 0x2000, 5])
    total = 20 + len(options) + len(body)
    head = bytes([0x45 + len(options) // 4, 0]) + total.to_bytes(2, "big") + b"\0\1"
    return head + fragment.to_bytes(2, "big") + bytes([64, protocol, 0, 0]) + source + target + options + body


def _transport(random: Random, source: bytes, target: bytes) -> tuple[int, bytes]:
    ports = random.randint(1, 100).to_bytes(2, "big") + random.choice([80, 443, 22, 53]).to_bytes(2, "big")
    payload = b"z" * random.randint(0, 40)
    kind = random.random()
    if kind < 0.6:
        flags = random.choice([0x02, 0x12, 0x10, 0x04, 0x18, 0xC2])
        numbers = random.choice([1, 2, 77]).to_bytes(4, "big") + bytes(4)
        return 6, ports + numbers + bytes([0x50, flags]) + b"\x20\0\0\0\0\0" + payload
    if kind < 0.8:
        return 17, ports + (8 + len(payload)).to_bytes(2, "big") + b"\0\0" + payload
    quoted = b"\x45\0\0\x1c\0\0\0\0\x40\x11\0\0" + target + source + ports[::-1] + bytes(4)
    return 1, bytes([random.choice([0, 3, 8, 11]), 0]) + bytes(6) + quoted
