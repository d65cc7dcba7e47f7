"""The webhook for real: an HTTP server confirms, refuses, is away, forgets, and is not who it should be."""

import json
import socket
import ssl
import subprocess
import threading
import time

import pytest

from apps.enforcers.webhook_enforcer.exchange import answer_in, listing_in
from apps.enforcers.webhook_enforcer.settings import Settings
from apps.messages import MessageError
from due import Item
from due.backends import open_archive
from sdnator.errors import PipelineError
from sdnator.testing.enforcer_run import EnforcerRun
from sdnator.testing.waiting import wait_for
from sdnator.testing.webhook_server import SECRET, WebhookServer
from tests.requirements import require_program

MODULE = "apps.enforcers.webhook_enforcer.service"


@pytest.fixture
def secret(tmp_path):
    """Path of a file with the secret that the server knows."""
    file = tmp_path / "secret"
    file.write_bytes(SECRET + b"\n")
    file.chmod(0o600)
    return str(file)


def started(tmp_path, secret, url, **more):
    settings = {"url": url, "secret_file": secret, "place": "edge", "check_s": 0.2, "timeout_s": 2.0}
    return EnforcerRun(tmp_path, MODULE, settings | more)


def test_a_block_is_confirmed_listed_and_lifted(tmp_path, secret):
    with WebhookServer() as server, started(tmp_path, secret, server.url) as run:
        run.start()
        block = run.decide(run.block("192.0.2.1"))
        run.wait_for(block, "installed")
        assert server.blocks[block.id]["target"] == {"kind": "ip", "address": "192.0.2.1", "port": None}
        wait_for(lambda: run.held() == {block.id}, why=run.words)
        run.lift(block)
        run.wait_for(block, "removed")
        assert not server.blocks


def test_a_refusal_is_final_and_says_why(tmp_path, secret):
    """By its words in an answer, or by a status that no repetition changes."""
    with WebhookServer() as server, started(tmp_path, secret, server.url) as run:
        run.start()
        for status, answer in ((200, {"state": "failed", "cause": "no room"}), (422, {"no": "room"})):
            server.answer = lambda _, status=status, answer=answer: (status, answer)
            block = run.decide(run.block("192.0.2.1"))
            run.wait_for(block, "failed")
            assert "room" in run.confirmations[-1].cause
            assert len([method for method, _ in server.requests if method == "POST"]) == 1
            server.requests.clear()


def test_a_server_that_is_away_gets_it_later_under_one_idempotency_key(tmp_path, secret):
    with WebhookServer() as server, started(tmp_path, secret, server.url) as run:
        server.answer = lambda _: (503, {"come": "later"})
        run.start()
        block = run.decide(run.block("192.0.2.1"))
        wait_for(
            lambda: len([method for method, _ in server.requests if method == "POST"]) >= 2, why=run.words
        )
        assert not run.states(block)
        server.answer = None
        run.wait_for(block, "installed")
        assert len({key for method, key in server.requests if method == "POST"}) == 1


def test_patience_has_an_end(tmp_path, secret):
    """Nobody listens there: the block fails with the cause, and nothing else waits for that."""
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{unused.getsockname()[1]}/"
        with started(tmp_path, secret, url, patience_s=0.5) as run:
            run.start()
            block = run.decide(run.block("192.0.2.1"))
            run.wait_for(block, "failed")
            assert "refused" in run.confirmations[-1].cause
            assert not run.reports[-1].working


def test_what_the_server_forgets_is_posted_again_and_what_it_invents_is_lifted(tmp_path, secret):
    with WebhookServer() as server, started(tmp_path, secret, server.url) as run:
        run.start()
        block = run.decide(run.block("192.0.2.1"))
        run.wait_for(block, "installed")
        for _ in range(2):
            server.blocks.clear()
            wait_for(lambda: block.id in server.blocks, why=run.words)
        server.blocks["invented"] = {}
        wait_for(lambda: "invented" not in server.blocks, why=run.words)
        wait_for(lambda: any("somebody else" in each.problem for each in run.reports), why=run.words)


def test_a_block_ends_there_without_anybody_s_word(tmp_path, secret):
    with WebhookServer() as server, started(tmp_path, secret, server.url) as run:
        run.start()
        block = run.decide(run.block("192.0.2.1", seconds=1))
        run.wait_for(block, "expired")
        assert not server.blocks


def test_a_panic_in_the_archive_is_heard_without_a_firewall(tmp_path, secret):
    """As `blocks panic` writes it where nobody answers: past Data Updates."""
    with WebhookServer() as server, started(tmp_path, secret, server.url) as run:
        run.start()
        block = run.decide(run.block("192.0.2.1"))
        run.wait_for(block, "installed")
        value = block.to_value() | {"action": "unblock", "event_time": time.time_ns()}
        archive = open_archive(f"sqlite://{tmp_path / 'archive.db'}")
        archive.insert(
            [Item("network.block.firewall.ipv4", value, time.time_ns(), 1, "firewall", "other", 1)]
        )
        archive.close()
        run.wait_for(block, "removed")
        assert not server.blocks


def test_a_wrong_secret_is_refused_by_the_server_with_words(tmp_path):
    other = tmp_path / "other"
    other.write_bytes(b"quite another secret")
    other.chmod(0o600)
    with WebhookServer() as server, started(tmp_path, str(other), server.url) as run:
        run.start()
        block = run.decide(run.block("192.0.2.1"))
        run.wait_for(block, "failed")
        assert "401" in run.confirmations[-1].cause


@pytest.fixture
def certificate(tmp_path):
    """Certificate and key of 127.0.0.1, signed by itself."""
    openssl = require_program("openssl")
    key, found = tmp_path / "key.pem", tmp_path / "certificate.pem"
    subprocess.run(
        [openssl, "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes",
         "-keyout", key, "-out", found, "-days", "2", "-subj", "/CN=test",
         "-addext", "subjectAltName=IP:127.0.0.1"],
        check=True, capture_output=True,
    )  # fmt: skip
    return found, key


def test_tls_is_verified(tmp_path, secret, certificate):
    """With the CA it works; without, no decision leaves this machine."""
    found, key = certificate
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(found, key)
    with WebhookServer(context) as server:
        for folder, ca_file, state in (("with", str(found), "installed"), ("without", "", "failed")):
            (tmp_path / folder).mkdir()
            with started(tmp_path / folder, secret, server.url, ca_file=ca_file, patience_s=0.3) as run:
                run.start()
                block = run.decide(run.block("192.0.2.1"))
                run.wait_for(block, state)
                if state == "failed":
                    assert "certificate" in run.confirmations[-1].cause
                    assert block.id not in server.blocks


def test_an_endless_answer_ends(tmp_path, secret):
    """A server that drips or floods costs one time-out an attempt, and no memory."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        stopping = threading.Event()

        def flood():
            while not stopping.is_set():
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                with connection:
                    try:
                        connection.sendall(b"HTTP/1.1 200 OK\r\n\r\n")
                        while not stopping.is_set():
                            connection.sendall(bytes(1 << 20))
                    except OSError:
                        pass

        thread = threading.Thread(target=flood, daemon=True)
        thread.start()
        url = f"http://127.0.0.1:{server.getsockname()[1]}/"
        with started(tmp_path, secret, url, timeout_s=0.5, patience_s=0.5) as run:
            run.start()
            block = run.decide(run.block("192.0.2.1"))
            run.wait_for(block, "failed")
        stopping.set()
        server.shutdown(socket.SHUT_RDWR)
        thread.join(10)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"url": "http://192.0.2.1/"}, "this machine"),
        ({"url": "https://a:b@192.0.2.1/"}, "holds a password"),
        ({"url": "ftp://192.0.2.1/"}, "https://HOST"),
        ({"url": "https://192.0.2.1/", "secret_file": ""}, "secret_file"),
        ({"check_s": 0}, "check_s"),
    ],
)
def test_wrong_settings_are_named(settings, words):
    with pytest.raises(ValueError, match=words):
        Settings(**{"secret_file": "here", **settings})


@pytest.mark.parametrize("spoil", [lambda file: file.chmod(0o644), lambda file: file.write_bytes(b"short")])
def test_a_secret_that_is_none_stops_the_start(tmp_path, secret, spoil):
    spoil(tmp_path / "secret")
    with (
        started(tmp_path, secret, "http://127.0.0.1:9/") as run,
        pytest.raises(PipelineError, match="secret_file"),
    ):
        run.start()


@pytest.mark.parametrize(
    "body", [b"", b"[]", b"{", b'{"state": "perhaps"}', b'{"blocks": [{}]}', b"[" * 100_000, b"\xff"]
)
def test_answers_that_are_none_raise_one_error(body):
    for decode in (answer_in, listing_in):
        try:
            decode(body)
        except MessageError:
            continue
        assert decode is listing_in  # of a listing every field has a default
        assert json.loads(body) == {"state": "perhaps"}
