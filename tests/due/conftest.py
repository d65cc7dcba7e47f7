"""A real Data Updates server and engines on it, closed after each test."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from due import CONSUMER, PRODUCER, Engine, Options
from due.drivers.embedded_redis import EmbeddedServer
from sdnator.testing.kafka_servers import KafkaMissing, KafkaServers
from sdnator.testing.sentinel_servers import SentinelServers
from tests.requirements import missing


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmbeddedServer]:
    """One server for all tests of a session; tests use keys of their own."""
    with EmbeddedServer(tmp_path_factory.mktemp("updates")) as running:
        yield running


@pytest.fixture(scope="session")
def sentinel_servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SentinelServers]:
    """A primary, two replicas and three sentinels for all tests of a session that do not break them."""
    with SentinelServers(tmp_path_factory.mktemp("sentinel")) as servers:
        yield servers


@pytest.fixture(scope="session")
def kafka_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[KafkaServers]:
    """One real broker for all tests of a session; tests use keys and groups of their own."""
    try:
        servers = KafkaServers(tmp_path_factory.mktemp("kafka")).start()
    except KafkaMissing as reason:
        missing(str(reason))
    yield servers
    servers.stop()


@pytest.fixture
def make_engine(server, tmp_path) -> Iterator[Callable[..., Engine]]:
    """Makes initialised engines without a Coordinator unless `coordinated=True` is given."""
    made = []

    def make(app_id, role=PRODUCER | CONSUMER, *, url=None, archive=None, init=None, **options):
        options = {"coordinated": False, "directory": str(tmp_path / "due"), **options}
        engine = Engine(Options(**options))
        engine.set_pubsub(url or server.url)
        engine.set_db(archive or f"sqlite://{tmp_path / 'archive.db'}")
        engine.init(app_id, role, **(init or {}))
        made.append(engine)
        return engine

    yield make
    for engine in made:
        engine.close()


def wait_for(condition: Callable[[], object], seconds: float = 60.0) -> None:
    """Return when the condition holds; the watchdog is generous."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "nothing happened in time"
        time.sleep(0.005)


def gone(pid: int) -> bool:
    """Whether this process has ended; nobody may have fetched its exit code yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True
