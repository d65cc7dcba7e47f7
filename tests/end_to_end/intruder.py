"""Attacks on a running pipeline by another Unix user: `python -m tests.end_to_end.intruder`, all it knows on stdin.

Rights are dropped once everything is imported, so that the place of the checkout does not decide what comes out;
what libraries import late they import for attempts on doors that nobody has.
Each attempt ends in "through" or in the cause of its refusal; the owner runs the same program, to show that the
doors are there.
"""

import http.client
import json
import os
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import grpc
import redis

from coordinator.openapi import document
from due.drivers.redis_leases import lease_name
from due.drivers.redis_streams import stream_name, work_name
from due.drivers.redis_wire import client
from p4rt import P4RuntimeStub, p4runtime

THROUGH = "through"
OWN_KEY = "network.anomaly.mine.score"
COMMANDS = (
    "network.block.firewall.ipv4",
    "network.block.mine.ipv4",
    "network.allowed.mine.ipv4",
    "network.instruction.mine.operator",
    "network.p4_command.mine.s1",
    "network.packet_out.mine.s1",
    "due.assignment.firewall",
)
ALERTS = "network.anomaly.kitsune.alert"
FRAMES = "network.frames.p4runtime_ctrl.s1.all"
_REGEX = {"dataKey": {"$regex": r"^((\w|\.)+)+!$"}}
_TIMEOUT_S = 60.0
_ROLE = "intruder"
_UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}
_NOWHERE = "127.0.0.1:1"


def _attempt(deed: Callable[[], object]) -> str:
    try:
        deed()
    except grpc.RpcError as error:
        return f"{error.code().name}: {error.details()}"
    except (OSError, redis.RedisError, http.client.HTTPException) as error:
        return f"{type(error).__name__}: {error}"
    return THROUGH


def _request(place: str, path: str, headers: Mapping[str, str], form: bytes | None = None) -> None:
    connection = http.client.HTTPConnection(place, timeout=_TIMEOUT_S)
    try:
        connection.request("GET" if form is None else "POST", path, body=form, headers=dict(headers))
        status = connection.getresponse().status
    finally:
        connection.close()
    if status not in (http.HTTPStatus.OK, http.HTTPStatus.SWITCHING_PROTOCOLS):
        raise http.client.HTTPException(str(status))


def _bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"} if token else {}


def _by_http(place: str, token: str) -> dict[str, str]:
    """Whole frames, the query that once froze the Coordinator, and every path; /metrics has a token of its own."""
    rights = _bearer(token)
    query = quote(json.dumps(_REGEX))
    paths = [path.replace("{app_id}", "firewall") for path in document()["paths"] if path != "/metrics"]
    return {
        **{path: _attempt(partial(_request, place, path, rights)) for path in paths if path != "/get"},
        "archive": _attempt(lambda: _request(place, f"/get?key={ALERTS}", rights)),
        "frames": _attempt(lambda: _request(place, f"/observe?key={FRAMES}", rights | _UPGRADE)),
        "regex": _attempt(lambda: _request(place, f"/get?query={query}", rights)),
    }


def _by_page(place: str) -> dict[str, str]:
    """The page, what it is made of, its frames, and its sign-in with what anybody may guess."""
    origin = {"Origin": f"http://{place}", "Content-Type": "application/x-www-form-urlencoded"}
    upgrade = {**_UPGRADE, "Origin": f"http://{place}"}
    return {
        "page": _attempt(lambda: _request(place, "/", {})),
        "files": _attempt(lambda: _request(place, "/_nicegui/", {})),
        "frames": _attempt(
            lambda: _request(place, "/_nicegui_ws/socket.io/?EIO=4&transport=websocket", upgrade)
        ),
        "polled frames": _attempt(
            lambda: _request(place, "/_nicegui_ws/socket.io/?EIO=4&transport=polling", origin)
        ),
        "link": _attempt(lambda: _request(place, "/link/guess", {})),
        "sign in": _attempt(lambda: _request(place, "/sign-in", origin, b"name=owner&password=guess")),
        "sign in by the token": _attempt(
            lambda: _request(place, "/sign-in", origin, b"name=&password=guess")
        ),
    }


def _by_p4runtime(address: str) -> dict[str, str]:
    """Every wire deleted under a role of our own; the six bytes that ask for all registers."""
    with grpc.insecure_channel(address) as channel:
        stub = P4RuntimeStub(channel)
        claim = p4runtime.StreamMessageRequest()
        claim.arbitration.device_id = 1
        claim.arbitration.role.name = _ROLE
        claim.arbitration.election_id.low = 1

        def delete() -> None:
            answers = stub.StreamChannel(iter([claim]), timeout=_TIMEOUT_S)
            next(iter(answers))
            request = p4runtime.WriteRequest(device_id=1, role=_ROLE)
            request.election_id.low = 1
            request.updates.add(type=p4runtime.Update.DELETE).entity.table_entry.SetInParent()
            stub.Write(request, timeout=_TIMEOUT_S)

        def read() -> None:
            request = p4runtime.ReadRequest(device_id=1)
            request.entities.add().register_entry.SetInParent()
            next(iter(stub.Read(request, timeout=_TIMEOUT_S)))

        return {"wires": _attempt(delete), "registers": _attempt(read)}


def _by_updates(url: str) -> dict[str, str]:
    """What commands switches and apps, what shows frames, and what tells or changes passwords."""
    server = client(url)
    server_wide = (
        ("ACL", "LIST"),
        ("CONFIG", "GET", "requirepass"),
        ("PSUBSCRIBE", "*"),
        ("KEYS", "*"),
    )
    attempts: dict[str, tuple[str, ...]] = {" ".join(words): words for words in server_wide}
    for key in (*COMMANDS, OWN_KEY):
        attempts[f"publish {key}"] = ("PUBLISH", f"due:{key}", "x")
        attempts[f"add {key}"] = ("XADD", stream_name(key), "MAXLEN", "1", "*", "f", "x")
    attempts["observe frames"] = ("SUBSCRIBE", f"due:{FRAMES}")
    work, lease = work_name("firewall", ALERTS), lease_name("firewall", ALERTS)
    attempts["take the firewall's work"] = ("XREADGROUP", "GROUP", "firewall", "x", "STREAMS", work, ">")
    attempts["acknowledge for the firewall"] = ("XACK", work, "firewall", "1-1")
    attempts["leave for the firewall"] = ("HSET", lease, "x", "0")
    attempts["read frames"] = ("XRANGE", stream_name(FRAMES), "-", "+")
    try:
        return {name: _attempt(partial(server.execute_command, *words)) for name, words in attempts.items()}
    finally:
        server.close()


def _looked(folder: Path) -> dict[str, Any]:
    """Every file below a folder and every process that this user can look into."""
    files = [Path(place) / name for place, _, names in os.walk(folder) for name in names]
    readable = [str(path.relative_to(folder)) for path in files if _attempt(path.read_bytes) == THROUGH]
    said, environments = [], 0
    for process in Path("/proc").glob("[0-9]*"):
        if int(process.name) == os.getpid():
            continue
        with suppress(OSError):
            said.append((process / "cmdline").read_bytes().replace(b"\0", b" ").decode("utf-8", "replace"))
        with suppress(OSError):
            environments += bool((process / "environ").read_bytes())
    return {"readable": readable, "arguments": said, "environments": environments}


def main() -> None:
    """Become the user, try everything, tell."""
    told = json.load(sys.stdin)
    _by_http(_NOWHERE, "")
    _by_page(_NOWHERE)
    _by_p4runtime(f"unix:/{_NOWHERE}")
    _by_updates(f"redis://{_NOWHERE}")
    if told["uid"] != os.geteuid():
        os.setgroups([])
        os.setgid(told["uid"])
        os.setuid(told["uid"])
    url, token = told["updates"], told["token"]
    if told["credential"]:
        url = json.loads(Path(told["credential"]).read_bytes())["updates"]
        # whoever has one password tries it on every door
        token = url.partition("://")[2].rpartition("@")[0].partition(":")[2]
    found = {
        "http": _by_http(told["coordinator"], token),
        "page": _by_page(told["page"]),
        "metrics": {
            part: _attempt(partial(_request, place, "/metrics", _bearer(token)))
            for part, place in told["metrics"].items()
        },
        "p4runtime": _by_p4runtime(told["switch"]),
        "updates": _by_updates(url),
        "looked": _looked(Path(told["folder"])),
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
