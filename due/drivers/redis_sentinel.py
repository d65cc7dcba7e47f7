"""Where the primary is: `redis+sentinel://` URLs, and the sentinels that know.

    redis+sentinel://[USER:PASSWORD@]HOST:PORT,HOST:PORT,…/SERVICE[/DB][?min_replicas=1]     rediss+…: TLS to all of them

User and password are for the servers; the sentinels are asked without.
"""

import re
import threading
from typing import Any, cast
from urllib.parse import parse_qsl, unquote

import msgspec
import redis
from redis.backoff import NoBackoff
from redis.retry import Retry
from redis.sentinel import MasterNotFoundError, Sentinel

from due.errors import InvalidOption
from due.logs import without_passwords

SCHEMES = ("redis+sentinel://", "rediss+sentinel://")
SCHEME_TLS = SCHEMES[1]
_PORT = 26379
_SERVICE = re.compile(r"[A-Za-z0-9._-]+")
_HOSTNAME = re.compile(r"[A-Za-z0-9._:%-]{1,255}")
_MOST_SENTINELS = 16
_MOST_REPLICAS = 16
_SENTINEL_SECONDS = 1.0
"""An answer of one sentinel; then the next one is asked."""
_REPLICAS = "min_replicas"
_TLS_OPTIONS = ("ssl_ca_certs", "ssl_certfile", "ssl_keyfile", "ssl_cert_reqs")


class SentinelAddress(msgspec.Struct, frozen=True, kw_only=True):
    """What a URL says."""

    sentinels: tuple[tuple[str, int], ...]
    service: str
    """The name under which the sentinels know the primary."""
    login: dict[str, Any]
    """User, password and database, as redis-py names them."""
    tls: dict[str, Any] | None
    """Options of redis-py for TLS; None: without TLS."""
    min_replicas: int
    """How many replicas must have an entry before it counts as acknowledged."""


def is_sentinel(url: str) -> bool:
    """Whether a URL names sentinels."""
    return url.startswith(SCHEMES)


def parse_sentinel_url(url: str) -> SentinelAddress:
    """What a URL says; raises `InvalidOption`."""
    try:
        return _parsed(url)
    except ValueError as error:
        raise InvalidOption(f"Data Updates URL {without_passwords(url)!r}: {error}") from None


def least_replicas(url: str) -> int:
    """How many replicas must confirm what is sent to this URL; 0 where it names no sentinels."""
    return parse_sentinel_url(url).min_replicas if is_sentinel(url) else 0


def _parsed(url: str) -> SentinelAddress:
    rest, _, query = url.partition("://")[2].partition("?")
    place, _, path = rest.partition("/")
    login, _, hosts = place.rpartition("@")
    service, _, database = path.partition("/")
    if not _SERVICE.fullmatch(service):
        raise ValueError("name the service behind the sentinels: …HOST:PORT/SERVICE")
    if database and not _number(database):
        raise ValueError(f"{database!r} is not the number of a database")
    sentinels = tuple(map(_host, hosts.split(",")))
    if len(sentinels) > _MOST_SENTINELS:
        raise ValueError(f"{len(sentinels)} sentinels: give at most {_MOST_SENTINELS}")
    options = dict(parse_qsl(query, strict_parsing=True)) if query else {}
    replicas = _replicas(options.pop(_REPLICAS, "1"))
    user, _, password = login.partition(":")
    named = {"username": unquote(user), "password": unquote(password), "db": int(database or 0)}
    return SentinelAddress(
        sentinels=sentinels,
        service=service,
        login={name: value for name, value in named.items() if value},
        tls=_tls(options, wanted=url.startswith(SCHEME_TLS)),
        min_replicas=replicas,
    )


def _host(text: str) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if not colon or text.endswith("]"):
        host, port = text, str(_PORT)
    host = host.removeprefix("[").removesuffix("]")
    if not _HOSTNAME.fullmatch(host) or not _number(port) or not 0 < int(port) < 65536:
        raise ValueError(f"{text!r} is not HOST:PORT of a sentinel")
    return host, int(port)


def _number(text: str) -> bool:
    return text.isascii() and text.isdecimal() and len(text) <= 5


def _replicas(text: str) -> int:
    if not _number(text) or int(text) > _MOST_REPLICAS:
        raise ValueError(f"{_REPLICAS}={text!r}: must be 0 to {_MOST_REPLICAS}")
    return int(text)


def _tls(options: dict[str, str], *, wanted: bool) -> dict[str, Any] | None:
    known = _TLS_OPTIONS if wanted else ()
    strange = sorted(options.keys() - set(known))
    if strange:
        raise ValueError(f"option {strange[0]!r} is unknown; known are {', '.join((_REPLICAS, *known))}")
    return options if wanted else None


class Sentinels(Sentinel):
    """redis-py's, for several threads; asks each sentinel once, because its callers try again themselves."""

    def __init__(self, address: SentinelAddress) -> None:
        tls = {} if address.tls is None else {"ssl": True, **address.tls}
        own: dict[str, Any] = {
            "protocol": 2,
            "socket_timeout": _SENTINEL_SECONDS,
            "socket_connect_timeout": _SENTINEL_SECONDS,
            "retry": Retry(NoBackoff(), 0),
            **tls,
        }
        cast("Any", super()).__init__(address.sentinels, sentinel_kwargs=own)
        self._asking = threading.Lock()

    def discover_master(self, service_name: str) -> tuple[str, int]:
        """Host and port of the primary; raises redis.RedisError."""
        with self._asking:  # it moves who answered to the front
            try:
                return _place(*cast("Any", super()).discover_master(service_name))
            except MasterNotFoundError:
                raise redis.ConnectionError(
                    f"no sentinel that answers knows a primary of {service_name!r} that is up"
                ) from None
            except (ValueError, TypeError, LookupError, AttributeError, StopIteration) as error:
                raise redis.ConnectionError(f"a sentinel's answer is not understood: {error!r}") from None


def _place(host: Any, port: Any) -> tuple[str, int]:
    if not _HOSTNAME.fullmatch(host) or not 0 < port < 65536:
        raise ValueError(f"{host!r:.60}, {port!r:.20}")
    return str(host), int(port)


class ClientOfPrimary(redis.Redis):
    """A client that asks the sentinels again with each connection that it opens, and closes theirs, too."""

    def close(self) -> None:
        """Close all connections."""
        super().close()
        cast("Any", self.connection_pool).sentinel_manager.close()


def primary_client(url: str, **connection: Any) -> redis.Redis:
    """A client of the primary; raises `InvalidOption` for a wrong URL."""
    address = parse_sentinel_url(url)
    tls = {} if address.tls is None else {"ssl": True, **address.tls}
    made: redis.Redis = cast("Any", Sentinels(address)).master_for(
        address.service, redis_class=ClientOfPrimary, **address.login, **tls, **connection
    )
    return made


def primary_pool(address: SentinelAddress, **connection: Any) -> tuple[redis.ConnectionPool, str]:
    """Where connections to today's primary come from, and its HOST:PORT; raises redis.RedisError, OSError."""
    sentinels = Sentinels(address)
    try:
        host, port = sentinels.discover_master(address.service)
    finally:
        sentinels.close()
    pool = redis.ConnectionPool(
        connection_class=redis.Connection if address.tls is None else redis.SSLConnection,
        host=host,
        port=port,
        **address.login,
        **(address.tls or {}),
        **connection,
    )
    return pool, f"{host}:{port}"
