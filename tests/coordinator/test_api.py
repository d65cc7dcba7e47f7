"""The HTTP API shows the registry, reads the archive and live data, and refuses other sites."""

import asyncio
import json
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from coordinator import api
from coordinator.api import Api, Northbound, TokenGate, application
from coordinator.openapi import document
from coordinator.registry import Registry
from due import Capability, Engine, Interest, Item, Options
from due.drivers.embedded_redis import EmbeddedServer
from due.membership import Heartbeat, Registration

EVENTS = "due.event.coordinator"
WATCHDOG_S = 60


@pytest.fixture(scope="module")
def engine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Engine]:
    folder = tmp_path_factory.mktemp("due")
    with EmbeddedServer(folder / "updates") as server:
        engine = Engine(
            Options(
                updates=server.url,
                archive=f"sqlite://{folder}/a.db",
                directory=str(folder),
                coordinated=False,
            )
        )
        engine.init("coordinator")
        yield engine
        engine.close()


@pytest.fixture
def registry() -> Registry:
    registry = Registry("c1")
    registry.activate()
    now = time.monotonic()
    common: dict[str, Any] = {"revision": 1, "heartbeat": 1.0, "started": 5}
    registry.registered(
        Registration(app_id="p", instance_id="p1", capabilities=(Capability("a.b", 10.0),), **common), now
    )
    registry.registered(
        Registration(app_id="c", instance_id="c1", interests=(Interest("a.*", 20.0),), **common), now
    )
    registry.registered(Registration(app_id="c", instance_id="c2", **common), now)
    registry.beat(Heartbeat(app_id="p", instance_id="p1", revision=1, written=7), now)
    registry.outgoing()
    return registry


@pytest.fixture
def north(engine: Engine, registry: Registry) -> Northbound:
    def health() -> dict[str, Any]:
        counts = (
            "registrations",
            "heartbeats",
            "misunderstood",
            "assignments_sent",
            "failovers",
            "retention_deleted",
            "unauthorized",
            "refused",
            "apps",
            "declared_keys",
            "epochs",
        )
        return {"active": True, **dict.fromkeys(counts, 3)}

    return Northbound(engine, registry, threading.Lock(), health, lambda: {"p": {"health": b"x"}}, EVENTS)


@pytest.fixture
def client(north: Northbound) -> Iterator[httpx.Client]:
    server = Api(north, "127.0.0.1", 0)
    server.start()
    with httpx.Client(base_url=server.url, trust_env=False, timeout=WATCHDOG_S) as client:
        yield client
    server.stop()


def observed(client: httpx.Client, key: str) -> str:
    return f"ws://{client.base_url.netloc.decode()}/observe?key={key}"


def test_instances_and_apps(client: httpx.Client) -> None:
    shown = client.get("/instances").json()
    assert [(one["app_id"], one["instance_id"]) for one in shown] == [("c", "c1"), ("c", "c2"), ("p", "p1")]
    assert sorted(one["state"] for one in shown) == ["active", "active", "idle"]
    assert shown[2]["written"] == 7
    apps = client.get("/apps").json()
    assert [(app["app_id"], app["states"]) for app in apps] == [
        ("c", {"active": 1, "idle": 1}),
        ("p", {"active": 1}),
    ]
    assert apps[1]["active"] == "p1"


def test_capabilities_interests_assignments_and_flow(client: httpx.Client) -> None:
    assert (
        client.get("/capabilities").json()[0] | {"app_id": "p", "key": "a.b"}
        == client.get("/capabilities").json()[0]
    )
    assert client.get("/interests").json() == [{"app_id": "c", "key": "a.*", "frequency": 20.0}]
    consumer, producer = client.get("/assignments").json()
    assert producer["assignments"][0]["frequency"] == 10.0
    assert "20 Hz" in consumer["incompatible"][0]["reason"]
    (flow,) = client.get("/flow").json()
    assert (flow["producer"], flow["consumer"], flow["interest"]) == ("p", "c", "a.*")


def test_health_names_the_apps(client: httpx.Client) -> None:
    health = client.get("/health").json()
    assert health["active"] is True
    assert health["apps"]["p"] == {"health": {"$bytes": "eA=="}}


def test_history_is_of_one_app(client: httpx.Client, engine: Engine) -> None:
    for app in ("one", "two", "one"):
        engine.write(EVENTS, {"event": "joined", "app_id": app, "instance_id": "", "detail": ""})
    answer = client.get("/apps/one/history").json()
    assert [one["value"]["app_id"] for one in answer["items"]] == ["one", "one"]


def test_get_reads_the_archive(client: httpx.Client, engine: Engine) -> None:
    for n in range(5):
        engine.write("get.it", {"n": n, "nan": float("nan"), "bytes": b"x"})
    answer = client.get("/get", params={"key": "get.*", "limit": 2}).json()
    assert [one["value"]["n"] for one in answer["items"]] == [3, 4]
    assert answer["more"] is True
    assert answer["items"][0]["value"]["nan"] == "nan"
    query = json.dumps({"value.n": {"$lt": 2}})
    answer = client.get("/get", params={"key": "get.it", "query": query}).json()
    assert [one["value"]["n"] for one in answer["items"]] == [0, 1]
    assert answer["more"] is False
    since = answer["items"][1]["timestamp"]
    answer = client.get("/get", params={"key": "get.it", "since": since, "until": since + 1}).json()
    assert [one["value"]["n"] for one in answer["items"]] == [1]


@pytest.mark.parametrize(
    "query",
    [
        "",
        "key=a..b",
        "key=a&since=soon",
        "query=[1]",
        "query={",
        'query={"colour":1}',
        "key=a&limit=many",
        "key=a&limit=--5",
        "query=" + "[" * 9000,
        "query=" + '{"$nor":[' * 900 + "1" + "]}" * 900,
        "key=a&since=" + "9" * 5000,
        'query={"value":{"$regex":"(a)%5C%5C1"}}',
        "query=" + "x" * 40_000,
    ],
)
def test_wrong_questions_are_explained(client: httpx.Client, query: str) -> None:
    answer = client.get(f"/get?{query}")
    assert answer.status_code == 400
    assert answer.json()["detail"]


def test_an_answer_is_bounded_and_brings_the_latest(
    client: httpx.Client, engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    for n in range(5):
        engine.write("get.large", [n, "x" * 1000])
    monkeypatch.setattr(api, "_MAX_ANSWER_BYTES", 2500)
    answer = client.get("/get", params={"key": "get.large", "since": 1}).json()
    assert [one["value"][0] for one in answer["items"]] == [3, 4]
    assert answer["more"] is True


def test_a_question_that_takes_too_long_is_given_up(
    client: httpx.Client, engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine.write("get.long", 1)
    monkeypatch.setattr(api, "_QUERY_S", 0.0)
    answer = client.get("/get?key=get.long")
    assert (answer.status_code, answer.json()["error"]) == (503, "Timeout")


def test_slow_questions_hold_nobody_else_up(
    client: httpx.Client, engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(api, "_WAIT_S", 0.05)
    asked, answer_now = threading.Semaphore(0), threading.Event()

    def slow(*_query: Any, **_limit: Any) -> list[Item]:
        asked.release()
        answer_now.wait(WATCHDOG_S)
        return []

    monkeypatch.setattr(engine, "get", slow)
    with ThreadPoolExecutor(api._QUERIES) as pool:
        waiting = [
            pool.submit(httpx.get, f"{client.base_url}/get?key=a", trust_env=False, timeout=WATCHDOG_S)
            for _ in range(api._QUERIES)
        ]
        assert all(asked.acquire(timeout=WATCHDOG_S) for _ in waiting)
        assert client.get("/get?key=a").status_code == 503
        assert client.get("/instances").status_code == 200
        answer_now.set()
        assert [one.result().status_code for one in waiting] == [200] * api._QUERIES


def test_observe_sends_items_as_they_come(client: httpx.Client, engine: Engine) -> None:
    with connect(observed(client, "live.*"), proxy=None, open_timeout=WATCHDOG_S) as socket:
        done = threading.Event()

        def write() -> None:
            while not done.wait(0.02):
                engine.write("live.x", 42)

        writer = threading.Thread(target=write)
        writer.start()
        try:
            received = json.loads(socket.recv(WATCHDOG_S))
        finally:
            done.set()
            writer.join()
    assert (received["dataKey"], received["value"]) == ("live.x", 42)


def test_a_slow_reader_misses_the_oldest_and_is_told() -> None:
    async def scenario() -> tuple[list[Item], int]:
        feed = api._Feed(asyncio.get_running_loop())
        for n in range(1500):
            feed.put(Item("a", n, n, n, "app", "i", n))
        return await feed.take()

    items, missed = asyncio.run(scenario())
    assert missed == 500
    assert [item.value for item in items] == list(range(500, 1500))


def test_observe_explains_a_wrong_key(client: httpx.Client) -> None:
    with connect(observed(client, "a..b"), proxy=None, open_timeout=WATCHDOG_S) as socket:
        assert json.loads(socket.recv(WATCHDOG_S))["error"] == "InvalidKey"


def test_other_sites_are_refused(client: httpx.Client) -> None:
    assert client.get("/apps", headers={"host": "evil.example"}).status_code == 400
    with pytest.raises(InvalidStatus):
        connect(
            observed(client, "a"), origin=Origin("http://evil.example"), proxy=None, open_timeout=WATCHDOG_S
        )


def test_nothing_can_be_written(client: httpx.Client) -> None:
    for path in document()["paths"]:
        for method in ("POST", "PUT", "DELETE", "PATCH"):
            assert client.request(method, path.replace("{app_id}", "p")).status_code == 405


def test_metrics_are_in_prometheus_format(client: httpx.Client) -> None:
    answer = client.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain")
    lines = answer.text.splitlines()
    assert 'sdnator_instances{app="c",state="idle"} 1.0' in lines
    assert 'sdnator_instance_items_written_total{app="p",instance="p1"} 7.0' in lines
    assert "sdnator_coordinator_heartbeats_total 3.0" in lines


def test_every_route_is_documented(client: httpx.Client, north: Northbound) -> None:
    described = client.get("/openapi.json").json()
    assert described == document()
    routes = {getattr(route, "path", "") for route in application(north).routes}
    assert routes - {"/observe"} == set(described["paths"])
    for path in described["paths"]:
        assert described["paths"][path]["get"]["summary"]


@pytest.mark.parametrize(
    "given", [None, "", "Bearer", "Bearer wrong", "Basic dmlld2VyOnNlY3JldA==", "bearer secret"]
)
def test_with_a_token_every_route_but_metrics_wants_it(given):
    """A route that is added is tried, too: those of the application itself are taken."""
    north: Any = object()
    paths = {getattr(route, "path", "") for route in application(north).routes}
    assert {"/apps", "/get", "/observe", "/health", "/openapi.json", "/metrics"} <= paths
    headers = {} if given is None else {"authorization": given}
    served = Api(north, "127.0.0.1", 0, token="secret")  # noqa: S106 - nobody's
    served.start()
    try:
        for path in paths - {"/metrics", "/observe"}:
            answer = httpx.get(served.url + path.replace("{app_id}", "x"), headers=headers)
            assert (answer.status_code, answer.json()["error"]) == (401, "Unauthorized"), path
        live = served.url.replace("http", "ws") + "/observe?key=a"
        with pytest.raises(InvalidStatus), connect(live, additional_headers=headers):
            pass
        assert served.unauthorized == len(paths - {"/metrics"}), "each is counted"
        right = {"authorization": "Bearer secret"}
        assert httpx.get(f"{served.url}/openapi.json", headers=right).status_code == 200
    finally:
        served.stop()


@pytest.mark.parametrize(("path", "given", "admitted"), [
    ("/metrics", "", False), ("/metrics", "Bearer wrong", False), ("/metrics", "Bearer scrape", True),
    ("/metrics", "Bearer secret", True), ("/openapi.json", "Bearer scrape", False), ("/openapi.json", "Bearer secret", True),
])  # fmt: skip
def test_metrics_may_have_a_token_of_their_own(path, given, admitted):
    """It opens nothing else; the API's own opens metrics, too."""
    asked: list[str] = []

    async def app(scope, _receive, _send):
        asked.append(scope["path"])

    async def send(message):
        assert message.get("status", 401) == 401

    scope = {"type": "http", "path": path, "headers": [(b"authorization", given.encode())]}
    asyncio.run(TokenGate(app, "secret", "scrape")(scope, None, send))
    assert asked == ([path] if admitted else [])
