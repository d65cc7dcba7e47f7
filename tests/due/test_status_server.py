"""Metrics are answered whoever else is connected."""

import http.client
import socket
import threading
from contextlib import ExitStack

from due.status_server import StatusServer
from tests.due.conftest import wait_for


def test_connections_that_ask_nothing_take_nobody_s_place():
    server = StatusServer("127.0.0.1:0")
    server.start()
    host, _, port = server.address.rpartition(":")
    threads = threading.active_count()
    with ExitStack() as silent:
        for _ in range(60):
            silent.enter_context(socket.create_connection((host, int(port))))
        asking = http.client.HTTPConnection(host, int(port), timeout=60)
        asking.request("GET", "/metrics")
        assert asking.getresponse().status == 200
        asking.close()
        wait_for(lambda: threading.active_count() < threads + 30)
    server.close()
