"""Rights of one user of Kafka: from key patterns to the access-control entries of its brokers.  Pure.

    publish network.x.mine.**   ─►  WRITE, CREATE  due.b.mine.network.x, due.r.mine.network.x
    publish network.*.mine.**   ─►  WRITE, CREATE  due.b.mine.network.…, due.r.mine.network.…
    observe network.y.*.*       ─►  READ           due.b.<app>.network.y, … of every app that publishes
    its own                     ─►  due.control.<app>, due.aside.<app>, positions of the groups due.<app>, due.<app>:…

Rights end at a key's third segment, as topics do: a grant of `a.b.c.d` gives all of `a.b.c`.  Brokers know names and
beginnings of names only, so where the third segment is open it stands for the apps of the other rights; where the
first is open and the second is not, nothing is given.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from due.drivers.base import own_group
from due.drivers.kafka_names import KafkaAddress
from due.drivers.redis_rights import EVERYTHING, Rights, with_membership
from due.keys import ANY, ANY_NUMBER, Key

_SEGMENTS = 3
_ALL = ("READ", "WRITE", "CREATE", "DESCRIBE")


class KafkaRight(NamedTuple):
    """One access-control entry, but for its user."""

    resource: str
    """TOPIC or GROUP."""
    name: str
    begins: bool
    """Whether this is how names begin, or the whole name."""
    operation: str


def publishers(all_rights: Iterable[Rights]) -> tuple[str, ...]:
    """Third segments of what anybody may publish."""
    found = set()
    for rights in all_rights:
        for pattern in with_membership(rights)[0]:
            segments = Key.parse(pattern).segments
            found |= set(segments[_SEGMENTS - 1 : _SEGMENTS]) - {ANY, ANY_NUMBER}
        found |= {rights.app} - {ANY}
    return tuple(sorted(found))


def kafka_rights(rights: Rights, address: KafkaAddress, apps: Sequence[str]) -> set[KafkaRight]:
    """The entries of one user.

    Args:
        rights: what it may say and see.
        address: whose namespace the names begin with.
        apps: for an open third segment: see `publishers`.
    """
    publish, observe = with_membership(rights)
    found = {
        KafkaRight("TOPIC", name, begins, operation)
        for patterns, operations in ((publish, _ALL[1:]), (observe, ("READ", "DESCRIBE")))
        for pattern in patterns
        for name, begins in topics(pattern, address, apps)
        for operation in operations
    }
    anything = rights.app == ANY
    for name in (address.control(rights.app), address.aside(rights.app)):
        found |= {KafkaRight("TOPIC", name.removesuffix(ANY), anything, one) for one in _ALL}
    found |= {KafkaRight("TOPIC", address.controls, True, one) for one in ("READ", "DESCRIBE")}
    # where its own groups are, and that of readers of control topics, which never store a position
    own = address.group(rights.app).removesuffix(ANY)
    found |= {
        KafkaRight("GROUP", own, anything, "READ"),
        KafkaRight("GROUP", address.group("control."), False, "READ"),
    }
    if not anything:
        found.add(KafkaRight("GROUP", address.group(own_group(rights.app, "")), True, "READ"))
    # how far other groups are
    found.add(KafkaRight("GROUP", address.group(""), True, "DESCRIBE"))
    return found


def topics(pattern: str, address: KafkaAddress, apps: Sequence[str]) -> Iterator[tuple[str, bool]]:
    """Names of topics, and beginnings of names, that carry paths of a pattern and, up to the third segment, no others."""
    path = Key.parse(pattern).path
    for kind in ("b", "r"):
        start = f"{address.namespace}.{kind}."
        if path == EVERYTHING:
            yield start, True
            continue
        for name, begins in _names(path.split("."), apps):
            yield start + name, begins


def _names(segments: Sequence[str], apps: Sequence[str]) -> Iterator[tuple[str, bool]]:
    """Third segment first; see `KafkaAddress.topic`."""
    any_number = segments[-1] == ANY_NUMBER
    fixed = segments[:-1] if any_number else segments
    if any_number or len(fixed) < _SEGMENTS:
        yield from _short(fixed, any_number=any_number)
    if len(fixed) < _SEGMENTS and not any_number:
        return
    first, second, third = (*fixed, *(ANY,) * _SEGMENTS)[:_SEGMENTS]
    for app in apps if third == ANY else (third,):
        if ANY not in (first, second):
            yield f"{app}.{first}.{second}", False
        elif first != ANY:
            yield f"{app}.{first}.", True
        elif second == ANY:
            yield f"{app}.", True


def _short(fixed: Sequence[str], *, any_number: bool) -> Iterator[tuple[str, bool]]:
    """Paths of fewer than three segments."""
    if len(fixed) >= _SEGMENTS or ANY in fixed or not fixed:
        return
    yield "." + ".".join(fixed), False
    if any_number and len(fixed) == 1:
        yield f".{fixed[0]}.", True
