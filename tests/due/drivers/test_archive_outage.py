"""An archive server that goes away under load and comes back: writers go on, nothing is lost, nothing twice."""

import threading
import time
from collections.abc import Callable
from pathlib import Path

from due import DB_ONLY, Engine, Options
from due.drivers.embedded_redis import EmbeddedServer
from tests.due.drivers.mongo_server import nx_server

KEY = "outage.test.app.item"


def test_nothing_is_lost_while_the_archive_is_away(tmp_path: Path) -> None:
    database = str(tmp_path / "nx.db")
    ended = threading.Event()
    written = 0

    def write(engine: Engine) -> None:
        nonlocal written
        while not ended.wait(0.002):
            engine.write(KEY, written, [DB_ONLY])
            written += 1

    with EmbeddedServer(tmp_path / "updates") as updates:
        with nx_server(tmp_path, db=database) as url:
            options = Options(
                updates=updates.url,
                archive=f"{url}?serverSelectionTimeoutMS=200",
                directory=str(tmp_path),
                coordinated=False,
            )
            engine = Engine(options)
            engine.init("app")
            writer = threading.Thread(target=write, args=(engine,))
            writer.start()
            _until(lambda: engine.health().get("archive", {}).get("archived", 0) > 20)
        _until(lambda: engine.health()["archive"]["spooled"] > 50)
        during = written
        _until(lambda: written > during + 50)
        with nx_server(tmp_path, db=database, port=_port(url)):
            ended.set()
            writer.join()
            engine.flush(60)
            _until(lambda: engine.health()["archive"]["backlog"] == 0)
            counts = engine.health()["archive"]
            found = [item.value for item in engine.get(KEY)]
            engine.close()
    assert counts["lost"] == counts["refused"] == 0
    assert found == list(range(written))


def _port(url: str) -> int:
    return int(url.rpartition(":")[2].partition("/")[0])


def _until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)
