"""Addresses are written as inet_ntop writes them, which the kernel uses and tshark as well."""

import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apps.kitsune.names import ip_text, mac_text

WORDS = st.lists(st.sampled_from([0, 0, 0, 1, 0xFFFF, 0xFE80, 0x0A00]), min_size=8, max_size=8)


@given(WORDS)
def test_ipv6_equals_inet_ntop(words):
    packed = b"".join(word.to_bytes(2, "big") for word in words)
    hi, lo = int.from_bytes(packed[:8], "big"), int.from_bytes(packed[8:], "big")
    assert ip_text(6, hi, lo) == socket.inet_ntop(socket.AF_INET6, packed)


@given(st.integers(0, 2**32 - 1))
def test_ipv4_equals_inet_ntop(address):
    assert ip_text(4, 0, address) == socket.inet_ntop(socket.AF_INET, address.to_bytes(4, "big"))


@pytest.mark.parametrize(("mac", "text"), [(0, "00:00:00:00:00:00"), (0x5CCF7F05F2C6, "5c:cf:7f:05:f2:c6")])
def test_macs(mac, text):
    assert mac_text(mac) == text


def test_no_address_is_no_text():
    assert ip_text(0, 1, 2) == ""
