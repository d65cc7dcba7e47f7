"""A double of MongoDB's mongos in front of two servers, for there is no sharded cluster here.

    driver ─► router ─┬─ nx-27017, shard 0
                      └─ nx-27017, shard 1

It says in `hello` that it is one, and does with the driver's commands what MongoDB documents of mongos: a document goes
to one shard by its shard key, every value of which is a chunk of its own here; a unique index holds within a shard only; an
upsert has to name the whole shard key.  Not shown: chunks that move, elections, transactions, cursors over several batches.
"""

import socketserver
import struct
import threading
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import bson
from pymongo import MongoClient
from pymongo.errors import OperationFailure

from tests.due.drivers.mongo_server import PATIENT, nx_server

Document = dict[str, Any]
_OP_REPLY, _OP_QUERY, _OP_MSG = 1, 2004, 2013
_HEADER = struct.Struct("<iiii")
_HELLO = {
    "helloOk": True,
    "ismaster": True,
    "isWritablePrimary": True,
    "msg": "isdbgrid",
    "maxBsonObjectSize": 16 << 20,
    "maxMessageSizeBytes": 48_000_000,
    "maxWriteBatchSize": 100_000,
    "minWireVersion": 0,
    "maxWireVersion": 21,
    "ok": 1,
}
_HELLOS = ("hello", "ismaster", "isMaster")
_UNAUTHORIZED, _OTHER_KEY, _NO_COLLECTION, _NO_SHARD_KEY = 13, 23, 26, 61


class MongoRouter:
    """Routes commands to shards.

    Args:
        shards: URLs of the servers.
    """

    def __init__(self, shards: Sequence[str]) -> None:
        self._clients = [MongoClient[Document](url) for url in shards]
        self.sharded: dict[str, Mapping[str, Any]] = {}
        """Shard key by namespace."""
        self.commands: list[Document] = []
        """What came, in order, without what belongs to the connection."""
        self.scattered: list[Document] = []
        """Commands that no shard key led to some shards only."""
        self.forbidden: tuple[str, ...] = ()
        """Commands that this user may not give."""

    def close(self) -> None:
        """Close the connections to the shards."""
        for client in self._clients:
            client.close()

    def answer(self, command: Document) -> Document:
        """The reply to a command."""
        name, database = next(iter(command)), command.pop("$db", "admin")
        for extra in [field for field in command if field.startswith("$") or field == "lsid"]:
            del command[extra]
        if name in _HELLOS:
            return dict(_HELLO)
        if name in ("ping", "endSessions", "killCursors"):
            return {"ok": 1}
        self.commands.append(command)
        if name in self.forbidden:
            return _error(_UNAUTHORIZED, f"not authorized on {database} to execute command {name}")
        handler = getattr(self, f"_{name}", None)
        if handler is None:
            return _error(59, f"the router knows no {name}")
        try:
            answered: Document = handler(command, database)
        except OperationFailure as error:
            return dict(error.details or {"ok": 0, "errmsg": str(error), "code": error.code})
        return answered

    def documents(self, database: str, collection: str) -> list[list[Document]]:
        """Documents of a collection, by shard."""
        return [list(client[database][collection].find({})) for client in self._clients]

    def _enableSharding(self, _command: Document, _database: str) -> Document:
        return {"ok": 1}

    def _shardCollection(self, command: Document, _database: str) -> Document:
        where = command["shardCollection"]
        database, _, collection = where.partition(".")
        if self.sharded.setdefault(where, command["key"]) != command["key"]:
            return _error(_OTHER_KEY, "already sharded by another key")
        for client in self._clients:
            if collection not in client[database].list_collection_names():
                client[database].create_collection(collection)
        return {"ok": 1}

    def _collStats(self, command: Document, database: str) -> Document:
        where = f"{database}.{command['collStats']}"
        if not any(
            command["collStats"] in client[database].list_collection_names() for client in self._clients
        ):
            return _error(_NO_COLLECTION, f"collection {where} not found")
        told = [client[database].command(command).get("size", 0) for client in self._clients]
        return {"ok": 1, "sharded": where in self.sharded, "size": sum(told)}

    def _createIndexes(self, command: Document, database: str) -> Document:
        key = self.sharded.get(f"{database}.{command['createIndexes']}", {})
        for index in command["indexes"]:
            unique = index.get("unique") and list(index["key"])[: len(key)] != list(key)
            if unique:
                return _error(67, f"a unique index has to begin with the shard key {dict(key)}")
            if "hashed" in index["key"].values():  # the servers behind know none
                return {"ok": 1}
        for client in self._clients:
            client[database].command(command)
        return {"ok": 1}

    def _listCollections(self, _command: Document, database: str) -> Document:
        names = {name for client in self._clients for name in client[database].list_collection_names()}
        batch = [{"name": name, "type": "collection"} for name in sorted(names)]
        return {"ok": 1, "cursor": {"id": 0, "ns": f"{database}.$cmd.listCollections", "firstBatch": batch}}

    def _insert(self, command: Document, database: str) -> Document:
        where = f"{database}.{command['insert']}"
        count, faults = 0, []
        for number, document in enumerate(command["documents"]):
            shard = self._clients[self._shard_of(where, document)]
            told = shard[database].command({"insert": command["insert"], "documents": [document]})
            count += told["n"]
            faults += [{**fault, "index": number} for fault in told.get("writeErrors", ())]
        return {"ok": 1, "n": count, **({"writeErrors": faults} if faults else {})}

    def _find(self, command: Document, database: str) -> Document:
        where, criteria = f"{database}.{command['find']}", command.get("filter", {})
        self._note(command, where, criteria)
        found = [
            document
            for client in self._shards(where)
            for document in client[database][command["find"]].find(criteria, command.get("projection"))
        ]
        for field, direction in reversed(list(command.get("sort", {}).items())):
            found.sort(key=lambda one, field=field: one[field], reverse=direction < 0)  # type: ignore[misc]
        found = found[: command.get("limit") or None]
        return {"ok": 1, "cursor": {"id": 0, "ns": where, "firstBatch": found}}

    def _update(self, command: Document, database: str) -> Document:
        where = f"{database}.{command['update']}"
        counts = {"n": 0, "nModified": 0}
        for one in command["updates"]:
            if where in self.sharded and not all(_is_equal(one["q"], field) for field in self.sharded[where]):
                return _error(_NO_SHARD_KEY, "the filter of an update has to name the shard key")
            plain = {
                name: value["$eq"] if isinstance(value, dict) else value for name, value in one["q"].items()
            }
            told = self._clients[self._shard_of(where, plain)][database].command(
                {"update": command["update"], "updates": [one]}
            )
            counts = {name: count + told.get(name, 0) for name, count in counts.items()}
        return {"ok": 1, **counts}

    def _delete(self, command: Document, database: str) -> Document:
        where, count = f"{database}.{command['delete']}", 0
        for one in command["deletes"]:
            self._note(command, where, one["q"])
            if (
                where in self.sharded
                and one["limit"]
                and not all(_is_equal(one["q"], field) for field in self.sharded[where])
            ):
                return _error(_NO_SHARD_KEY, "the filter of a single delete has to name the shard key")
            for client in self._shards(where):
                count += client[database].command({"delete": command["delete"], "deletes": [one]})["n"]
        return {"ok": 1, "n": count}

    def _note(self, command: Document, where: str, criteria: Mapping[str, Any]) -> None:
        if where in self.sharded and next(iter(self.sharded[where])) not in criteria:
            self.scattered.append(command)

    def _shards(self, where: str) -> list[MongoClient[Document]]:
        return self._clients if where in self.sharded else self._clients[:1]

    def _shard_of(self, where: str, document: Mapping[str, Any]) -> int:
        """A collection that is not sharded lives on the first."""
        if where not in self.sharded:
            return 0
        values = "|".join(str(document.get(field)) for field in self.sharded[where])
        return zlib.crc32(values.encode()) % len(self._clients)


def _is_equal(criteria: Mapping[str, Any], field: str) -> bool:
    test = criteria.get(field)
    return field in criteria and (not isinstance(test, dict) or set(test) == {"$eq"})


def _error(code: int, text: str) -> Document:
    return {"ok": 0, "code": code, "errmsg": text}


class _Connection(socketserver.StreamRequestHandler):
    """One client's connection."""

    def handle(self) -> None:
        router: MongoRouter = self.server.router  # type: ignore[attr-defined]
        while header := self.rfile.read(_HEADER.size):
            length, request, _, code = _HEADER.unpack(header)
            body = self.rfile.read(length - _HEADER.size)
            command = _message(body) if code == _OP_MSG else _legacy(body)
            answer = bson.encode(router.answer(command))
            if code == _OP_MSG:
                head, code = struct.pack("<IB", 0, 0), _OP_MSG
            else:
                head, code = struct.pack("<iqii", 8, 0, 0, 1), _OP_REPLY
            self.wfile.write(
                _HEADER.pack(_HEADER.size + len(head) + len(answer), 1, request, code) + head + answer
            )


def _message(body: bytes) -> Document:
    """The command of an OP_MSG, with its sequences of documents."""
    place, found = 4, Document()
    while place < len(body):
        kind, (size,) = body[place], struct.unpack_from("<i", body, place + 1)
        section = body[place + 1 : place + 1 + size]
        if kind == 0:
            found = {**bson.decode(section), **found}
        else:
            name, _, rest = section[4:].partition(b"\0")
            found[name.decode()] = bson.decode_all(rest)
        place += 1 + size
    return found


def _legacy(body: bytes) -> Document:
    """The command of an OP_QUERY, with which clients say hello."""
    return bson.decode(body[body.index(b"\0", 4) + 1 + 8 :])


class _Server(socketserver.ThreadingTCPServer):
    daemon_threads = True
    router: MongoRouter


@contextmanager
def mongo_router(folder: Path) -> Iterator[tuple[str, MongoRouter]]:
    """URL of a database behind a router with two shards, and the router."""
    with ExitStack() as stack:
        urls = []
        for number in range(2):
            place = folder / f"shard{number}"
            place.mkdir()
            urls.append(f"{stack.enter_context(nx_server(place))}?{PATIENT}")
        router = MongoRouter(urls)
        stack.callback(router.close)
        server = stack.enter_context(_Server(("127.0.0.1", 0), _Connection))
        server.router = router
        threading.Thread(target=server.serve_forever, daemon=True).start()
        stack.callback(server.shutdown)
        yield f"mongodb://127.0.0.1:{server.server_address[1]}/due_test", router
