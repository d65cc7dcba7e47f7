"""Keys follow the grammar exactly: one canonical form, matching like the naive twin, errors that say where."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from due.errors import InvalidKey
from due.keys import MAX_BYTES, Key, canonical, decode, encode, matches
from tests.naive import keys as naive

segment = st.sampled_from("ab")
concrete_path = st.lists(segment, min_size=1, max_size=4).map(".".join)
pattern_path = st.builds(
    lambda body, tail: ".".join([*body, *tail]),
    st.lists(st.sampled_from(["a", "b", "*"]), min_size=1, max_size=3),
    st.sampled_from([[], ["**"]]),
)
item_specs = st.dictionaries(st.sampled_from("xy"), st.sampled_from("12"), max_size=2)
wanted_specs = st.dictionaries(st.sampled_from("xy"), st.sampled_from(["1", "2", "*", "1|2"]), max_size=2)


def _key(path: str, specs: dict[str, str]) -> str:
    return path + (":" + ",".join(f"{n}={v}" for n, v in specs.items()) if specs else "")


@given(pattern_path, wanted_specs, concrete_path, item_specs)
def test_matching_is_that_of_the_naive_twin(pattern, wanted, path, specs):
    assert matches(_key(pattern, wanted), _key(path, specs)) == naive.matches(
        _key(pattern, wanted), _key(path, specs)
    )


@given(pattern_path, pattern_path)
def test_a_capability_offers_what_some_path_satisfies(left, right):
    assert Key(left).offers(Key(right)) == naive.overlap(left, right, longest=5)
    assert Key(left).offers(Key(right)) == Key(right).offers(Key(left))


@given(st.text(max_size=40))
def test_any_text_is_a_key_or_an_invalid_key(text):
    try:
        key = Key(text)
    except InvalidKey as error:
        position = error.position
    else:
        position = 0
        assert Key(key.text) == key
        assert Key(key.text).text == key.text
    assert 0 <= position <= len(text)


@given(st.dictionaries(st.sampled_from(["a", "b", "c"]), st.text(max_size=8), min_size=1))
def test_any_value_can_be_a_spec(specs):
    key = Key("d.c.app").with_specs(**specs)
    assert {name: key.spec(name) for name in specs} == specs
    assert Key(key.text).text == key.text


@given(st.text(max_size=20))
def test_encoding_is_reversible(value):
    assert decode(encode(value)) == value


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("n.c.app.tcp:z=1,a=2", "n.c.app.tcp:a=2,z=1"),
        ("n.c.app:v=b|a|b", "n.c.app:v=a|b"),
        ("n.c.app:v=%41%2c%3a", "n.c.app:v=A%2C%3A"),
        ("n.c.app:v=", "n.c.app:v="),
    ],
)
def test_equal_keys_have_one_spelling(text, expected):
    assert canonical(text) == expected


@pytest.mark.parametrize(
    ("text", "position", "rule"),
    [
        ("", 0, "a segment is"),
        ("a..b", 2, "a segment is"),
        ("a.b c", 3, "a segment is"),
        ("a.**.b", 2, "'**' may only be the last"),
        ("a.b*", 3, "a segment is"),
        ("a.b:", 4, "a spec is name=value"),
        ("a.b:flag", 8, "has no '=value'"),
        ("a.b:x=1,x=2", 8, "given twice"),
        ("a.b:x=1 2", 7, "%20"),
        ("a.b:x=a*", 7, "%2A"),
        ("a.b:x=%4", 6, "two hexadecimal digits"),
        ("a.b:x=%ff", 6, "not UTF-8"),
        ("ä.b", 0, "a segment is"),
    ],
)
def test_an_error_names_key_position_and_rule(text, position, rule):
    with pytest.raises(InvalidKey) as caught:
        Key(text)
    assert (caught.value.key, caught.value.position) == (text, position)
    assert rule in caught.value.rule


def test_a_key_has_at_most_1024_bytes():
    assert Key("a" * MAX_BYTES)
    with pytest.raises(InvalidKey, match="1024 bytes"):
        Key("a" * (MAX_BYTES + 1))
    with pytest.raises(InvalidKey, match="1024 bytes"):
        Key("a:v=" + "ä" * 511)


def test_a_capability_offers_its_listed_values():
    capability = Key("n.c.sonata.tcp:flag=syn|ack,dst=*")
    assert capability.offers(Key("n.c.sonata.tcp:flag=syn"))
    assert capability.offers(Key("n.c.sonata.*:dst=10.0.0.1"))
    assert capability.offers(Key("n.c.sonata.tcp:flag=*"))
    assert not capability.offers(Key("n.c.sonata.tcp:flag=fin"))
    assert not capability.offers(Key("n.c.sonata.tcp:sport=5"))


def test_concrete_means_without_wildcards_and_lists():
    assert Key("a.b:x=1").concrete
    assert not any(Key(k).concrete for k in ("a.*", "a.**", "a:x=*", "a:x=1|2"))
