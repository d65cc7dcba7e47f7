"""The dashboard listens where it is told to, or beside it."""

import socket
from http.server import BaseHTTPRequestHandler, HTTPServer
from threading import Thread
from typing import Any, cast

import pytest

from apps.messages import Confirmation, Decision, Target
from due import Item
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

    def get(self, query):
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
        def get(self, query):
            return archived.get(query if isinstance(query, str) else query["dataKey"], [])

    dashboard = DashboardService(cast("Any", Kept()), Settings())
    dashboard._take_up_history()
    assert dict(dashboard.board.answers) == {"d1 nftables gateway": "installed"}


@pytest.mark.parametrize(
    "said", [b"[5]", b'{"a": 1}', b"[" * 5000, b"5"], ids=["list", "map", "deep", "number"]
)
def test_a_coordinator_that_answers_nonsense_ends_no_thread(tmp_path, said):
    """Else the pages would show the last state for ever."""

    class Nonsense(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.end_headers()
            self.wfile.write(said)

        def log_message(self, *_):
            pass

    with HTTPServer(("127.0.0.1", 0), Nonsense) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        place = tmp_path / "coordinator"
        place.write_text(f"http://127.0.0.1:{server.server_port}")
        dashboard = DashboardService(cast("Any", Archive()), Settings(coordinator_file=str(place)))
        poll = Thread(target=dashboard._poll, daemon=True)
        poll.start()
        try:
            wait_for(lambda: dashboard.board.coordinator or not poll.is_alive())
            assert poll.is_alive()
        finally:
            dashboard._stopping.set()
            poll.join()
            server.shutdown()
