"""Values become canonical byte strings, and text that does not fit is refused with place and reason."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apps.p4runtime_ctrl.errors import EntryError
from apps.p4runtime_ctrl.southbound import values


@given(st.integers(0, (1 << 300) - 1))
def test_canonical_is_shortest_and_reversible(number):
    data = values.canonical(number)
    assert values.number(data) == number
    assert len(data) == 1 or data[0] != 0


@pytest.mark.parametrize(
    ("value", "width", "number"),
    [
        (5, 9, 5),
        (True, 1, 1),
        ("0x1f", 8, 31),
        ("80", 16, 80),
        ("10.0.0.1", 32, 0x0A000001),
        ("10.0.0.1", 128, 0x0A000001),
        ("2001:db8::1", 128, 0x20010DB8 << 96 | 1),
        ("02:00:00:00:00:0A", 48, 0x02000000000A),
        (b"\x01\x00", 16, 256),
    ],
)
def test_parse(value, width, number):
    assert values.parse(value, width, where="x") == number


@pytest.mark.parametrize(
    ("value", "width", "reason"),
    [
        (512, 9, "does not fit into 9 bits"),
        (-1, 9, "does not fit"),
        ("::1:0:0:0:0", 32, "does not fit into 32 bits"),
        ("no address", 32, "not a number"),
        (1.5, 9, "not a number, text or bytes"),
        ("1.2.3.400", 32, "not a number, MAC"),
    ],
)
def test_parse_refuses(value, width, reason):
    with pytest.raises(EntryError, match=f"the field: .*{reason}"):
        values.parse(value, width, where="the field")


def test_ipv4_prefixes_and_masks_count_from_the_low_bits():
    assert values.parse_prefix("10.0.0.0", 8, 128, where="x") == (0x0A000000, 104)
    found = values.parse_masked("10.0.0.0", "255.0.0.0", 128, where="x")
    assert found == (0x0A000000, (1 << 128) - (1 << 24))
    with pytest.raises(EntryError, match="bits beyond its prefix length 104"):
        values.parse_prefix("10.0.0.1", 8, 128, where="x")
    with pytest.raises(EntryError, match="over 32"):
        values.parse_prefix("10.0.0.0", 33, 128, where="x")
    with pytest.raises(EntryError, match="outside its mask"):
        values.parse_masked(3, 2, 8, where="x")


def test_values_are_shown_as_people_write_them():
    assert values.shown(0x02000000000A, 48) == "02:00:00:00:00:0a"
    assert values.shown(0x0A000001, 128) == "10.0.0.1"
    assert values.shown(0x20010DB8 << 96, 128) == "2001:db8::"
    assert values.shown(80, 16) == "80"
