"""Every query of the catalogue finds what a slow evaluator finds that shares no code with it."""

import random

import pytest

from apps.sonata_adapter.host.engine import HostEngine
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.results import QueryResult
from sdnator.capture.captures import Capture
from sdnator.testing.oracles import sonata
from sdnator.testing.query_traffic import BASE_US, HOSTS, TimedFrame, attack, batches, mixed, office
from tests.requirements import shared_data

CAPTURES = ("synflood_spoofed", "synflood_one_source", "ssh_guessing", "ftp_bruteforce")


def run(names, frames, *, size=1024, values=None):
    """Name -> results of the host engine, as the naive evaluator writes them."""
    engine = HostEngine()
    for name in names:
        engine.add(CATALOGUE[name].query(values))
    outputs = []
    for batch in batches(frames, size):
        outputs += engine.process(batch)
    outputs += engine.finish()
    found: dict[str, list[sonata.Found]] = {name: [] for name in names}
    for result in outputs:
        assert isinstance(result, QueryResult)
        assert result.exact
        fields = tuple(sorted(result.fields.items()))
        found[result.query].append(sonata.Found(result.window_us // result.length_us, fields, result.at_us))
    return found


def expect(name, frames, values=None):
    parameters = {each.name: each.default for each in CATALOGUE[name].parameters} | (values or {})
    return sonata.evaluate(name, [sonata.read(*frame) for frame in frames], parameters)


def same(left, right):
    """Equal as sets, and nothing twice."""
    assert sorted(left, key=str) == sorted(right, key=str)


@pytest.fixture(scope="module")
def everything():
    return mixed(CATALOGUE, seconds=25)


@pytest.mark.parametrize("name", CATALOGUE)
def test_attack_is_found(name):
    """The query reports the host under attack, and the quiet office alone is not reported as that host."""
    rng = random.Random(3)
    frames = sorted(office(8, rng) + attack(name, BASE_US + 10_000, rng))
    found = [dict(each.fields) for each in run([name], frames)[name]]
    assert HOSTS[name] in {
        fields[part] for fields in found for part in ("src", "dst", "mac") if part in fields
    }


@pytest.mark.parametrize("name", CATALOGUE)
def test_equals_naive_on_all_attacks_at_once(name, everything):
    """Values, windows and crossing times are those of the naive evaluator."""
    same(run([name], everything)[name], expect(name, everything))


@pytest.mark.parametrize("size", [1, 7, 100_000])
def test_results_do_not_depend_on_batches_or_company(size, everything):
    """All queries share operators; each still finds what it finds alone."""
    frames = everything[:3000] if size == 1 else everything
    found = run(CATALOGUE, frames, size=size)
    for name in CATALOGUE:
        same(found[name], expect(name, frames))


@pytest.mark.parametrize("capture", CAPTURES)
def test_equals_naive_on_real_captures(capture):
    """Real captures, all queries at once."""
    with Capture(shared_data(f"captures/{capture}.pcap")) as file:
        frames = [TimedFrame(time_ns // 1000, length, data) for time_ns, length, data in file]
    found = run(CATALOGUE, frames)
    for name in CATALOGUE:
        same(found[name], expect(name, frames))


@pytest.mark.parametrize("name", CATALOGUE)
@pytest.mark.parametrize("prefix", ["198.51.100.0/28", "2001:db8::/32", "198.51.100.6"])
def test_prefix_parameter(name, prefix, everything):
    """`dst` and `src` restrict a query to hosts of a prefix, of either IP version."""
    parameter = "src" if CATALOGUE[name].parameter("src") else "dst"
    from apps.sonata_adapter.query.expressions import canonical_prefix

    values = {parameter: canonical_prefix(prefix), "threshold": 2, "window": 2_000}
    same(run([name], everything, values=values)[name], expect(name, everything, values))
