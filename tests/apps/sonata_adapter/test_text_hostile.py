"""Texts of queries that nobody should write: one error, with a place, and in time."""

import contextlib
import re

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from apps.sonata_adapter.errors import QueryTextError, SonataError
from apps.sonata_adapter.keys import request_of
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.query.dataflow import compile_query
from apps.sonata_adapter.query.templates import QueryFolder
from apps.sonata_adapter.query.text import MOST_TEXT, parse_queries
from due.errors import DueError

OWN = """\
query q(window=3s, most=7, gate=0x3):
    gate dst = ip.dst: count() >= gate where udp.sport == 53 and ip.src in 10.0.0.0/8
    filter len(dns.name) >= 50 and not (payload contains "zorro" or ip.src == 2001:db8::1)
    map dst = ip.dst, size = -length + 0x10 * 2
    distinct
    reduce by dst: n = sum(size)
    join left on dst with:
        filter tcp.flags == SYN
        map dst = ip.dst
        reduce by dst: m = count()
    filter n - m >= most
"""
TEXTS = [*(CATALOGUE[name].query().text() for name in CATALOGUE), OWN, OWN.replace(">= gate", ">= 3")]
ONE_OF_EACH = ["foo", "7", "0x", "0x7", "1s", "1.2.3.4", "1.2.3.4/99", "::", '"a"', "(", ""]
TOKENS = sorted({token for text in TEXTS for token in re.findall(r"\s+|[\w.]+|\W", text)})
EXTREMES = ["03", "0x", "9" * 30, "9" * 5000, "not ", "(" * 60, "-" * 60, '"\\q"', '"\\N{DIGIT ONE}"', "\t", "\r", "\u2028",
            "1.2.3.4/99", "::/0", "window", "join anti on dst with:", "\n" + " " * 30, "a.b", "٣", "\x00"]  # fmt: skip


@st.composite
def mutated(draw):
    """A query of the catalogue with some words taken out, put in or repeated."""
    words = re.findall(r"\s+|[\w.]+|\W", draw(st.sampled_from(TEXTS)))
    for _ in range(draw(st.integers(1, 6))):
        at = draw(st.integers(0, max(0, len(words) - 1)))
        new = draw(st.sampled_from(TOKENS + EXTREMES) | st.text(max_size=5))
        words[at : at + draw(st.integers(0, 3))] = [new] * draw(st.integers(0, 3))
    return "".join(words)


@settings(max_examples=300, deadline=None, suppress_health_check=list(HealthCheck))
@given(mutated())
def test_mutated_queries_are_queries_or_one_error(text):
    """What is read can be asked for as well."""
    try:
        templates = parse_queries(text)
    except QueryTextError as error:
        place = (error.line, error.column)
        templates = []
    else:
        place = (1, 1)
    assert min(place) >= 1
    for template in templates:
        compile_query(template.query())
        key = f"network.traffic_query.sonata.{template.name}"
        assert request_of(key, {template.name: template}) is not None


@pytest.mark.parametrize("token", ONE_OF_EACH)
@pytest.mark.parametrize("text", TEXTS[-2:])
def test_any_token_in_the_place_of_another_is_a_query_or_one_error(text, token):
    """In each place of a text that has all constructs."""
    assert parse_queries(text)
    parts = re.findall(r'\s+|"[^"]*"|[0-9][\w.:/]*|[\w.]+|\W', text)
    for place, part in enumerate(parts):
        if not part.isspace():
            with contextlib.suppress(QueryTextError):
                parse_queries("".join([*parts[:place], token, *parts[place + 1 :]]))


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("query q:\n  filter " + "not " * 2000 + "tcp.dport == 1", "too long"),
        ("query q:\n  filter " + "not " * 100 + "tcp.dport == 1", "nested too deeply"),
        ("query q:\n  filter " + "(" * 100 + "1" + ")" * 100, "nested too deeply"),
        ("query q:\n  filter tcp.dport == " + "-" * 100 + "1", "nested too deeply"),
        ("query q:\n  filter tcp.dport == 1" + " + 1" * 5000, "too long"),
        ("query q:\n  filter tcp.dport == 03", "begins with 0"),
        ("query q(n=03):\n  filter tcp.dport == n", "begins with 0"),
        ("query q(n=" + "9" * 5000 + "):\n  filter tcp.dport == n", "out of bounds"),
        ("query q:\n  filter tcp.dport == " + "9" * 5000, "out of bounds"),
        ("query q(a.b=1):\n  filter tcp.dport == 1", "no dot"),
        ("query " + "q" * 5000 + ":\n  distinct", "64 letters"),
        ("query q:\n  map a = tcp.dport\n" + "  map a = a + a\n" * 60, "when written out"),
        ("query q:\n" + "".join(f"{'  ' * n}join on a with:\n" for n in range(1, 90)), "nested too deeply"),
        ("query q:\n  map a = ip.src\n" * 600, "1000 lines"),
        ("#" * (MOST_TEXT + 1), "characters"),
        ('query q:\n  filter payload contains "\\N{DIGIT ONE}"', "backslash"),
    ],
)
def test_limits(text, what):
    """Size, depth, count and range each have one, and the error names it."""
    with pytest.raises(QueryTextError, match=what):
        parse_queries(text)


@pytest.mark.parametrize("data", [b"\xff\xfe", b"query q:\n  filter \xff", b"#" * 500_000])
def test_files_that_are_no_text(tmp_path, data):
    """A damaged file in the folder of queries is named, with the line."""
    (tmp_path / "wrong.sonata").write_bytes(data)
    with pytest.raises(QueryTextError, match=r"wrong\.sonata:"):
        QueryFolder(tmp_path).templates()


@settings(max_examples=200, deadline=None)
@given(
    st.sampled_from([*CATALOGUE, "q"]),
    st.sampled_from(["window", "threshold", "dst", "src", "refine", "sport", "flag", "x"]),
    st.text(max_size=30)
    | st.sampled_from(["9" * 5000, "1" * 18, "08s", "10.0.0.0/99", "16/8", "\uff18\uff10", "any", "syn"]),
    st.sampled_from(["traffic_query.sonata", "traffic_capture.sonata"]),
)
def test_keys_ask_for_a_query_or_are_refused(name, parameter, value, kind):
    """Values of parameters come from whoever observes."""
    name = "tcp" if kind == "traffic_capture.sonata" else name
    with contextlib.suppress(SonataError, DueError):
        request_of(f"network.{kind}.{name}:{parameter}={value}", CATALOGUE)
