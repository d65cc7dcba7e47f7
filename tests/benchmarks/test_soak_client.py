"""The client of a soak run gives instructions, for some minutes more of them than usual."""

import os
import time

from apps.messages import Instruction
from benchmarks import soak_client
from benchmarks.soak_client import SoakClient
from due.drivers.sqlite import SqliteArchive


def _ask(client, times):
    goal, deadline = client.asked + times, time.monotonic() + 30
    while client.asked < goal and time.monotonic() < deadline:
        time.sleep(0.01)


def test_a_hasty_operator_blocks_more_often_and_for_a_shorter_time(tmp_path, monkeypatch):
    """So as many blocks stand at a time as usual."""
    monkeypatch.setattr(soak_client, "_EVERY_S", 0.5)
    monkeypatch.setattr(soak_client, "_HASTY_S", 0.1)
    archive = f"sqlite://{tmp_path}/archive.db"
    client = SoakClient(tmp_path / "client", f"memory://soak{os.getpid()}", archive)
    client.start()
    try:
        with client.hasty():
            _ask(client, 3)
        _ask(client, 2)
    finally:
        client.close()
    items = SqliteArchive(archive).find({"dataKey": "network.instruction.soak_operator.firewall"})
    seconds = [Instruction.from_value(item.value).seconds for item in items]
    assert set(seconds) == {1, 6}
    assert seconds[-1] == 6
    assert not client.errors
