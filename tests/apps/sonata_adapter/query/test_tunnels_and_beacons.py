"""The queries of docs/sonata.md for tunnels and beacons find them in a generated capture, and nothing else there."""

import json
import random
import re
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from apps.sonata_adapter.control import Control
from apps.sonata_adapter.errors import QueryError, QueryTextError
from apps.sonata_adapter.query.language import Query, dns, entropy, ip, length_of, payload, tcp
from apps.sonata_adapter.query.text import parse_queries
from sdnator.capture.captures import CaptureWriter
from sdnator.cli.queries_commands import queries
from sdnator.testing import query_traffic
from sdnator.testing.oracles import payload_measures, sonata
from sdnator.testing.query_traffic import BASE_US, TimedFrame, office

TEXT = (Path(__file__).resolve().parents[4] / "docs" / "sonata.md").read_text(encoding="utf-8")
TUNNEL, BEACON = "198.51.100.40", "198.51.100.41"
SERVER = "203.0.113.80"


def documented(name):
    blocks = re.findall(r"```text\n(.*?)```", TEXT, re.DOTALL)
    return next(block for block in blocks if f"query {name}(" in block)


def traffic():
    """Ten minutes: an office, a tunnel of 30 names in three seconds, a beacon a minute."""
    rng = random.Random(5)
    frames = office(20, rng)
    for number in range(30):
        label = "".join(rng.choices("abcdefghijklmnopqrstuvwxyz234567", k=52))
        asked = query_traffic.dns(f"{label}.t.example", 16, response=False)
        frame = query_traffic.udp(TUNNEL, "10.0.0.1", 40_000 + number, 53, asked)
        frames.append(TimedFrame(BASE_US + 11_000_000 + number * 100_000, len(frame), frame))
    for minute in range(9):
        frame = query_traffic.tcp(BEACON, SERVER, 50_000 + minute, 443, 24, rng.randbytes(48))
        frames.append(TimedFrame(BASE_US + minute * 60_000_000 + 17, len(frame), frame))
    return sorted(frames)


def tried(name, tmp_path, frames):
    file, capture = tmp_path / "mine.sonata", tmp_path / "a.pcap"
    file.write_text(documented(name))
    with CaptureWriter(capture) as writer:
        for frame in frames:
            writer.write(frame.time_us * 1000, frame.data, frame.length)
    done = CliRunner().invoke(
        queries, ["test", str(file), "--capture", str(capture), "--json"], catch_exceptions=False
    )
    return json.loads(done.output)


def test_the_tunnel_is_found(tmp_path):
    """Only the host with the tunnel; the rows of the filters are those of the plain reading."""
    frames = traffic()
    one = tried("noisy_names", tmp_path, frames)
    assert {each["src"] for each in one["results"]} == {TUNNEL}
    packets = [sonata.read(*frame) for frame in frames]
    asked = [p for p in packets if p.dport == 53 and sonata.question(p.payload)[0] == 0]
    measured = [payload_measures.name_measures(p) for p in asked]
    noisy = sum(length >= 40 and bits >= 3500 for length, bits in measured)
    assert [each["rows_out"] for each in one["steps"][:2]] == [len(asked), noisy]
    assert one["cost"]["tuples_to_host"] == sum(p.dport == 53 for p in packets)


def test_the_beacon_is_found(tmp_path):
    """The host that calls home once a minute is among the few results, with one length."""
    frames = traffic()
    one = tried("beacon", tmp_path, frames)
    truth: dict[tuple[str, str, int], list[int]] = {}
    for frame in frames:
        packet = sonata.read(*frame)
        size = payload_measures.payload_length(frame.data) if packet.protocol == 6 else -1
        if size > 0:
            truth.setdefault((packet.src, packet.dst, packet.dport), []).append(size)
    wanted = {
        key: (len(sizes), len(set(sizes)))
        for key, sizes in truth.items()
        if len(sizes) >= 8 and len(set(sizes)) <= 2
    }
    found = {(r["src"], r["dst"], r["port"]): (r["count"], r["sizes"]) for r in one["results"]}
    assert found == wanted
    assert found[BEACON, SERVER, 443] == (9, 1)


@pytest.mark.parametrize("name", ["noisy_names", "beacon"])
def test_live_they_get_the_bytes_of_frames(name):
    """The host asks for copies with payload, not for headers alone."""
    control = Control({one.name: one for one in parse_queries(documented(name))})
    control.want([f"network.traffic_query.sonata.{name}"])
    assert not control.refused
    assert {source.kind for source in control.sources} == {"frames"}


def test_python_and_text_write_the_same():
    """Both forms make one query, and its text reads back."""
    query = (
        Query("q", 1000)
        .filter((length_of(dns.name) > 5) & (entropy(payload) < 7000) & (dns.type == 16))
        .map(src=ip.src, size=tcp.payload_len)
    )
    text = """query q(window=1s):
    filter len(dns.name) > 5 and entropy(payload) < 7000 and dns.type == 16
    map src = ip.src, size = tcp.payload_len
"""
    (template,) = parse_queries(text)
    assert template.query().steps == query.steps
    (again,) = parse_queries(query.text())
    assert again.query().steps == query.steps
    with pytest.raises(QueryError, match="give dns"):
        entropy(ip.src)


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ("filter len(ip.src) > 1", "len is of a packet's text: len"),
        ("filter entropy(dns.name > 1", "expected '\\)'"),
        ("map name = dns.name\n    filter len(dns.name) > 1", "use it before a map"),
        ("filter payload > 1", "unknown field payload"),
    ],
)
def test_misuse_names_line_and_remedy(line, what):
    """One error type, with place."""
    with pytest.raises(QueryTextError, match=what):
        parse_queries(f"query q(window=1s):\n    {line}\n")


@given(st.text("len(entropy.dnsmpaylo) >=1", max_size=60))
def test_any_text_is_a_query_or_one_kind_of_error(line):
    """Nothing else is raised."""
    with suppress(QueryTextError):
        parse_queries(f"query q(window=1s):\n    filter {line}\n")
