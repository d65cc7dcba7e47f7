"""What a kafka:// URL says, and which topics a pattern can reach."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from due.drivers.kafka_names import may_hold, parse_kafka_url, topic_prefix
from due.errors import InvalidOption
from due.keys import Key

_SEGMENTS = st.lists(st.sampled_from(["a", "b", "c"]), min_size=1, max_size=5)


def test_a_url_names_brokers_namespace_and_options() -> None:
    """Ports are 9092 where none is given."""
    address = parse_kafka_url("kafka://one,two:9093/lab?partitions=8&replication=2&retention_hours=1")
    assert (address.servers, address.namespace) == ("one:9092,two:9093", "lab")
    assert (address.partitions, address.replication, address.retention_hours) == (8, 2, 1)


@pytest.mark.parametrize(
    "url",
    [
        "kafka://",
        "kafka://h:0",
        "kafka://h:x",
        "kafka://h/a/b",
        "kafka://h/%20",
        "kafka://user@h",
        "kafka://user:word@h?mechanism=PLAIN",
        "kafka://h?ssl_ca_certs=x",
        "kafkas://u:p@h?mechanism=MD5",
        "kafka://h?partitions=0",
        "kafka://h?replication=99",
        "kafka://h?acks=0",
        "redis://h",
    ],
)
def test_a_wrong_url_is_refused_and_named(url: str) -> None:
    """Also what other drivers would take."""
    with pytest.raises(InvalidOption):
        parse_kafka_url(url)


@given(
    path=_SEGMENTS,
    pattern=st.lists(st.sampled_from(["a", "b", "*"]), min_size=1, max_size=5),
    rest=st.booleans(),
)
def test_a_pattern_reaches_the_topic_of_every_path_it_matches(
    path: list[str], pattern: list[str], rest: bool
) -> None:
    """Otherwise a reader would never look into the topic."""
    text = ".".join([*pattern, "**"] if rest else pattern)
    whole = ".".join(path)
    if Key(text).matches_path(whole):
        assert may_hold(topic_prefix(whole), text)


def test_topics_of_other_capabilities_are_not_read() -> None:
    """A reader of one capability does not fetch another's payloads."""
    assert not may_hold("network.packets.other", "network.packets.mine.s1.all")
    assert not may_hold("network.packets.mine", "network.packets")
    assert may_hold("network.packets.mine", "network.packets.*.s1")
