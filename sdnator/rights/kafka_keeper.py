"""Keeps users and access-control entries on Kafka as the identities say.

Brokers write refusals into logs of their own (`kafka.authorizer.logger`); no question to them brings them here. An app
of ours that is refused something counts it and says so itself.
"""

import time
from collections.abc import Mapping
from functools import cached_property
from typing import Any

from confluent_kafka.admin import (
    AclBinding,
    AclBindingFilter,
    AclOperation,
    AclPermissionType,
    AdminClient,
    ResourcePatternType,
    ResourceType,
    ScramCredentialInfo,
    ScramMechanism,
    UserScramCredentialDeletion,
    UserScramCredentialUpsertion,
)

from due.drivers.kafka_names import KafkaAddress, parse_kafka_url, translated
from due.drivers.kafka_rights import KafkaRight, kafka_rights, publishers
from due.errors import BackendError, UpdatesUnavailable
from sdnator.errors import PipelineError
from sdnator.rights.watching_keeper import RightsRefused, WatchingKeeper

_CALL_SECONDS = 10.0
_ITERATIONS = 4096
"""The least that brokers take; passwords are random, not chosen by people."""
_USER = "User:"


class KafkaRightsKeeper(WatchingKeeper):
    """Watches one cluster.

    Args:
        url: of the brokers, with the credential of a super user.
        identities: who may do what.
    """

    _away = (BackendError,)

    def apply(self) -> None:
        """See `WatchingKeeper.apply`."""
        try:
            self._take_up()
        except UpdatesUnavailable as error:
            raise PipelineError(f"Data Updates: {error}") from None
        except BackendError as error:
            raise RightsRefused(str(error)) from None

    @cached_property
    def _address(self) -> KafkaAddress:
        return parse_kafka_url(self._url)

    @cached_property
    def _admin(self) -> Any:  # its stubs know few of these calls
        return AdminClient(self._address.client())

    def _make(self) -> None:
        all_rights = {name: one.rights for name, one in self._identities.all.items()}
        apps = publishers(all_rights.values())
        there = self._entries()
        wanted = {
            (self._identities.prefix + name, right)
            for name, rights in all_rights.items()
            for right in kafka_rights(rights, self._address, apps)
        }
        self._make_users({user for user, _ in there} - {user for user, _ in wanted})
        if fresh := [AclBinding(*_places(*one)) for one in sorted(wanted - there)]:
            self._call("rights", self._admin.create_acls(fresh))
        if gone := [AclBindingFilter(*_places(*one)) for one in sorted(there - wanted)]:
            self._call("rights", self._admin.delete_acls(gone))

    def _make_users(self, gone: set[str]) -> None:
        """Who is gone is known by what stands for it: the client's question for users aborts the process."""
        kind = ScramMechanism.SCRAM_SHA_512
        info = ScramCredentialInfo(kind, _ITERATIONS)
        changes: list[Any] = [
            UserScramCredentialUpsertion(self._identities.prefix + name, info, one.password.encode())
            for name, one in self._identities.all.items()
        ]
        changes += [UserScramCredentialDeletion(name, kind) for name in sorted(gone)]
        self._call("users", self._admin.alter_user_scram_credentials(changes))

    def _entries(self) -> set[tuple[str, KafkaRight]]:
        """Users of this installation, and what stands for them."""
        anything: Any = None  # the stubs know no wildcard
        everything = AclBindingFilter(
            ResourceType.ANY,
            anything,
            ResourcePatternType.ANY,
            anything,
            anything,
            AclOperation.ANY,
            AclPermissionType.ANY,
        )
        future = self._admin.describe_acls(everything)
        found = translated(lambda: future.result(_CALL_SECONDS), "rights")
        prefix = _USER + self._identities.prefix
        return {
            (
                one.principal.removeprefix(_USER),
                KafkaRight(
                    one.restype.name,
                    one.name,
                    one.resource_pattern_type == ResourcePatternType.PREFIXED,
                    one.operation.name,
                ),
            )
            for one in found
            if one.principal.startswith(prefix)
        }

    def _call(self, what: str, futures: Mapping[Any, Any]) -> None:
        deadline = time.monotonic() + _CALL_SECONDS
        for future in futures.values():
            left = max(0.1, deadline - time.monotonic())
            translated(lambda future=future, left=left: future.result(left), what)  # type: ignore[misc]


def _places(user: str, right: KafkaRight) -> tuple[Any, ...]:
    pattern = ResourcePatternType.PREFIXED if right.begins else ResourcePatternType.LITERAL
    return (
        *(ResourceType[right.resource], right.name, pattern, _USER + user, "*"),
        *(AclOperation[right.operation], AclPermissionType.ALLOW),
    )
