"""Users and roles on a MongoDB server: each app writes collections of its own, and reads those that it is granted.

read network.anomaly.kitsune.*   ─►  find on items__kitsune: rights end at the app, as collections do
"""

import secrets
from collections.abc import Mapping
from typing import Any
from urllib.parse import quote, urlsplit, urlunsplit

from pymongo import MongoClient
from pymongo.errors import ConnectionFailure, OperationFailure, PyMongoError

from due.drivers.mongodb_apps import collections_of, of_app, shard_keys_of
from due.drivers.mongodb_sharding import shard
from due.drivers.redis_rights import EVERYTHING, Rights
from due.keys import Key
from sdnator.errors import PipelineError
from sdnator.rights.granting import OPERATOR
from sdnator.rights.identities import Identities
from sdnator.rights.watching_keeper import RightsRefused, WatchingKeeper

_CALL_MS = 5000
_COORDINATOR = "coordinator"
"""Prunes the archives of all."""
_OPERATORS = (f"network.*.{OPERATOR}.**",)
_WRITES = ("find", "insert", "update", "createCollection", "createIndex", "listIndexes", "collStats")
_DELETES = ("remove", "update", "insert", "collStats")
Privilege = dict[str, Any]


def privileges(name: str, everybody: Mapping[str, Rights], database: str) -> list[Privilege]:
    """What one identity's role may do.

    Args:
        name: of the identity.
        everybody: rights by name.
        database: where the collections are.
    """
    found: dict[str, set[str]] = {}
    for collection in collections_of(name):
        found[collection] = set(_WRITES)
    for other, rights in everybody.items():
        if other != name and not _reads(everybody[name], rights):
            continue
        for collection in collections_of(other):
            found.setdefault(collection, set()).add("find")
            if name == _COORDINATOR:
                found[collection] |= set(_DELETES)
    if name in (OPERATOR, _COORDINATOR):  # what apps shared before each had its own
        for collection in collections_of(""):
            found[collection] = {"find", *(_DELETES if name == _COORDINATOR else ())}
    return [
        {"resource": {"db": database, "collection": collection}, "actions": sorted(actions)}
        for collection, actions in sorted(found.items())
    ]


def _reads(reader: Rights, writer: Rights) -> bool:
    """Whether one may read something that the other publishes."""
    # the operator may publish anything, but speaks under its own name
    published = _OPERATORS if EVERYTHING in writer.publish else writer.publish
    return any(
        wanted == EVERYTHING or Key.parse(told).offers(Key.parse(Key.parse(wanted).path))
        for wanted in reader.read
        for told in published
    )


def apps_url(url: str, identities: Identities, name: str) -> str:
    """The archive's URL with an identity's user, password and collections."""
    parts = urlsplit(url)
    user, password = identities.prefix + name, quote(identities.all[name].password, safe="")
    options = parts.query + ("&" if parts.query else "") + f"authSource={_database(url)}"
    netloc = f"{user}:{password}@{parts.netloc.rpartition('@')[2]}"
    return of_app(urlunsplit(parts._replace(netloc=netloc, query=options)), name)


def _database(url: str) -> str:
    return urlsplit(url).path.strip("/") or "due"


class MongoRightsKeeper(WatchingKeeper):
    """Makes users and roles in the archive's database, and shards their collections on a cluster.

    Args:
        url: of the archive, with the credential of whoever may make users and roles there (`userAdmin`).
        identities: who may do what.
    """

    _away = (PyMongoError, RightsRefused)

    def apply(self) -> None:
        """See `WatchingKeeper.apply`; refused, too, where the server has no users or does not enforce rights."""
        try:
            self._take_up()
        except ConnectionFailure as error:
            raise PipelineError(f"Data Archives: {error}") from None
        except PyMongoError as error:
            raise RightsRefused(str(error)) from None
        self._check()

    def _make(self) -> None:
        with MongoClient[dict[str, Any]](self._url, serverSelectionTimeoutMS=_CALL_MS) as client:
            self._make_in(client[_database(self._url)])

    def _make_in(self, database: Any) -> None:
        rights = {name: one.rights for name, one in self._identities.all.items()}
        prefix = self._identities.prefix
        told = database.command("usersInfo")
        if "users" not in told:
            raise RightsRefused("the server has no users")
        users = {one["user"] for one in told["users"]}
        roles = {one["role"] for one in database.command("rolesInfo", 1)["roles"]}
        for name, one in self._identities.all.items():
            user, held = prefix + name, privileges(name, rights, database.name)
            database.command("updateRole" if user in roles else "createRole", user, privileges=held, roles=[])
            verb = "updateUser" if user in users else "createUser"
            database.command(verb, user, pwd=one.password, roles=[{"role": user, "db": database.name}])
        ours = {prefix + name for name in rights}
        for gone in sorted(user for user in users if user.startswith(prefix) and user not in ours):
            database.command("dropUser", gone)
        for gone in sorted(role for role in roles if role.startswith(prefix) and role not in ours):
            database.command("dropRole", gone)
        # no app may do so
        shard(database, {table: key for name in rights for table, key in shard_keys_of(name).items()})

    def _check(self) -> None:
        """A server that was started without authorization makes users, and lets everybody do everything."""
        parts = urlsplit(self._url)
        open_url = urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2]))
        try:
            with MongoClient[dict[str, Any]](open_url, serverSelectionTimeoutMS=_CALL_MS) as client:
                client[_database(self._url)][collections_of(secrets.token_hex(8))[0]].find_one()
        except OperationFailure:
            return
        except PyMongoError as error:
            raise PipelineError(f"Data Archives: {error}") from None
        raise RightsRefused("the server does not authenticate anybody: start mongod with --auth")
