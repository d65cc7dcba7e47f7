"""Names on Kafka, and how its client is configured and its errors are told.

A topic carries what one app declares under one kind: the first three segments of a path, as in
`network.packets.p4runtime_ctrl`.  Record keys are whole paths, so that a path keeps its order in its partition.

    due.r.<three segments>   reliable paths         due.control          topics and readers, compacted
    due.b.<three segments>   best-effort paths      due.aside.<group>    payloads that were set aside
"""

import hashlib
import re
from collections.abc import Callable
from typing import Any, TypeVar
from urllib.parse import parse_qsl, urlsplit

import msgspec
from confluent_kafka import KafkaError, KafkaException

from due.errors import BackendError, InvalidOption, UpdatesUnavailable
from due.keys import ANY, ANY_NUMBER

_NAMESPACE = "due"
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
_SEGMENTS = 3
_LONGEST = 249
"""Most characters of a topic's name."""
_PORT = 9092
_MOST = {"partitions": 64, "replication": 16, "retention_hours": 87_600}
MOST_BYTES = 64 << 20
"""Largest payload, by the settings of our topics."""
TOO_EARLY = (
    KafkaError.NOT_LEADER_FOR_PARTITION,
    KafkaError.LEADER_NOT_AVAILABLE,
    KafkaError.UNKNOWN_TOPIC_OR_PART,
    KafkaError._UNKNOWN_PARTITION,  # noqa: SLF001 - the client's public names for its own errors
    KafkaError._UNKNOWN_TOPIC,  # noqa: SLF001
)
"""A topic that was made a moment ago, or whose broker has just died, answers so for a while."""

_T = TypeVar("_T")


class KafkaAddress(msgspec.Struct, frozen=True):
    """What a kafka:// URL says."""

    servers: str
    namespace: str = _NAMESPACE
    """Begins the names of topics and groups: one Kafka can serve several installations."""
    partitions: int = 4
    """Partitions of a topic of reliable paths."""
    replication: int = 0
    """Copies of each topic; 0: three, or as many as there are brokers."""
    retention_hours: int = 168
    """How long reliable payloads are kept, read or not; a group that is behind for longer loses some."""

    @property
    def control(self) -> str:
        """The topic that tells of topics and readers."""
        return f"{self.namespace}.control"

    def topic(self, path: str, *, reliable: bool) -> str:
        """The topic that carries a path."""
        name = f"{self.namespace}.{'r' if reliable else 'b'}.{topic_prefix(path)}"
        if len(name) <= _LONGEST:
            return name
        return name[: _LONGEST - 41] + "-" + hashlib.sha1(name.encode(), usedforsecurity=False).hexdigest()

    def is_reliable(self, topic: str) -> bool:
        """Whether a topic carries reliable paths."""
        return topic.startswith(f"{self.namespace}.r.")

    def aside(self, group: str) -> str:
        """The topic of what a group has set aside."""
        return f"{self.namespace}.aside.{group}"

    def group(self, group: str) -> str:
        """The group's id on Kafka."""
        return f"{self.namespace}.{group}"

    def client(self, **settings: Any) -> dict[str, Any]:
        """The configuration of a client of these brokers."""
        return {
            "bootstrap.servers": self.servers,
            "client.id": "due",
            "log_level": 2,
            "reconnect.backoff.ms": 50,
            "reconnect.backoff.max.ms": 1000,
            "topic.metadata.refresh.interval.ms": 5000,
            **settings,
        }


def parse_kafka_url(url: str) -> KafkaAddress:
    """Read kafka://HOST[:PORT][,HOST…][/NAMESPACE][?partitions=N&replication=N&retention_hours=N].

    Args:
        url: the URL.

    Returns:
        What it says.

    Raises:
        InvalidOption: it says something else; the message names the part that is wrong.
    """
    parts = urlsplit(url)
    namespace = parts.path.strip("/") or _NAMESPACE
    if parts.scheme != "kafka" or not parts.netloc or not _NAME.fullmatch(namespace) or parts.fragment:
        raise InvalidOption(
            f"URL {url!r}: write kafka://HOST:PORT[,HOST:PORT…][/NAMESPACE][?partitions=N&replication=N&retention_hours=N]"
        )
    if "@" in parts.netloc:
        raise InvalidOption(
            "a kafka:// URL takes no user and password: brokers that want them are not supported yet"
        )
    servers = []
    for server in parts.netloc.split(","):
        host, colon, port = server.rpartition(":")
        if colon and not (host and port.isdecimal() and 0 < int(port) < 65536):
            raise InvalidOption(f"URL {url!r}: {server!r} is not HOST:PORT")
        servers.append(server if colon else f"{server}:{_PORT}")
    options = {}
    for name, text in parse_qsl(parts.query, keep_blank_values=True):
        if name not in _MOST or not text.isdecimal() or not 1 <= int(text) <= _MOST[name]:
            most = ", ".join(f"{known} (1 to {limit})" for known, limit in _MOST.items())
            raise InvalidOption(f"URL {url!r}: {name}={text} is not one of {most}")
        options[name] = int(text)
    return KafkaAddress(",".join(servers), namespace, **options)


def topic_prefix(path: str) -> str:
    """The segments that paths of one topic share."""
    return ".".join(path.split(".")[:_SEGMENTS])


def may_hold(prefix: str, pattern: str) -> bool:
    """Whether some path that begins with these segments can match a key's pattern."""
    wanted = pattern.split(".")
    have = prefix.split(".")
    for place, segment in enumerate(have):
        if place >= len(wanted):
            return False
        if wanted[place] == ANY_NUMBER:
            return True
        if wanted[place] not in (ANY, segment):
            return False
    return len(have) == _SEGMENTS or wanted[len(have) :] in ([], [ANY_NUMBER])


def translated(call: Callable[[], _T], what: str) -> _T:
    """Call Kafka's client; its errors become ours.

    Raises:
        UpdatesUnavailable: the same call may succeed later.
        BackendError: the brokers refused it.
    """
    try:
        return call()
    except TimeoutError:
        raise UpdatesUnavailable(f"{what}: no answer in time") from None
    except KafkaException as error:
        cause = error.args[0]
        if isinstance(cause, KafkaError) and not (
            cause.retriable() or cause.code() < 0 or cause.code() in TOO_EARLY
        ):
            raise BackendError(f"{what}: {cause.str()}") from None
        raise UpdatesUnavailable(f"{what}: {cause}") from None
