"""Events as syslog messages: RFC 5424 over UDP (RFC 5426), TCP (RFC 6587, octet counting) or TLS (RFC 5425).  I/O.

    <PRI>1 TIMESTAMP HOST sdnator PID alert - {"timestamp": …, "event_type": "alert", …}

The message is the EVE (or ECS) line, which is ASCII.  TCP and TLS keep one connection; syslog over TCP has no
acknowledgements, so what a collector had not read when it died is lost there, and nobody can count it.
"""

import contextlib
import json
import os
import select
import socket
import ssl
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Final, Literal
from urllib.parse import urlsplit

Facility = Literal[
    "auth", "authpriv", "local0", "local1", "local2", "local3", "local4", "local5", "local6", "local7"
]
FACILITIES: Final[dict[Facility, int]] = {
    "auth": 4,
    "authpriv": 10,
    "local0": 16,
    "local1": 17,
    "local2": 18,
    "local3": 19,
    "local4": 20,
    "local5": 21,
    "local6": 22,
    "local7": 23,
}
_PORTS: Final = {"udp": 514, "tcp": 601, "tls": 6514}
_SEVERITIES: Final = {1: 3, 2: 4, 3: 5}
"""Suricata's severities as syslog's: error, warning, notice."""
_NOTICE: Final = 5
_TIMEOUT_S: Final = 5.0
_LONGEST_DATAGRAM: Final = 65_000


def syslog_place(url: str) -> tuple[str, str, int]:
    """Transport, host and port of a collector; raises ValueError naming what is wrong."""
    parts = urlsplit(url)
    if parts.scheme not in _PORTS or not parts.hostname or parts.path not in ("", "/"):
        raise ValueError(f"syslog {url!r}: give udp://HOST:PORT, tcp://HOST:PORT or tls://HOST:PORT")
    return parts.scheme, parts.hostname, parts.port or _PORTS[parts.scheme]


def syslog_message(line: str, facility: int, host: str, now: datetime) -> bytes:
    """One event as a message of RFC 5424.

    Args:
        line: the event as JSON in ASCII.
        facility: number of the facility.
        host: name of this machine.
        now: when it is sent, UTC.
    """
    kind, severity = _kind_and_severity(line)
    at = now.strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    head = f"<{8 * facility + severity}>1 {at} {_name(host, 255)} sdnator {os.getpid()} {_name(kind, 32)} - "
    return (head + line).encode("ascii", "backslashreplace")


def _kind_and_severity(line: str) -> tuple[str, int]:
    try:
        event = json.loads(line)
        severity = _SEVERITIES.get(event["alert"]["severity"], _NOTICE) if "alert" in event else _NOTICE
        return str(event.get("event_type", "event")), severity
    except (ValueError, TypeError, KeyError, AttributeError):
        return "event", _NOTICE


def _name(text: str, most: int) -> str:
    """A name as the header takes it: printable ASCII without spaces."""
    return "".join(char if "!" <= char <= "~" else "_" for char in text)[:most] or "-"


def to_syslog(url: str, facility: Facility, ca_file: str = "") -> Callable[[str], None]:
    """Deliver lines to a collector; the callable raises `OSError`.

    Args:
        url: of the collector; `syslog_place` says which are possible.
        facility: of all messages.
        ca_file: CA certificates for tls, PEM; empty: the system's.

    Raises ValueError for a malformed URL or CA file.
    """
    scheme, host, port = syslog_place(url)
    number, here = FACILITIES[facility], socket.gethostname()
    if scheme == "udp":
        send = _datagrams(host, port)
    else:
        send = SyslogStream(host, port, _context(ca_file) if scheme == "tls" else None).send

    def deliver(line: str) -> None:
        send(syslog_message(line, number, here, datetime.now(UTC)))

    return deliver


def _datagrams(host: str, port: int) -> Callable[[bytes], None]:
    def send(message: bytes) -> None:
        # looked up each time: a collector's address may change
        family, kind, protocol, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind, protocol) as opened:
            opened.sendto(message[:_LONGEST_DATAGRAM], place)

    return send


def _context(ca_file: str) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=ca_file or None)
    except (OSError, ssl.SSLError) as error:
        raise ValueError(f"syslog_ca {ca_file}: {error}") from None


class SyslogStream:
    """One connection to a collector, opened again when it has ended.

    Args:
        host: of the collector.
        port: of the collector.
        tls: verifies it; None: plain TCP.
    """

    def __init__(self, host: str, port: int, tls: ssl.SSLContext | None) -> None:
        self._place = (host, port)
        self._tls = tls
        self._connection: socket.socket | None = None

    def send(self, message: bytes) -> None:
        """Send one message; raises `OSError`."""
        if self._connection is not None and _has_ended(self._connection):
            self.close()
        try:
            if self._connection is None:
                self._connection = self._opened()
            self._connection.sendall(b"%d " % len(message) + message)
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        """Close the connection."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def _opened(self) -> socket.socket:
        plain = socket.create_connection(self._place, _TIMEOUT_S)
        plain.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        if self._tls is None:
            return plain
        try:
            return self._tls.wrap_socket(plain, server_hostname=self._place[0])
        except OSError:
            plain.close()
            raise


def _has_ended(connection: socket.socket) -> bool:
    """Whether the collector has closed it: collectors say nothing, so anything readable is the end of it."""
    if not select.select([connection], [], [], 0)[0]:
        return False
    connection.settimeout(0)
    try:
        return not connection.recv(1024)
    except (BlockingIOError, ssl.SSLWantReadError):
        return False
    except OSError:
        return True
    finally:
        with contextlib.suppress(OSError):
            connection.settimeout(_TIMEOUT_S)
