"""Syslog as collectors read it: over a datagram, a stream and TLS, each from a real socket."""

import json
import re
import socket
import ssl
import subprocess
import threading
from contextlib import suppress
from datetime import UTC, datetime

import pytest

from apps.firewall.enforcement.eve import decision_event, line_of
from apps.firewall.enforcement.event_sink import EventSink
from apps.firewall.enforcement.syslog_sink import syslog_message, syslog_place, to_syslog
from apps.firewall.settings import Settings
from sdnator.testing.waiting import wait_for
from tests.apps.firewall.enforcement.test_eve import decision
from tests.requirements import require_program

HEADER = re.compile(
    rb"<(\d{1,3})>1 \d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}Z [!-~]{1,255} sdnator \d+ ([!-~]{1,32}) - (.*)"
)
LINE = line_of(decision_event(decision()))


class Collector:
    """Accepts connections and cuts what comes by octet counting, as RFC 6587 says."""

    def __init__(self, tls=None):
        self.server = socket.create_server(("127.0.0.1", 0))
        self.messages = []
        self.connections = []
        self._readers = []
        self._tls = tls
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    @property
    def place(self):
        return f"127.0.0.1:{self.server.getsockname()[1]}"

    def hang_up(self):
        for each in self.connections:
            with suppress(OSError):  # its reader may have come to the end and closed it
                each.shutdown(socket.SHUT_RDWR)
            each.close()
        self.connections.clear()

    def close(self):
        self.server.shutdown(socket.SHUT_RDWR)
        self.server.close()
        self._thread.join(10)
        self.hang_up()
        for reader in self._readers:
            reader.join(10)
            assert not reader.is_alive(), "it reads on at the end of its stream"

    def _serve(self):
        while True:
            try:
                opened, _ = self.server.accept()
                if self._tls is not None:
                    opened = self._tls.wrap_socket(opened, server_side=True)
            except ssl.SSLError:
                continue
            except OSError:
                return
            self.connections.append(opened)
            self._readers.append(threading.Thread(target=self._read, args=(opened,), daemon=True))
            self._readers[-1].start()

    def _read(self, opened):
        with opened, opened.makefile("rb") as stream:
            try:
                while length := _number(stream):
                    self.messages.append(stream.read(length))
            except (OSError, ValueError):
                return


def _number(stream):
    """Length of the next message; 0 at the end of the stream."""
    digits = b""
    while digit := stream.read(1):
        if digit == b" ":
            return int(digits)
        digits += digit
    return 0


def check(message):
    found = HEADER.fullmatch(message)
    assert found
    priority, kind, text = found.groups()
    assert int(priority) == 8 * 16 + 3  # local0, and the severity of a block
    assert kind == b"alert"
    assert json.loads(text) == json.loads(LINE)


def test_a_datagram_is_a_message():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as collector:
        collector.bind(("127.0.0.1", 0))
        collector.settimeout(30)
        to_syslog(f"udp://127.0.0.1:{collector.getsockname()[1]}", "local0")(LINE)
        check(collector.recv(65_535))


def test_a_stream_is_cut_by_octet_counting_and_opened_again():
    collector = Collector()
    deliver = to_syslog(f"tcp://{collector.place}", "local0")
    for _ in range(3):
        deliver(LINE)
    wait_for(lambda: len(collector.messages) == 3)
    collector.hang_up()
    wait_for(lambda: not collector.connections)
    deliver(LINE)
    wait_for(lambda: len(collector.messages) == 4)
    for message in collector.messages:
        check(message)
    collector.close()


def test_tls_is_verified(tmp_path):
    """A collector that cannot prove who it is gets nothing."""
    certificate, key = tmp_path / "certificate.pem", tmp_path / "key.pem"
    make = [
        require_program("openssl"),
        "req",
        "-x509",
        "-newkey",
        "ec",
        "-pkeyopt",
        "ec_paramgen_curve:P-256",
        "-nodes",
    ]
    make += [
        "-subj",
        "/CN=test",
        "-addext",
        "subjectAltName=IP:127.0.0.1",
        "-keyout",
        str(key),
        "-out",
        str(certificate),
    ]
    subprocess.run(make, check=True, capture_output=True)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    collector = Collector(context)
    with pytest.raises(ssl.SSLCertVerificationError):
        to_syslog(f"tls://{collector.place}", "local0")(LINE)
    to_syslog(f"tls://{collector.place}", "local0", str(certificate))(LINE)
    wait_for(lambda: collector.messages)
    assert len(collector.messages) == 1
    check(collector.messages[0])
    collector.close()


def test_a_collector_that_reads_nothing_holds_nobody_up():
    """What does not fit into the queue is counted; putting never waits."""
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        sink = EventSink("syslog", to_syslog(f"tcp://127.0.0.1:{deaf.getsockname()[1]}", "local0"), size=10)
        for _ in range(200):
            sink.put(json.dumps({"event_type": "alert", "text": "x" * (1 << 20)}))
        sink.close(0.1)
        assert sink.lost > 100
        assert sink.lost + sink.delivered >= 190


@pytest.mark.parametrize(
    "line", ["", "no JSON", "[]", '{"alert": 5}', '{"alert": {"severity": []}}', "ü\n\x00"]
)
def test_any_line_makes_one_message(line):
    """Header and severity do not depend on what is in it."""
    message = syslog_message(line, 16, "a host\n", datetime.now(UTC))
    assert message.startswith(b"<133>1 ")
    assert b" a_host_ sdnator " in message


@pytest.mark.parametrize("url", ["host:514", "http://host", "udp://", "tcp://host/path"])
def test_a_malformed_place_is_named(url):
    with pytest.raises(ValueError, match="give udp://HOST:PORT"):
        Settings(syslog=url)


def test_ports_are_those_that_were_assigned():
    assert [syslog_place(f"{each}://host") for each in ("udp", "tcp", "tls")] == [
        ("udp", "host", 514),
        ("tcp", "host", 601),
        ("tls", "host", 6514),
    ]
