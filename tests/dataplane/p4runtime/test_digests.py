"""Digest lists: distinct samples, complete by size or time, silent until acknowledged."""

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataplane.compiler.machine import Digest
from dataplane.compiler.samples import Samples
from dataplane.p4runtime.bytestrings import encode
from dataplane.p4runtime.digests import DigestLists, encode_list
from dataplane.p4runtime.schema import BoundDigest, Schema
from dataplane.p4runtime.status import Exists, InvalidArgument, MissingEntity
from p4rt import p4runtime
from tests.naive.p4.sample_encoding import encode_sample as sample

SECOND = 10**9


def joined(found):
    """Samples end to end, as the back end writes them."""
    ends = np.cumsum(np.fromiter(map(len, found), np.int64, len(found)))
    hashes = np.fromiter(map(hash, found), np.int64, len(found)).view(np.uint64)
    return Samples(b"".join(found), ends, hashes)


NOTE = BoundDigest(77, "note", (9, 48))


def lists(**config):
    made = DigestLists(Schema({}, {}, {}, {}, {77: NOTE}, {}, (), ()), wall_ns=lambda: 123)
    if config:
        made.write(p4runtime.Update.INSERT, entry(**config))
    return made


def entry(timeout=SECOND, size=3, ack=0, digest_id=77):
    message = p4runtime.DigestEntry(digest_id=digest_id)
    message.config.max_timeout_ns, message.config.max_list_size, message.config.ack_timeout_ns = (
        timeout,
        size,
        ack,
    )
    return message


def samples(*values):
    return [Digest("note", sample((value, 0))) for value in values]


def firsts(messages):
    """First member of every sample of every list."""
    found = [p4runtime.StreamMessageResponse.FromString(message).digest for message in messages]
    return [[int.from_bytes(d.struct.members[0].bitstring, "big") for d in digest.data] for digest in found]


@given(
    st.lists(st.tuples(st.integers(0, 511), st.integers(0, (1 << 200) - 1)), max_size=20),
    st.integers(1, 1 << 60),
)
def test_the_bytes_are_those_of_protobuf(values, number):
    message = p4runtime.StreamMessageResponse()
    message.digest.digest_id, message.digest.list_id, message.digest.timestamp = 77, number, 5
    for members in values:
        struct = message.digest.data.add().struct
        struct.SetInParent()
        for value in members:
            struct.members.add().bitstring = encode(value)
    assert (
        p4runtime.StreamMessageResponse.FromString(encode_list(NOTE, number, map(sample, values), 5))
        == message
    )


def test_without_a_configuration_samples_are_counted_and_dropped():
    made = lists()
    assert made.add(samples(1, 2), 0) == []
    assert made.unconfigured == 2


def test_a_list_is_sent_when_it_has_its_size():
    assert firsts(lists(size=3).add(samples(1, 2, 2, 3, 4), 0)) == [[1, 2, 3]]


def test_a_list_is_sent_when_its_first_sample_is_old_enough():
    made = lists(size=0)
    made.add(samples(1), 5)
    made.add(samples(2), 6)
    assert made.next_due_ns() == SECOND + 5
    assert made.due(SECOND + 4) == []
    assert firsts(made.due(SECOND + 5)) == [[1, 2]]
    assert made.next_due_ns() is None


@pytest.mark.parametrize("config", [{"timeout": 0, "size": 0}, {"timeout": 0, "size": 9}, {"size": 1}])
def test_unbuffered_samples_travel_alone(config):
    assert firsts(lists(**config).add(samples(1, 2), 0)) == [[1], [2]]


def test_sent_samples_stay_away_until_acknowledged_or_forgotten():
    made = lists(size=1, ack=10)
    (message,) = made.add(samples(1), 0)
    assert made.add(samples(1), 1) == []
    assert made.suppressed == 1
    made.acknowledge(77, p4runtime.StreamMessageResponse.FromString(message).digest.list_id)
    assert firsts(made.add(samples(1), 2)) == [[1]]
    made.due(12)
    assert firsts(made.add(samples(1), 13)) == [[1]]
    made.forget_sent()
    assert firsts(made.add(samples(1), 14)) == [[1]]


def test_lists_are_acknowledged_in_another_thread_while_they_are_made():
    made = lists(size=1, ack=10**9)
    made.add(samples(*range(400)), 0)
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(1) as other:
            done = other.submit(lambda: [made.acknowledge(77, number) for number in range(1, 401)])
            while not done.done():
                assert made.due(1) == []
    finally:
        sys.setswitchinterval(interval)
    assert len(made.add(samples(*range(400)), 2)) == 400, "all were acknowledged"


def test_without_an_ack_time_out_samples_repeat():
    made = lists(size=1)
    assert firsts(made.add(samples(1), 0) + made.add(samples(1), 1)) == [[1], [1]]


def test_configurations_are_entities():
    made = lists()
    with pytest.raises(MissingEntity):
        made.write(p4runtime.Update.MODIFY, entry())
    undo = made.write(p4runtime.Update.INSERT, entry(size=2))
    with pytest.raises(Exists):
        made.write(p4runtime.Update.INSERT, entry())
    undo_modify = made.write(p4runtime.Update.MODIFY, entry(size=9))
    assert [e.digest_entry.config.max_list_size for e in made.read(p4runtime.DigestEntry())] == [9]
    undo_modify()
    assert [e.digest_entry.config.max_list_size for e in made.read(entry())] == [2]
    undo()
    assert list(made.read(p4runtime.DigestEntry())) == []


@pytest.mark.parametrize("wrong", [{"digest_id": 5}, {"timeout": -1}, {"size": -1}, {"ack": -1}])
def test_wrong_configurations_are_refused(wrong):
    with pytest.raises(InvalidArgument):
        lists(**wrong)


def test_a_controller_that_acknowledges_nothing_does_not_fill_the_memory():
    """The oldest samples are forgotten, and may be sent again."""
    most = 9
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dataplane.p4runtime.digests.MAX_UNACKNOWLEDGED", most)
        made = lists(size=3, ack=1 << 60)
        sent = made.add(samples(*range(30)), 0)
        assert len(sent) == 10
        assert made.add(samples(*range(30 - most, 30)), 0) == []
        assert made.suppressed == most
        assert firsts(made.add(samples(0, 1, 2), 0)) == [[0, 1, 2]]


@given(st.lists(st.tuples(st.lists(st.integers(0, 9), max_size=12), st.sampled_from([0, SECOND]))))
def test_samples_of_a_block_outlive_other_configurations(steps):
    """The same lists, whatever the configuration is changed to while samples wait."""
    single, block = lists(size=5), lists(size=5)
    for number, (values, ack) in enumerate(steps):
        found = samples(*values)
        ready = single.add(found, number)
        assert block.add_samples("note", joined([each.sample for each in found]), number) == ready
        for made in (single, block):
            made.write(p4runtime.Update.MODIFY, entry(size=5, ack=ack))
        assert (block.suppressed, block.next_due_ns()) == (single.suppressed, single.next_due_ns())
        assert block.due(number) == single.due(number)


def test_different_samples_of_one_hash_are_different():
    made, alike = lists(size=3), joined([sample((value, 0)) for value in (1, 2, 3)])
    alike.hashes[:] = 7
    assert firsts(made.add_samples("note", alike, 0)) == [[1, 2, 3]]
    assert made.suppressed == 0


@given(st.lists(st.lists(st.integers(0, 9), max_size=12)), st.integers(1, 5), st.sampled_from([0, SECOND]))
def test_samples_of_a_block_are_taken_in_as_digests_one_by_one(batches, size, ack):
    """The same lists at the same time, and as many suppressed, whatever is acknowledged meanwhile."""
    single, block = lists(size=size, ack=ack), lists(size=size, ack=ack)
    for number, values in enumerate(batches):
        found = samples(*values)
        ready = single.add(found, number)
        assert block.add_samples("note", joined([each.sample for each in found]), number) == ready
        assert (block.suppressed, block.next_due_ns()) == (single.suppressed, single.next_due_ns())
        if number % 3 == 0:
            for made in (single, block):
                made.acknowledge(77, number)
    assert block.add_samples("unknown", [b"x"], 0) == []
    assert block.unconfigured == 1
