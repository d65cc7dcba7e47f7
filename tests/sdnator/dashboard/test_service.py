"""The dashboard listens where it is told to, or beside it."""

import socket
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from threading import Thread
from typing import Any, cast

import pytest

from apps.messages import Confirmation, Decision, Target
from due import Item
from due.errors import ArchiveUnavailable
from sdnator.dashboard import service
from sdnator.dashboard.service import CAPABILITIES, INTERESTS, DashboardService, listening
from sdnator.dashboard.settings import Settings
from sdnator.testing.waiting import wait_for


def test_a_taken_port_means_a_free_one():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with listening("127.0.0.1", port) as found:
            assert found.getsockname()[1] != port


def test_it_makes_nothing_but_instructions():
    """Everything else is for looking."""
    assert [one.key for one in CAPABILITIES] == [
        "network.instruction.dashboard.firewall",
        "network.audit.dashboard.page",
    ]
    assert "network.anomaly.kitsune.score" in {one.key for one in INTERESTS}


class Archive:
    """An engine that has one unreadable item under every key, and nothing else."""

    def get(self, query, **_):
        key = query if isinstance(query, str) else query["dataKey"]
        return [Item(key, {"id": [[]]}, 1, 1, "anybody", "i", 1)]


def test_an_archived_item_that_nobody_understands_does_not_keep_the_pages_from_starting():
    dashboard = DashboardService(cast("Any", Archive()), Settings())
    dashboard._take_up_history()
    assert dashboard.health()["misunderstood"] == len(service.DECISIONS) + 2


def test_a_page_that_starts_later_knows_where_a_block_is_in_force():
    """From the archive: enforcers say it once."""
    target = Target(kind="ip", address="192.0.2.1")
    block = Decision(
        id="d1", action="block", switch="*", target=target, reason="r", event_time=1, expires=0
    )  # fmt: skip
    said = Confirmation(
        id="d1", switch="gateway", state="installed", action="block", target=target, event_time=1
    )  # fmt: skip
    key = "network.confirmation.nftables.gateway"
    archived = {
        service.DECISIONS[0]: [Item(service.DECISIONS[0], block.to_value(), 1, 1, "firewall", "i", 1)],
        service.CONFIRMATIONS: [Item(key, said.to_value(), 2, 1, "nftables", "i", 1)],
    }

    class Kept:
        def get(self, query, **_):
            return archived.get(query if isinstance(query, str) else query["dataKey"], [])

    dashboard = DashboardService(cast("Any", Kept()), Settings())
    dashboard._take_up_history()
    assert dict(dashboard.board.answers) == {"d1 nftables gateway": "installed"}


class Recorded:
    """An engine with one block in its archive, which remembers how much was asked for and fails from some question on."""

    def __init__(self, fails_at=99):
        self.limits = []
        self._fails_at = fails_at

    def get(self, query, *, limit=None):
        self.limits.append(limit)
        if len(self.limits) > self._fails_at:
            raise ArchiveUnavailable("away")
        target = Target(kind="ip", address="192.0.2.1")
        block = Decision(
            id="d1", action="block", switch="*", target=target, reason="r", event_time=1, expires=0
        )  # fmt: skip
        return (
            [Item(query, block.to_value(), 1, 1, "firewall", "i", 1)] if query == service.DECISIONS[0] else []
        )


def test_no_start_and_no_search_reads_a_whole_archive():
    """Which may be large: a viewer's search could load a day of packets."""
    engine = Recorded()
    dashboard = DashboardService(cast("Any", engine), Settings())
    dashboard._take_up_history()
    dashboard.find("network.**", 0, 10**18, 200)
    assert len(engine.limits) == len(service.DECISIONS) + 3 + 4
    assert all(limit is not None and limit <= 5_000 for limit in engine.limits)


@pytest.mark.parametrize("fails_at", range(len(service.DECISIONS) + 3))
def test_an_archive_that_goes_away_at_any_question_does_not_keep_the_pages_from_starting(fails_at):
    engine = Recorded(fails_at)
    DashboardService(cast("Any", engine), Settings())._take_up_history()
    assert len(engine.limits) == fails_at + 1


@contextmanager
def polling(tmp_path, said):
    """A dashboard whose Coordinator answers this: the board, the thread that asks, and the tokens that came."""
    tokens = []

    class Answering(BaseHTTPRequestHandler):
        def do_GET(self):
            tokens.append(self.headers["Authorization"])
            self.send_response(200)
            self.end_headers()
            self.wfile.write(said)

        def log_message(self, *_):
            pass

    with HTTPServer(("127.0.0.1", 0), Answering) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        place = tmp_path / "coordinator"
        place.write_text(f"http://127.0.0.1:{server.server_port}\n")
        dashboard = DashboardService(cast("Any", Archive()), Settings(coordinator_file=str(place)))
        poll = Thread(target=dashboard._poll, daemon=True)
        poll.start()
        try:
            yield dashboard.board, poll, tokens
        finally:
            dashboard._stopping.set()
            poll.join()
            server.shutdown()


@pytest.mark.parametrize(
    "said", [b"[5]", b'{"a": 1}', b"[" * 5000, b"5"], ids=["list", "map", "deep", "number"]
)
def test_a_coordinator_that_answers_nonsense_ends_no_thread(tmp_path, said):
    """Else the pages would show the last state for ever."""
    with polling(tmp_path, said) as (board, poll, _):
        wait_for(lambda: board.coordinator or not poll.is_alive())
        assert poll.is_alive()


def test_the_token_of_the_environment_is_sent_to_the_coordinator(tmp_path, monkeypatch):
    monkeypatch.setenv("DUE_COORDINATOR_TOKEN", "a-token-of-the-operator")
    with polling(tmp_path, b"{}") as (_, _, tokens):
        wait_for(lambda: tokens)
    assert tokens[0] == "Bearer a-token-of-the-operator"
