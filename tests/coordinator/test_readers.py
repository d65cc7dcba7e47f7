"""An app reads from the archive over HTTP what it was granted; every other key and path is refused, counted and told."""

import json
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import httpx
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from coordinator.api import Api, Northbound, application
from coordinator.readers import ArchiveReaders
from coordinator.registry import Registry
from due.backends import open_archive
from due.drivers.base import ArchiveDriver
from due.drivers.redis_rights import Rights
from due.messages import Item
from sdnator.rights.identities import READERS, Identities

MINE, FOREIGN = "network.anomaly.mine.score", "network.anomaly.kitsune.score"
COMMANDING = "network.block.firewall.ipv4"


class _ArchiveAlone:
    """As much of an engine as /get needs."""

    def __init__(self, driver: ArchiveDriver) -> None:
        self._driver = driver

    def get(self, query: Mapping[str, Any], *, limit: int) -> list[Item]:
        return self._driver.find(query, limit=limit)


@pytest.fixture
def identities(tmp_path: Path) -> Identities:
    found = Identities(tmp_path)
    with found.changing():
        found.put("mine", Rights(app="mine", publish=("network.anomaly.mine.**",), read=(MINE, "house.**")))
        found.put("blind", Rights(app="blind", observe=("**",)))
    return found


@pytest.fixture(params=["memory://", "sqlite://{}/a.db"])
def served(request: pytest.FixtureRequest, identities: Identities, tmp_path: Path) -> Iterator[Api]:
    driver = open_archive(request.param.format(tmp_path))
    keys = (MINE, FOREIGN, COMMANDING, "house.climate.hall:unit=c")
    driver.insert([Item(key, key, n, n, "app", "app1", n) for n, key in enumerate(keys, 1)])
    engine: Any = _ArchiveAlone(driver)
    north = Northbound(engine, Registry("c1"), threading.Lock(), dict, dict, "due.event.coordinator")
    readers = ArchiveReaders(tmp_path / READERS)
    api = Api(north, "127.0.0.1", 0, token="owner", readers=readers)  # noqa: S106 - nobody's
    api.start()
    yield api
    api.stop()
    driver.close()


def _headers(identities: Identities, name: str) -> dict[str, str]:
    return {"authorization": f"Bearer {identities.all[name].password}"}


def _asked(api: Api, headers: dict[str, str], path: str = "/get", **asked: Any) -> httpx.Response:
    return httpx.get(api.url + path, params=asked, headers=headers, trust_env=False, timeout=60)


def _keys(answer: httpx.Response) -> set[str]:
    assert answer.status_code == 200, answer.text
    return {one["dataKey"] for one in answer.json()["items"]}


def test_an_app_reads_its_keys_and_no_query_shows_it_another(served: Api, identities: Identities) -> None:
    mine = _headers(identities, "mine")
    assert _keys(_asked(served, mine, key=MINE)) == {MINE}
    assert _keys(_asked(served, mine, key="house.*.hall")) == {"house.climate.hall:unit=c"}
    for query in (
        {"dataKey": "**"},
        {"dataKey": {"$regex": "."}},
        {"dataKey": {"$ne": "a"}},
        {"dataKey": {"$in": [FOREIGN, COMMANDING]}},
        {"$or": [{"dataKey": FOREIGN}, {"sequence": {"$gte": 0}}]},
        {"$nor": [{"sequence": 99}]},
        {"value": {"$regex": "network"}},
    ):
        shown = _keys(_asked(served, mine, query=json.dumps(query)))
        assert shown <= {MINE, "house.climate.hall:unit=c"}, query
    assert _keys(_asked(served, {"authorization": "Bearer owner"}, key="network.**")) == {
        *(MINE, FOREIGN, COMMANDING)
    }


def test_every_other_key_and_path_is_refused_counted_and_told(
    served: Api, identities: Identities, caplog: pytest.LogCaptureFixture
) -> None:
    mine, north = _headers(identities, "mine"), cast("Any", object())
    wanted: list[dict[str, Any]] = [
        {"key": key}
        for key in (
            FOREIGN,
            COMMANDING,
            "**",
            "network.**",
            "network.*.mine.score",
            "network.anomaly.*.score",
        )
    ]
    wanted.append({"key": [FOREIGN, MINE]})
    wanted.append({"key": [MINE, FOREIGN]})
    for asked in wanted:
        assert _asked(served, mine, **asked).status_code == 403, asked
    paths = {getattr(route, "path", "") for route in application(north).routes}
    others = sorted(paths - {"/get", "/metrics", "/observe"})
    assert {"/apps", "/health", "/flow", "/openapi.json", "/apps/{app_id}/history"} <= set(others)
    for path in others:
        assert _asked(served, mine, path.replace("{app_id}", "mine")).status_code == 403, path
    live = served.url.replace("http", "ws") + f"/observe?key={MINE}"
    with pytest.raises(InvalidStatus), connect(live, additional_headers=mine):
        pass
    assert served.unauthorized == len(wanted) + len(others) + 1, "each is counted"
    assert "mine may not read that key" in caplog.text


def test_who_may_read_nothing_and_who_is_removed_is_nobody(served: Api, identities: Identities) -> None:
    assert _asked(served, _headers(identities, "blind"), key=MINE).status_code == 401
    mine = _headers(identities, "mine")
    assert _asked(served, mine, key=MINE).status_code == 200
    with identities.changing():
        identities.remove("mine")
    assert _asked(served, mine, key=MINE).status_code == 401


@pytest.mark.parametrize(
    "text", ["", "[]", '{"mine": {"digest": "x", "read": ["a..b"]}}', '{"a": {}}', "x" * 99]
)
def test_a_damaged_file_lets_nobody_read(tmp_path: Path, text: str, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / READERS
    path.write_text(text)
    readers = ArchiveReaders(path)
    assert readers.of(b"x") is None
    assert readers.of(b"") is None
    assert caplog.text.count("no app may read") == 1


def test_no_password_stands_in_the_file(identities: Identities, tmp_path: Path) -> None:
    path = tmp_path / READERS
    assert path.stat().st_mode & 0o777 == 0o600
    assert identities.all["mine"].password not in path.read_text()
    assert "blind" not in path.read_text()
