"""Samples of digests: what is written can be read, and is what protobuf makes of it."""

from hypothesis import given
from hypothesis import strategies as st

from dataplane.compiler.samples import decode, varint
from dataplane.p4runtime.bytestrings import encode as canonical
from p4rt import p4runtime
from tests.naive.p4.sample_encoding import encode_sample as encode


@given(st.lists(st.integers(0, (1 << 512) - 1) | st.integers(0, 300), max_size=40))
def test_a_sample_is_an_element_of_a_digest_list(values):
    digest = p4runtime.DigestList.FromString(encode(values))
    assert [member.bitstring for member in digest.data[0].struct.members] == [canonical(v) for v in values]
    assert decode(encode(values)) == tuple(values)


@given(st.integers(0, (1 << 64) - 1))
def test_varint_is_that_of_protobuf(value):
    message = p4runtime.DigestList(list_id=value)
    assert message.SerializeToString() == (b"\x10" + varint(value) if value else b"")
