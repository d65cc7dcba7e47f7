"""Real brokers refuse an app everything but its own: TLS, a user for each app, and entries from its grants."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from confluent_kafka import (
    Consumer,
    ConsumerGroupTopicPartitions,
    KafkaException,
    Producer,
    TopicPartition,
)
from confluent_kafka.admin import (
    AclBinding,
    AclBindingFilter,
    AclOperation,
    AclPermissionType,
    AdminClient,
    AlterConfigOpType,
    ConfigEntry,
    ConfigResource,
    NewPartitions,
    NewTopic,
    OffsetSpec,
    ResourcePatternType,
    ResourceType,
    ScramCredentialInfo,
    ScramMechanism,
    UserScramCredentialUpsertion,
)

from due import CONSUMER, PRODUCER, PUB_ONLY, Capability, Engine, Options
from due.drivers.base import own_group
from due.drivers.kafka_names import parse_kafka_url
from due.drivers.redis_rights import Rights
from sdnator.rights.granting import DANGEROUS
from sdnator.rights.identities import Identities, made
from sdnator.rights.kafka_keeper import KafkaRightsKeeper
from sdnator.rights.watching_keeper import RightsRefused
from sdnator.testing.kafka_servers import KafkaMissing, KafkaServers
from tests.due.conftest import wait_for
from tests.requirements import missing

MINE = Rights(app="mine", publish=("network.anomaly.mine.**",), observe=("network.open.*.*",))
KITSUNE = Rights(
    app="kitsune",
    publish=("network.*.kitsune.**", *(f"network.{one}.firewall.*" for one in DANGEROUS)),
    observe=("network.anomaly.mine.**",),
)
OWN, FOREIGN = "network.anomaly.mine.score", "network.anomaly.kitsune.score"
_SECONDS = 30
_REFUSED = ("authoriz", "no leaders found")
"""The second: of a topic that one may not describe, brokers do not tell who leads it."""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[KafkaServers, Identities]]:
    folder = tmp_path_factory.mktemp("kafka")
    try:
        servers = KafkaServers(folder / "servers", secured=True).start()
    except KafkaMissing as reason:
        missing(str(reason))
    try:
        identities = made(folder, {"mine": MINE, "kitsune": KITSUNE})
        keeper = KafkaRightsKeeper(servers.admin_url, identities)
        keeper.apply()
        yield servers, identities
    finally:
        servers.stop()


def _engine(url: str, folder: Path, app: str, *reliable: str) -> Engine:
    folder.mkdir(exist_ok=True)
    options = Options(
        updates=url,
        archive=f"sqlite://{folder}/{app}.db",
        directory=str(folder / app),
        coordinated=False,
    )
    engine = Engine(options)
    told = [Capability(key, delivery="reliable") for key in reliable]
    engine.init(app, PRODUCER | CONSUMER, capabilities=told)
    return engine


def test_apps_speak_over_tls_with_users_and_each_says_its_own_only(place, tmp_path, caplog):
    servers, identities = place
    mine = _engine(identities.url(servers.url, "mine"), tmp_path, "mine", OWN, FOREIGN)
    kitsune = _engine(identities.url(servers.url, "kitsune"), tmp_path, "kitsune", FOREIGN)
    heard, seen = [], []
    kitsune.observe("network.anomaly.mine.**").subscribe(lambda item: heard.append(item.value))
    mine.observe(FOREIGN).subscribe(lambda item: seen.append(item.value))
    mine.observe("network.open.kitsune.door").subscribe(lambda item: seen.append(item.value))
    for number in range(3):
        mine.write(OWN, number, [PUB_ONLY])
        mine.write("network.anomaly.mine.quick", number, [PUB_ONLY])
        mine.write(FOREIGN, -1, [PUB_ONLY])
        mine.write("network.block.firewall.ipv4", -1, [PUB_ONLY])
    kitsune.write(FOREIGN, "secret", [PUB_ONLY])
    kitsune.write("network.open.kitsune.door", "open", [PUB_ONLY])
    for engine in (mine, kitsune):
        engine.flush()
    wait_for(lambda: sorted(heard) == [0, 0, 1, 1, 2, 2] and seen == ["open"])
    assert mine.health()["updates"]["denied"] >= 2, "a frame carries several"
    wait_for(lambda: mine.health()["receiving"]["paths_denied"] >= 1)
    assert "mine has no right to network.block.firewall.ipv4" in caplog.text
    for engine in (mine, kitsune):
        engine.close()
    assert "secret" not in seen


def test_who_is_removed_or_has_no_password_is_not_heard(place):
    servers, identities = place
    for url in (servers.url, servers.url.replace("://", "://mine:guess@")):
        with pytest.raises(KafkaException):
            AdminClient(parse_kafka_url(url).client(log_level=0)).list_topics(timeout=3)
    with identities.changing():
        identities.put("guest", Rights(app="guest", publish=("a.b.guest",)), enrolled=True)
    keeper = KafkaRightsKeeper(servers.admin_url, identities)
    keeper.apply()
    guest = identities.url(servers.url, "guest")
    AdminClient(parse_kafka_url(guest).client()).list_topics(timeout=_SECONDS)
    with identities.changing():
        identities.remove("guest")
    keeper.apply()
    with pytest.raises(KafkaException):
        AdminClient(parse_kafka_url(guest).client(log_level=0)).list_topics(timeout=3)
    refused = KafkaRightsKeeper(identities.url(servers.url, "mine"), identities)
    with pytest.raises(RightsRefused):
        refused.apply()


def _verbs(admin: AdminClient, topic: str) -> Iterator[tuple[str, Any]]:
    """Every verb of the administrator's interface on a topic that is not the app's; the answer is a future."""
    place = TopicPartition(topic, 0, 0)
    resource = ConfigResource(ConfigResource.Type.TOPIC, topic)
    entry = ConfigEntry("retention.ms", "1", incremental_operation=AlterConfigOpType.SET)
    changed = ConfigResource(ConfigResource.Type.TOPIC, topic, incremental_configs=[entry])
    yield "create", admin.create_topics([NewTopic(topic, 1, 1)], request_timeout=_SECONDS)[topic]
    yield "delete", admin.delete_topics([topic], request_timeout=_SECONDS)[topic]
    yield "grow", admin.create_partitions([NewPartitions(topic, 64)], request_timeout=_SECONDS)[topic]
    yield "read settings", admin.describe_configs([resource], request_timeout=_SECONDS)[resource]
    yield "change settings", admin.incremental_alter_configs([changed], request_timeout=_SECONDS)[changed]
    yield "delete records", admin.delete_records([place], request_timeout=_SECONDS)[place]
    yield "ask for ends", admin.list_offsets({place: OffsetSpec.latest()}, request_timeout=_SECONDS)[place]


def _group_verbs(admin: AdminClient, group: str, topic: str) -> Iterator[tuple[str, Any]]:
    """What ends another app's group, or moves it."""
    moved = ConsumerGroupTopicPartitions(group, [TopicPartition(topic, 0, 0)])
    yield "delete group", admin.delete_consumer_groups([group], request_timeout=_SECONDS)[group]
    yield "move group", admin.alter_consumer_group_offsets([moved], request_timeout=_SECONDS)[group]


def _cluster_verbs(admin: AdminClient) -> Iterator[tuple[str, Any]]:
    """What changes rights, users and brokers."""
    kind, name = ScramMechanism.SCRAM_SHA_512, "mine2"
    user = UserScramCredentialUpsertion(name, ScramCredentialInfo(kind, 4096), b"secret")
    right = AclBinding(
        *(ResourceType.TOPIC, "due.", ResourcePatternType.PREFIXED, "User:mine", "*"),
        *(AclOperation.ALL, AclPermissionType.ALLOW),
    )
    gone = AclBindingFilter(
        *(ResourceType.TOPIC, "due.control.kitsune", ResourcePatternType.ANY, "User:kitsune", "*"),
        *(AclOperation.ANY, AclPermissionType.ANY),
    )
    entry = ConfigEntry("log.retention.ms", "1", incremental_operation=AlterConfigOpType.SET)
    broker = ConfigResource(ConfigResource.Type.BROKER, "0", incremental_configs=[entry])
    yield "make a user", admin.alter_user_scram_credentials([user], request_timeout=_SECONDS)[name]
    yield "grant", admin.create_acls([right], request_timeout=_SECONDS)[right]
    yield "revoke", admin.delete_acls([gone], request_timeout=_SECONDS)[gone]
    yield "change a broker", admin.incremental_alter_configs([broker], request_timeout=_SECONDS)[broker]


def _rights_seen(url: str) -> list[Any]:
    """What is told of who may do what; the client makes an empty list of a refusal."""
    anything: Any = None  # the stubs know no wildcard
    everything = AclBindingFilter(
        *(ResourceType.ANY, anything, ResourcePatternType.ANY, anything, anything),
        *(AclOperation.ANY, AclPermissionType.ANY),
    )
    admin: Any = AdminClient(parse_kafka_url(url).client(log_level=0))
    try:
        return list(admin.describe_acls(everything, request_timeout=_SECONDS).result(_SECONDS))
    except KafkaException as error:
        assert any(word in str(error).lower() for word in _REFUSED)  # noqa: PT017 - the other way to say so
        return []


def _through(attempts: Iterator[tuple[str, Any]]) -> list[str]:
    """The verbs that were not refused for want of a right."""
    found = []
    for verb, future in attempts:
        try:
            answer = future.result(_SECONDS)
        except KafkaException as error:
            said = [str(error)]
        else:  # positions of groups are refused one by one
            said = [str(one.error) for one in getattr(answer, "topic_partitions", None) or ()]
        if not said or not all(any(word in text.lower() for word in _REFUSED) for text in said):
            found.append(f"{verb}: {said}")
    return found


def _said(url: str, topic: str) -> str:
    """What the broker says to a record."""
    said: list[Any] = []
    producer = Producer(parse_kafka_url(url).client(log_level=0, **{"message.timeout.ms": _SECONDS * 1000}))
    producer.produce(topic, b"x", on_delivery=lambda error, _message: said.append(error))
    producer.flush(_SECONDS)
    return str(said[0])


def _heard(url: str, topic: str, group: str) -> str:
    """What the broker says to a reader of a topic, as a member of a group."""
    settings = {"group.id": group, "auto.offset.reset": "earliest", "enable.auto.commit": False}
    consumer = Consumer(parse_kafka_url(url).client(log_level=0, **settings))
    try:
        consumer.subscribe([topic])
        deadline = time.monotonic() + _SECONDS
        while time.monotonic() < deadline:
            message = consumer.poll(1.0)
            if message is not None:
                return str(message.error() or "heard something")
        return "heard nothing"
    finally:
        consumer.close()


def test_every_verb_on_what_is_another_apps_is_refused(place):
    """Topics of both kinds and of every family that commands, control and set-aside topics, groups, users, brokers."""
    servers, identities = place
    own, theirs = identities.url(servers.url, "mine"), identities.url(servers.url, "kitsune")
    address = parse_kafka_url(own)
    paths = (FOREIGN, *(f"network.{family}.firewall.ipv4" for family in DANGEROUS))
    topics = sorted({address.topic(path, reliable=kind) for path in paths for kind in (True, False)})
    topics += [address.aside("kitsune")]
    root = AdminClient(parse_kafka_url(servers.admin_url).client())
    there = root.list_topics(timeout=_SECONDS).topics
    made = root.create_topics([NewTopic(one, 1, 1) for one in topics if one not in there])
    for future in made.values():
        future.result(_SECONDS)
    admin = AdminClient(address.client(log_level=0))
    for topic in topics:
        assert _through(_verbs(admin, topic)) == [], topic
    # whom there is, and on which topics, is told to everybody
    assert (
        _through(one for one in _verbs(admin, address.control("kitsune")) if one[0] != "ask for ends") == []
    )
    for group in ("kitsune", own_group("kitsune", "i1")):
        assert _through(_group_verbs(admin, address.group(group), topics[0])) == []
    assert _through(_cluster_verbs(admin)) == []
    assert _rights_seen(servers.admin_url)
    assert _rights_seen(own) == []
    for topic in (topics[0], address.control("kitsune"), address.aside("kitsune")):
        assert "authoriz" in _said(own, topic).lower(), topic
    assert "authoriz" in _heard(own, topics[0], address.group("mine")).lower()
    assert "authoriz" in _heard(own, address.control("kitsune"), address.group("kitsune")).lower()
    mine = address.topic(OWN, reliable=False)
    assert _said(own, mine) == "None", "its own goes through"
    for group in ("kitsune", own_group("kitsune", "i1")):
        assert _heard(theirs, mine, address.group(group)) == "heard something", "and so does who may"
