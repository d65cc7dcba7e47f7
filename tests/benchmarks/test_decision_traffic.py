"""Generated traffic is what its truth says: times, ends, flags, answers and labels."""

import itertools

import numpy as np
import pytest

from apps.packets import PACKET_COLUMNS, read_columns
from benchmarks.decision_traffic.attacks import ATTACKS
from benchmarks.decision_traffic.capture_writer import to_capture, write_captures
from benchmarks.decision_traffic.hosts import mac_text
from benchmarks.decision_traffic.networks import HELD_BACK_NETWORKS, NETWORKS
from benchmarks.decision_traffic.novelty import NOVELTIES
from benchmarks.decision_traffic.packets import ACK, FIN, RST, SYN
from benchmarks.decision_traffic.real import real_attacks, real_network
from benchmarks.decision_traffic.traffic import BASE_US, SECOND, merge
from due import RecordBatch
from sdnator.capture.labels import labels_path, read_labels
from sdnator.capture.packet_sources import CaptureSource
from tests.requirements import shared_data

MAKE = {**NETWORKS, **HELD_BACK_NETWORKS}
NAMES = sorted(MAKE)
NOVEL = sorted(NOVELTIES)
START_S = 3_600
ONE = {name: MAKE[name](1) for name in NAMES}
CASES = [(name, spec.number) for name in NAMES for spec in ATTACKS if spec.fits(ONE[name])]
_NUMBERED = {"arrival", "sequence"}


def spec_of(number):
    return next(spec for spec in ATTACKS if spec.number == number)


def an_hour(name, seed=1):
    return merge(*MAKE[name](seed).chunks(0, 3_600))


def same(left, right):
    """Whether two traffics have the same packets, whatever their numbers."""
    return np.array_equal(left.attack, right.attack) and all(
        np.array_equal(left.columns[key], right.columns[key])
        for key in PACKET_COLUMNS
        if key not in _NUMBERED
    )


def in_order(traffic):
    return bool((np.diff(traffic.columns["time_us"]) >= 0).all())


@pytest.mark.parametrize("name", NAMES)
def test_chunks_are_packet_columns_in_order(name):
    """What the pipeline would refuse is not made; numbers run through all chunks."""
    parts = list(ONE[name].chunks(1_800, 9_000))
    assert len(parts) == 3
    whole = np.concatenate([part.columns["arrival"] for part in parts])
    assert np.array_equal(whole, np.arange(len(whole)))
    last = BASE_US + 1_800 * SECOND
    for part in parts:
        assert tuple(part.columns) == tuple(PACKET_COLUMNS)
        read_columns(RecordBatch(part.columns), PACKET_COLUMNS, name)
        assert in_order(part)
        assert last <= part.first_us
        last = part.last_us
        assert not part.attack.any()
        assert (part.columns["length"] >= 60).all()
    assert last < BASE_US + 9_000 * SECOND


@pytest.mark.parametrize("name", NAMES)
def test_a_reading_may_begin_anywhere(name):
    whole = merge(*ONE[name].chunks(0, 3 * 3_600))
    late = merge(*ONE[name].chunks(2.25 * 3_600, 3 * 3_600))
    assert same(whole.between(2.25 * 3_600, 3 * 3_600), late)


@pytest.mark.parametrize("name", NAMES)
def test_a_seed_is_a_network(name):
    first, again, other = an_hour(name), an_hour(name), an_hour(name, 2)
    assert same(first, again)
    assert not same(first, other)
    hosts = [MAKE[name](seed).hosts for seed in (1, 2)]
    assert {host.mac for host in hosts[0]}.isdisjoint(host.mac for host in hosts[1])


@pytest.mark.parametrize("name", NAMES)
def test_memory_is_bounded_by_the_busiest_hours(name):
    """An hour on the other side of a week needs no more than its own packets."""
    network = ONE[name]
    day = 24 * 3_600
    parts = network.chunks(6 * day, 7 * day)
    assert max(len(part) for part in itertools.islice(parts, 3)) < 1_000_000


@pytest.mark.parametrize("name", NAMES)
def test_each_host_is_on_its_own_port(name):
    """Outside addresses come with the router's MAC on the uplink."""
    network, columns = ONE[name], an_hour(name).columns
    port_of = {host.mac: host.port for host in network.hosts}
    assert len(set(port_of.values())) == len(port_of)
    pairs = set(zip(columns["eth_src"].tolist(), columns["port"].tolist(), strict=True))
    assert pairs == set(port_of.items())
    inside = columns["ip_src_lo"] >> 8 == network.prefix >> 8
    outside = (columns["ip_version"] == 4) & ~inside & (columns["ip_src_lo"] != 0)
    assert (columns["eth_src"][outside] == network.gateway.mac).all()
    assert outside.any() == network.has_internet


@pytest.mark.parametrize("name", NAMES)
def test_connections_are_faithful(name):
    """SYN-ACKs acknowledge their SYN, data comes both ways without holes, and some connections fail."""
    columns = an_hour(name).columns
    flags, length = columns["tcp_flags"].astype(int), columns["length"].astype(int)
    flows = {}
    for row in np.flatnonzero((columns["ip_proto"] == 6) & (columns["quoted"] == 0)).tolist():
        ends = [
            (int(columns[f"ip_{side}_lo"][row]), int(columns[f"tcp_{port}"][row]))
            for side, port in (("src", "sport"), ("dst", "dport"))
        ]
        flows.setdefault(frozenset(ends), []).append((row, ends[0]))
    begun = [rows for rows in flows.values() if flags[rows[0][0]] == SYN]
    answered = [rows for rows in begun if any(flags[row] == SYN | ACK for row, _ in rows)]
    ended = [rows for rows in answered if any(flags[row] & (FIN | RST) for row, _ in rows)]
    refused = [rows for rows in begun if any(flags[row] == RST | ACK for row, _ in rows) and len(rows) == 2]
    assert len(begun) > len(answered) > 10
    assert refused or name != "office"  # few people are at home in the morning
    assert len(ended) > 0.85 * len(answered)
    for rows in answered[:300]:
        syn, reply = rows[0][0], next(row for row, _ in rows if flags[row] == SYN | ACK)
        assert int(columns["tcp_ack"][reply]) == (int(columns["tcp_seq"][syn]) + 1) % 2**32
        for side in {end for _, end in rows}:
            mine = [row for row, end in rows if end == side and not flags[row] & SYN and length[row] > 66]
            parts = sorted({(int(columns["tcp_seq"][row]), int(length[row]) - 66) for row in mine})
            gaps = {later[0] - first[0] - first[1] for first, later in itertools.pairwise(parts)}
            assert gaps <= {0, -(2**32)}


@pytest.mark.parametrize("name", NAMES)
def test_errors_quote_what_was_sent(name):
    """Ports of an ICMP error are those of a packet that its receiver has sent before."""
    columns = an_hour(name).columns
    quoted = columns["quoted"] == 1
    assert quoted.any()
    assert (columns["icmp_type"][quoted] == 3).all()
    sent = {
        key
        for proto in ("tcp", "udp")
        for key in zip(
            columns["ip_src_lo"][~quoted].tolist(),
            columns[f"{proto}_dport"][~quoted].tolist(),
            strict=True,
        )
    }
    port = np.maximum(columns["tcp_dport"], columns["udp_dport"])
    found = [
        (address, number) in sent
        for address, number in zip(columns["ip_dst_lo"][quoted].tolist(), port[quoted].tolist(), strict=True)
    ]
    assert np.mean(found) > 0.95


@pytest.mark.parametrize(("name", "number"), CASES)
def test_an_attack_is_what_its_truth_says(name, number):
    network, spec = ONE[name], spec_of(number)
    traffic, truth = spec.traffic(network, 1, START_S)
    read_columns(RecordBatch(traffic.columns), PACKET_COLUMNS, spec.name)
    assert in_order(traffic)
    assert traffic.first_us >= BASE_US + START_S * SECOND
    rows = np.flatnonzero(traffic.attack)
    assert set(traffic.attack[rows].tolist()) == {truth.id}
    assert truth.packets == len(rows)
    assert (truth.first_us, truth.last_us) == tuple(traffic.columns["time_us"][rows[[0, -1]]].tolist())
    sources = set(
        zip(
            traffic.columns["port"][rows].tolist(),
            traffic.columns["eth_src"][rows].tolist(),
            strict=True,
        )
    )
    assert sources == {(attacker.port, attacker.mac) for attacker in truth.attackers}
    addresses = set(traffic.columns["ip_src_lo"][rows].tolist()) - {0}
    if truth.forged:
        assert not addresses & {attacker.ip for attacker in truth.attackers}
    else:
        assert addresses <= {attacker.ip for attacker in truth.attackers}
    known = {host.mac for host in network.hosts}
    newcomers = {attacker.mac for attacker in truth.attackers} - known
    assert bool(newcomers) == (spec.attacker_is == "new")
    assert set(truth.victims) <= {host.ip for host in network.hosts}
    assert truth.remedies
    assert truth.held_back == (number > 100)


def test_every_seed_is_another_attack():
    network = ONE["office"]
    for spec in ATTACKS[:4]:
        made = [spec.traffic(network, seed, START_S)[0] for seed in (1, 1, 2)]
        assert same(made[0], made[1])
        assert not same(made[0], made[2])


def test_attacks_are_numbered_and_named_once():
    assert len({spec.number for spec in ATTACKS}) == len({spec.name for spec in ATTACKS}) == len(ATTACKS)
    assert {spec.kind for spec in ATTACKS} == {"scan", "flood", "guessing", "spoofing"}


def test_nobody_outside_attacks_a_house_without_internet():
    outside = next(spec for spec in ATTACKS if spec.needs)
    with pytest.raises(ValueError, match="needs internet"):
        outside.traffic(ONE["house"], 1, START_S)
    with pytest.raises(ValueError, match="seed"):
        outside.traffic(ONE["office"], 1_000, START_S)


def test_scanned_hosts_answer_as_they_are():
    """Open ports accept, closed ones reset, filtered hosts are silent."""
    network, spec = ONE["house"], spec_of(1)
    for seed in range(4):
        traffic, truth = spec.traffic(network, seed, START_S)
        columns, answers = traffic.columns, traffic.attack == 0
        target = next(host for host in network.hosts if host.ip == truth.victims[0])
        from_target = answers & (columns["ip_src_lo"] == target.ip)
        accepted = columns["tcp_sport"][from_target & (columns["tcp_flags"] == SYN | ACK)]
        refused = columns["tcp_sport"][from_target & (columns["tcp_flags"] == RST | ACK)]
        assert set(accepted.tolist()) <= target.open_ports
        assert target.filtered or not set(refused.tolist()) & target.open_ports
        assert target.filtered == (len(refused) == 0)


def test_errors_about_a_udp_scan_are_limited():
    traffic, truth = spec_of(7).traffic(ONE["office"], 1, START_S)
    errors = traffic.columns["time_us"][traffic.columns["quoted"] == 1]
    seconds = (truth.last_us - truth.first_us) / SECOND
    assert 1 <= len(errors) <= seconds + 2
    assert np.bincount((errors - truth.first_us) // SECOND).max() <= 2


@pytest.mark.parametrize("number", [17, 18, 112])
def test_a_planted_scan_never_comes_from_the_innocent(number):
    """The innocent's port sends nothing of the attack, although its address does."""
    traffic, truth = spec_of(number).traffic(ONE["office"], 1, START_S)
    innocent = truth.innocents[0]
    rows = traffic.attack != 0
    assert truth.forged
    assert set(traffic.columns["ip_src_lo"][rows].tolist()) == {innocent.ip}
    assert innocent.port not in traffic.columns["port"][rows].tolist()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("novelty", NOVEL)
def test_novelty_is_benign_and_begins_when_told(name, novelty):
    network = ONE[name]
    traffic = NOVELTIES[novelty](network, 5, START_S)
    read_columns(RecordBatch(traffic.columns), PACKET_COLUMNS, novelty)
    assert in_order(traffic)
    assert len(traffic) > 50
    assert not traffic.attack.any()
    assert traffic.first_us >= BASE_US + START_S * SECOND
    assert same(traffic, NOVELTIES[novelty](network, 5, START_S))


def test_merging_keeps_the_order_of_arguments_at_equal_times():
    network = ONE["house"]
    benign = merge(*network.chunks(START_S, START_S + 60))
    attack, truth = spec_of(1).traffic(network, 1, START_S)
    both = merge(benign, attack)
    assert len(both) == len(benign) + len(attack)
    assert in_order(both)
    assert np.array_equal(both.columns["arrival"], np.arange(len(both)))
    assert np.count_nonzero(both.attack == truth.id) == truth.packets
    twice = merge(attack, benign, benign)
    where = np.flatnonzero(np.diff(twice.columns["time_us"]) == 0)
    assert len(where) >= len(benign) // 2
    assert len(merge()) == 0


def a_bit_of_everything(name):
    """The first packets of each attack and novelty, among benign ones."""
    network = ONE[name]
    benign = merge(*network.chunks(START_S, START_S + 120))
    attacks = [spec.traffic(network, 1, START_S)[0] for spec in ATTACKS if spec.fits(network)]
    novel = [NOVELTIES[key](network, 1, START_S) for key in NOVEL]
    return merge(benign, *(next(each.batches(200)) for each in (*attacks, *novel)))


@pytest.mark.parametrize("name", NAMES)
def test_a_written_capture_reads_as_it_was(name, tmp_path):
    """The product's reader finds the columns that were generated, and the labels belong to them."""
    traffic = a_bit_of_everything(name)
    path = tmp_path / "part.pcap"
    to_capture(traffic.columns, traffic.attack, path)
    batches = list(CaptureSource(path))
    for key in PACKET_COLUMNS:
        if key not in {"port", "arrival", "sequence"}:
            read = np.concatenate([batch[key] for batch in batches])
            wrong = np.flatnonzero(read != traffic.columns[key])
            assert not len(wrong), (key, {name: traffic.columns[name][wrong[0]] for name in PACKET_COLUMNS})
    labels = read_labels(labels_path(path), len(traffic))
    assert np.array_equal(labels.attack, traffic.attack != 0)
    attackers = traffic.columns["eth_src"][traffic.attack != 0].tolist()
    assert labels.attackers == {mac_text(mac) for mac in set(attackers)}


def test_parts_are_written_as_one_capture(tmp_path):
    parts = list(ONE["house"].chunks(3_500, 3_700))
    write_captures(parts, tmp_path / "parts.pcap.gz", snap=96)
    written = list(CaptureSource(tmp_path / "parts.pcap.gz"))
    times = np.concatenate([batch["time_us"] for batch in written])
    assert np.array_equal(times, np.concatenate([part.columns["time_us"] for part in parts]))


def test_the_real_capture_is_a_network():
    """Attacks and novelty are made in it as in a generated one."""
    folder = shared_data("kitsune").parent
    network = real_network(folder)
    benign = merge(*network.chunks(0, 1_500))
    assert len(benign) == 38_363
    assert in_order(benign)
    known = {host.mac for host in network.hosts}
    assert np.isin(benign.columns["eth_src"], list(known)).mean() > 0.97
    traffic, truth = spec_of(9).traffic(network, 1, 1_405)
    assert truth.attackers[0].mac in known
    assert len(NOVELTIES["new phone"](network, 1, 1_405)) > 50
    assert in_order(merge(benign, traffic))


def test_captured_attacks_are_moved_into_the_network():
    """Each comes from the ports and MACs of its truth, at its time, at the capture's pace."""
    folder = shared_data("kitsune").parent
    network = real_network(folder)
    for spec in real_attacks(folder):
        traffic, truth = spec.traffic(network, 1, 1_405)
        read_columns(RecordBatch(traffic.columns), PACKET_COLUMNS, spec.name)
        assert in_order(traffic)
        rows = traffic.attack != 0
        assert truth.packets == np.count_nonzero(rows) >= 20
        macs = set(traffic.columns["eth_src"][rows].tolist())
        assert macs == {attacker.mac for attacker in truth.attackers}
        assert set(traffic.columns["port"][rows].tolist()) == {attacker.port for attacker in truth.attackers}
        assert truth.first_us >= BASE_US + 1_405 * SECOND
        assert set(truth.victims) <= {host.ip for host in network.hosts}
