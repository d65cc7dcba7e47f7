"""Rights of one user of a Redis-protocol server: from key patterns to the rules of `ACL SETUSER`.  Pure.

    publish a.b.*  ─►  PUBLISH due:a.b.* │ XADD … due:stream:a.b.* │ who reads it, and how far they are
    observe c.**   ─►  (P)SUBSCRIBE due:c, due:c.* │ XREAD … due:stream:c, due:stream:c.* │ SADD due:readers:c …
    its own        ─►  due:work:<app>:*, due:lease:<app>:*, due:poison:<app>, due:streams:<app>, due:wake:<app>,
                       and the same of its instances: <app>:<instance>; its membership's channels

Who observes writes nothing on a stream: how far a group is stands in its own list.

Each line is a selector: a command passes only where one selector allows both the command and everything it names.
In the server's patterns `*` also stands for dots, so that `a.*.c` gives `a.b.b.c`, too.
"""

from collections.abc import Iterable, Sequence

import msgspec

from due.drivers.base import own_group
from due.drivers.redis_leases import lease_name
from due.drivers.redis_streams import (
    PRODUCERS,
    announced_name,
    readers_name,
    stream_name,
    wake_name,
    work_name,
)
from due.keys import ANY, ANY_NUMBER, Key

EVERYTHING = "**"
# not CLIENT SETINFO, which Redis 7.0 does not know: a rule that names it would be refused there
_CONNECTION = [
    "+ping",
    "+time",
    "+info",
    "+wait",
    "+select",
    "+multi",
    "+exec",
    "+discard",
    "+unwatch",
    "+unsubscribe",
    "+punsubscribe",
    "+client|id",
    "+client|reply",
    "+client|setname",
]
_WRITES_STREAM = ["+xadd", "+expire", "+xtrim", "+exists", "+xlen", "+xgroup|create", "+xgroup|destroy"]
_KNOWS_READERS = ["+srandmember", "+srem", "+expire"]
_READS_STREAM = ["+xread", "+xrange", "+exists", "+xinfo|stream", "+xinfo|groups", "+xpending"]
_OWN_WORK = [
    *("+xadd", "+xreadgroup", "+xack", "+xdel", "+xclaim", "+xpending", "+xsetid", "+watch", "+exists"),
    *("+xinfo|consumers", "+xinfo|stream", "+xgroup|create", "+xgroup|delconsumer", "+expire", "+del"),
]
_OWN_LEASES = ["+hset", "+hget", "+hdel", "+hexists", "+hgetall", "+expire", "+watch"]
_OWN_ASIDE = ["+xadd", "+xrange", "+xtrim", "+xlen", "+expire", "+memory|usage"]
_OWN_ANNOUNCEMENTS = ["+zadd", "+zremrangebyscore", "+expire"]


class Rights(msgspec.Struct, frozen=True, kw_only=True):
    """What one app may say and see."""

    app: str
    """Its id; `*`: any, for those who may use every id."""
    publish: tuple[str, ...] = ()
    """Key patterns; specs do not count."""
    observe: tuple[str, ...] = ()
    read: tuple[str, ...] = ()
    """Key patterns to read from Data Archives, beside what it wrote itself; nothing of it is for this server."""


def channel_globs(pattern: str) -> tuple[str, ...]:
    """The paths of a key pattern as the server's patterns; those without `*` are exact."""
    path = Key.parse(pattern).path
    if path == ANY_NUMBER:
        return (ANY,)
    if path.endswith(f".{ANY_NUMBER}"):
        before = path.removesuffix(f".{ANY_NUMBER}")
        return (before, f"{before}.{ANY}")
    return (path,)


def granted_for(pattern: str, granted: Sequence[str]) -> tuple[str, ...]:
    """The granted patterns through which an observer of `pattern` receives what it may.

    A server lets nobody subscribe to a pattern that is not literally among the granted ones.
    """
    wanted = Key.parse(pattern)
    if wanted.exact_path or not granted or EVERYTHING in granted:
        return (pattern,)
    for one in granted:
        if covers(one, pattern):
            return (one,)
    paths = Key.parse(wanted.path)
    return tuple(one for one in granted if Key.parse(Key.parse(one).path).offers(paths)) or (pattern,)


def covers(wide: str, narrow: str) -> bool:
    """Whether every path of `narrow` is one of `wide`."""
    left, right = Key.parse(wide).segments, Key.parse(narrow).segments
    for place, segment in enumerate(left):
        if segment == ANY_NUMBER:
            return True
        if place == len(right):
            return left[place:] == (ANY_NUMBER,)
        if right[place] == ANY_NUMBER or segment not in (ANY, right[place]):
            return False
    return len(left) == len(right)


def with_membership(rights: Rights) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What an app may publish and observe, with its own registration, heartbeats and assignments."""
    own = rights.app
    told = (f"due.{kind}.{own}" for kind in ("registration", "heartbeat", "health"))
    # from each other's heartbeats the instances of an app learn who works
    return (*rights.publish, *told), (*rights.observe, f"due.assignment.{own}", f"due.heartbeat.{own}")


def acl_rules(rights: Rights) -> list[str]:
    """The rules of `ACL SETUSER` after name and password; they replace all earlier ones.

    The server tries one selector after the other: those for the commands of every message come first, and of those that
    allow a command the one with the fewest patterns.
    """
    own = rights.app
    wakes = [wake_name(own), wake_name(own_group(own, ANY))]
    told, heard = with_membership(rights)
    publish, observe = _globs(told), _globs(heard)
    return [
        *("resetkeys", "resetchannels", "clearselectors", "-@all", *_CONNECTION),
        _selector(_OWN_WORK, [f"~{work_name(own, '*')}"]),
        _selector(["+publish"], _channels((*publish, f"streams:{own}"))),
        _selector(_WRITES_STREAM, _keys("~", map(stream_name, publish))),
        _selector(["+hgetall"], _keys("%R~", (lease_name("*", path) for path in publish))),
        _selector(["+xinfo|groups", "+xpending"], _keys("%R~", (work_name("*", path) for path in publish))),
        _selector(_KNOWS_READERS, _keys("~", map(readers_name, publish))),
        _selector(["+subscribe", "+psubscribe"], _channels((*observe, "streams:*"))),
        _selector(_READS_STREAM, _keys("%R~", (*map(stream_name, observe), *wakes))),
        _selector(["+sadd"], _keys("~", map(readers_name, observe))),
        _selector(["+xadd", "+expire"], _keys("~", wakes)),
        _selector(_OWN_LEASES, [f"~{lease_name(own, '*')}"]),
        _selector(_OWN_ASIDE, [f"~due:poison:{own}"]),
        _selector(_OWN_ANNOUNCEMENTS, [f"~{announced_name(own)}"]),
        _selector(["+sadd"], [f"~{PRODUCERS}"]),
        _selector(["+smembers", "+zrange"], [f"%R~{PRODUCERS}", f"%R~{announced_name('*')}"]),
    ]


def _globs(patterns: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(glob for pattern in patterns for glob in channel_globs(pattern)))


def _selector(commands: Sequence[str], places: Sequence[str]) -> str:
    return f"({' '.join((*commands, *places))})"


def _channels(paths: Iterable[str]) -> list[str]:
    found = list(paths)
    # only with all channels a pattern may be subscribed to that is not literally here
    return ["allchannels"] if ANY in found else [f"&due:{path}" for path in found]


def _keys(mark: str, names: Iterable[str]) -> list[str]:
    return [f"{mark}{name}" for name in names]
