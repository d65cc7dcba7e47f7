"""Names on Kafka, and how its client is configured and its errors are told.

A topic carries what one app declares under one kind: the first three segments of a path, the third first, as in
`p4runtime_ctrl.network.packets`: so an app's topics have names that begin alike, and rights can be given by that.
Record keys are whole paths, so that a path keeps its order in its partition.

    due.r.<three segments>   reliable paths         due.control.<app>    its topics and readers, compacted
    due.b.<three segments>   best-effort paths      due.aside.<group>    payloads that were set aside
"""

import hashlib
import re
from collections.abc import Callable
from typing import Any, TypeVar
from urllib.parse import parse_qsl, unquote, urlsplit

import msgspec
from confluent_kafka import KafkaError, KafkaException
from msgspec import structs

from due.codec import MAX_PAYLOAD
from due.errors import BackendError, InvalidOption, UpdatesUnavailable
from due.keys import ANY, ANY_NUMBER
from due.logs import without_passwords

_NAMESPACE = "due"
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
_SEGMENTS = 3
_LONGEST = 249
"""Most characters of a topic's name."""
_PORT = 9092
_MOST = {"partitions": 64, "replication": 16, "retention_hours": 87_600}
_TEXTS = ("mechanism", "ssl_ca_certs", "ssl_certfile", "ssl_keyfile")
_MECHANISMS = ("SCRAM-SHA-512", "SCRAM-SHA-256", "PLAIN")
SCHEMES = ("kafka", "kafkas")
"""The second: over TLS."""
MOST_BYTES = MAX_PAYLOAD + (64 << 10)
"""Largest record, by the settings of our topics: a frame, its key, and what Kafka adds."""
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
    user: str = ""
    """Empty: the brokers want none."""
    password: str = ""
    mechanism: str = _MECHANISMS[0]
    """How the password is shown; with PLAIN only over TLS."""
    tls: bool = False
    ssl_ca_certs: str = ""
    """File with the CA of the brokers; empty: those that the system trusts."""
    ssl_certfile: str = ""
    """File with our certificate, where brokers want one."""
    ssl_keyfile: str = ""

    @property
    def controls(self) -> str:
        """What the names of topics that tell of topics and readers begin with."""
        return f"{self.namespace}.control."

    def control(self, app: str) -> str:
        """The topic that tells of an app's topics and readers."""
        return self.controls + app

    def topic(self, path: str, *, reliable: bool) -> str:
        """The topic that carries a path."""
        first, second, third = (*path.split(".", _SEGMENTS)[:_SEGMENTS], "", "")[:_SEGMENTS]
        name = f"{self.namespace}.{'r' if reliable else 'b'}.{third}.{first}.{second}".rstrip(".")
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
            **self._security(),
            **settings,
        }

    def _security(self) -> dict[str, str]:
        """How the brokers know us, and we them."""
        found = {
            "security.protocol": ("SASL_" if self.user else "") + ("SSL" if self.tls else "PLAINTEXT"),
            "ssl.ca.location": self.ssl_ca_certs,
            "ssl.certificate.location": self.ssl_certfile,
            "ssl.key.location": self.ssl_keyfile,
        }
        if self.user:
            names = {"mechanism": self.mechanism, "username": self.user, "password": self.password}
            found |= {f"sasl.{name}": text for name, text in names.items()}
        return {name: text for name, text in found.items() if text}


def parse_kafka_url(url: str) -> KafkaAddress:
    """Read kafka[s]://[USER:PASSWORD@]HOST[:PORT][,HOST…][/NAMESPACE][?OPTION=…&…].

    Args:
        url: the URL; options are partitions, replication, retention_hours, mechanism, and of `kafkas`
            ssl_ca_certs, ssl_certfile, ssl_keyfile.

    Returns:
        What it says.

    Raises:
        InvalidOption: it says something else; the message names the part that is wrong.
    """
    shown = without_passwords(url)
    parts = urlsplit(url)
    namespace = parts.path.strip("/") or _NAMESPACE
    if parts.scheme not in SCHEMES or not parts.netloc or not _NAME.fullmatch(namespace) or parts.fragment:
        raise InvalidOption(
            f"URL {shown!r}: write kafka://HOST:PORT[,HOST:PORT…][/NAMESPACE][?partitions=N&replication=N&retention_hours=N]"
        )
    tls = parts.scheme == "kafkas"
    credential, _, hosts = parts.netloc.rpartition("@")
    user, colon, password = credential.partition(":")
    if credential and not (user and colon and password):
        raise InvalidOption(f"URL {shown!r}: write USER:PASSWORD before the @")
    servers = []
    for server in hosts.split(","):
        host, colon, port = server.rpartition(":")
        if (colon and not (host and port.isdecimal() and 0 < int(port) < 65536)) or not server:
            raise InvalidOption(f"URL {shown!r}: {server!r} is not HOST:PORT")
        servers.append(server if colon else f"{server}:{_PORT}")
    numbers, texts = _options(shown, parts.query, tls=tls)
    if texts.get("mechanism") == "PLAIN" and not tls:
        raise InvalidOption(f"URL {shown!r}: PLAIN shows the password to whoever listens: use kafkas://")
    address = KafkaAddress(
        ",".join(servers), namespace, user=unquote(user), password=unquote(password), tls=tls
    )
    return structs.replace(address, **numbers, **texts)


def _options(shown: str, query: str, *, tls: bool) -> tuple[dict[str, int], dict[str, str]]:
    numbers, texts = {}, {}
    for name, text in parse_qsl(query, keep_blank_values=True):
        if name in _TEXTS:
            if not text or (name == "mechanism" and text not in _MECHANISMS):
                wanted = f"one of {', '.join(_MECHANISMS)}" if name == "mechanism" else "the name of a file"
                raise InvalidOption(f"URL {shown!r}: {name}={text}: must be {wanted}")
            if name.startswith("ssl_") and not tls:
                raise InvalidOption(f"URL {shown!r}: {name} belongs to kafkas://, which is over TLS")
            texts[name] = text
        elif name not in _MOST or not text.isdecimal() or not 1 <= int(text) <= _MOST[name]:
            most = ", ".join(f"{known} (1 to {limit})" for known, limit in _MOST.items())
            raise InvalidOption(f"URL {shown!r}: {name}={text} is not one of {most}, {', '.join(_TEXTS)}")
        else:
            numbers[name] = int(text)
    return numbers, texts


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


def is_denied(error: Exception) -> bool:
    """Whether the brokers refused something for want of a right."""
    return "AUTHORIZATION_FAILED" in str(error) or "uthorization failed" in str(error)


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
