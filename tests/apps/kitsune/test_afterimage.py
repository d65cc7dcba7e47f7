"""Features equal the published ones bit for bit, in the kernel, its twin and the naive version, whatever the traffic."""

import platform
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apps.kitsune.afterimage import WIDTH, AfterImage, FeatureRoom, seconds
from due import RecordBatch
from sdnator.testing.oracles.afterimage import NaiveAfterImage as Naive
from sdnator.testing.packet_rows import batch_of, blank, part, tshark_fields
from tests.apps.kitsune.real_packets import real, tsv_rows
from tests.naive.kitsune.afterimage import PythonAfterImage
from tests.requirements import shared_data

ENGINES = {"kernel": AfterImage, "twin": PythonAfterImage}
GATEWAY, HOST = 0xC0A80201, 0xC0A8026E


def require_reference_arithmetic():
    """The vectors were computed with glibc's pow on a processor with FMA."""
    if platform.machine() != "x86_64" or platform.libc_ver()[0] != "glibc":
        pytest.skip("the reference vectors hold on x86-64 with glibc only")
    if "fma" not in Path("/proc/cpuinfo").read_text().split():
        pytest.skip("the reference vectors hold on processors with FMA only: glibc's pow differs elsewhere")


def features(batch, name="kernel", mode="reference", step=1000, **limits):
    afterimage = ENGINES[name](mode, **limits)
    return np.concatenate(
        [afterimage.update(part(batch, start, start + step)) for start in range(0, len(batch), step)]
    )


@pytest.mark.parametrize("name", ENGINES)
def test_equals_the_published_features(name):
    require_reference_arithmetic()
    wanted = np.load(shared_data("kitsune/features_first3000_f64.npz"))["features"]
    found = features(real(len(wanted)), name)
    assert np.count_nonzero(found != wanted) == 0
    assert found.shape == (3000, WIDTH)


def test_the_naive_version_equals_the_published_features():
    require_reference_arithmetic()
    wanted = np.load(shared_data("kitsune/features_first3000_f64.npz"))["features"]
    naive = Naive()
    found = np.array([naive.update(fields) for fields in tsv_rows(len(wanted))])
    assert np.count_nonzero(found != wanted) == 0


@pytest.mark.parametrize("step", [1, 7, 3000])
def test_batch_size_does_not_matter(step):
    batch = real(3000)
    assert np.array_equal(features(batch, step=step), features(batch))


def test_bounded_mode_of_kernel_and_twin_are_equal_on_real_packets():
    batch = real(6000)
    limits = {"max_streams": 200, "max_links": 100, "horizon": 20.0}
    assert np.array_equal(
        features(batch, "kernel", "bounded", **limits), features(batch, "twin", "bounded", **limits)
    )


ADDRESSES = st.sampled_from([GATEWAY, HOST, 0x0A000001, 0x0A00000A, 0xFFFFFFFF])
PORTS = st.sampled_from([1, 10, 123, 10123, 65535])


@st.composite
def packets(draw):
    """One packet of any kind, as columns."""
    kind = draw(st.sampled_from(["udp", "tcp", "icmp", "quoted", "arp", "ipv6", "other", "nothing", "both"]))
    source, destination = draw(ADDRESSES), draw(ADDRESSES)
    macs = st.integers(1, 3)
    row = {
        "eth_src": draw(macs),
        "eth_dst": draw(macs),
        "length": draw(st.sampled_from([0, 60, 60, 1514, 4294967295])),
    }
    if kind == "arp":
        return row | {"arp_op": 1, "arp_src_ip": source, "arp_dst_ip": destination}
    if kind == "nothing":
        return row
    row |= {"ip_version": 4, "ip_src_lo": source, "ip_dst_lo": destination}
    if kind == "ipv6":
        high = draw(st.sampled_from([0, 0xFE80 << 48, 0x20010DB8 << 32]))
        row |= {"ip_version": 6, "ip_src_hi": high, "ip_dst_hi": draw(st.sampled_from([0, high]))}
    if kind in {"icmp", "quoted"}:
        row |= {"icmp_type": 3, "icmp_code": 3}
    if kind in {"udp", "quoted", "ipv6", "both"}:
        row |= {"udp_sport": draw(PORTS), "udp_dport": draw(PORTS)}
    if kind in {"tcp", "both"}:
        row |= {"tcp_sport": draw(PORTS), "tcp_dport": draw(PORTS)}
    return row


STEPS = st.sampled_from([0, 0, 1, 1000, 37_000, 1_000_000, 12_345_678, -1, -500_000, 10**12, -(10**13)])


@st.composite
def traffic(draw, most=60):
    """Packets whose time stands still, runs backwards and jumps by days."""
    rows = draw(st.lists(packets(), min_size=1, max_size=most))
    time, times = 1_540_446_382_933_899, []
    for _ in rows:
        time += draw(STEPS)
        times.append(time)
    columns = {name for row in rows for name in row}
    absent = blank(1)
    values = {name: [row.get(name, int(absent[name][0])) for row in rows] for name in columns}
    return blank(len(rows), time_us=times, **values)


@settings(max_examples=120, deadline=None)
@given(traffic())
def test_kernel_equals_twin_and_naive_on_random_traffic(batch):
    found = features(batch)
    assert np.array_equal(found, features(batch, "twin"))
    naive = Naive()
    times = [f"{time // 1_000_000}.{time % 1_000_000:06d}000" for time in batch["time_us"].tolist()]
    assert np.array_equal(found, np.array([naive.update(fields) for fields in tshark_fields(batch, times)]))


@settings(max_examples=120, deadline=None)
@given(traffic(), st.integers(2, 12), st.integers(1, 8), st.sampled_from([0.5, 30.0, 3000.0]))
def test_bounded_kernel_equals_bounded_twin_on_random_traffic(batch, streams, links, horizon):
    limits = {"max_streams": streams, "max_links": links, "horizon": horizon}
    assert np.array_equal(
        features(batch, "kernel", "bounded", **limits), features(batch, "twin", "bounded", **limits)
    )


def hubs(count, seed, hosts=40, busy=3, back=20_000):
    """Random talk among hosts, most of it with a few busy ones that also talk to each other."""
    random = np.random.default_rng(seed)
    ends = np.where(
        random.random((2, count)) < 0.45,
        random.integers(0, busy, (2, count)),
        random.integers(0, hosts, (2, count)),
    )
    gaps = random.choice([0, 0, 17, 1_000, 250_000, 3_000_000, -back], count)
    return blank(
        count,
        time_us=1_600_000_000_000_000 + np.cumsum(gaps),
        length=random.choice([60, 60, 200, 1514], count),
        eth_src=ends[0] % 5,
        eth_dst=ends[1] % 5,
        ip_version=np.full(count, 4),
        ip_src_lo=ends[0],
        ip_dst_lo=ends[1],
        udp_sport=random.choice([53, 5353], count),
        udp_dport=random.choice([53, 5353], count),
    )


@pytest.mark.parametrize("seed", range(4))
def test_deferred_hubs_equal_eager_updates(seed):
    batch = hubs(1500, seed)
    assert np.array_equal(features(batch), features(batch, "twin"))


@pytest.mark.parametrize(("hosts", "busy"), [(40, 3), (400, 2), (60, 60)])
def test_bounded_hubs_of_kernel_and_twin_are_equal(hosts, busy):
    batch = hubs(4000, 1, hosts, busy)
    assert np.array_equal(features(batch, mode="bounded"), features(batch, "twin", "bounded"))


@pytest.mark.parametrize(("hosts", "busy"), [(40, 3), (400, 2), (60, 60)])
def test_bounded_mode_is_close_to_reference_mode(hosts, busy):
    batch = hubs(4000, 2, hosts, busy, back=0)
    assert are_close(features(batch), features(batch, mode="bounded"))


def are_close(exact, close):
    """But for covariance and correlation, in which small numbers are left of large ones."""
    covariance = np.zeros(WIDTH, dtype=bool)
    for start in (*range(15, 50, 7), *range(65, 100, 7)):
        covariance[start + 5 : start + 7] = True
    return np.allclose(exact[:, ~covariance], close[:, ~covariance], rtol=1e-6, atol=1e-3)


def test_logs_of_hubs_are_bounded():
    """The peers of hubs that have been silent for longest catch up in one step, as in the twin."""
    batch = hubs(4000, 2, 40, 40, back=0)
    kernel, twin = AfterImage("bounded", max_streams=2000), PythonAfterImage("bounded", max_streams=2000)
    found = kernel.update(batch)
    assert np.array_equal(found, twin.update(batch))
    assert kernel.counts == twin.counts
    assert 2 * 12 < kernel.counts["hub_logs"] <= 2 * 16
    unbounded = AfterImage("bounded")
    assert are_close(unbounded.update(batch), found)
    assert unbounded.counts["hub_logs"] > 60


def test_concatenated_keys_collide_as_published():
    columns = {
        "eth_src": [1, 1],
        "eth_dst": [2, 2],
        "ip_version": [4, 4],
        "ip_dst_lo": [1, 1],
        "time_us": [1, 1],
    }
    split = blank(2, ip_src_lo=[GATEWAY, HOST], udp_sport=[10123, 123], udp_dport=[1, 1], **columns)
    assert features(split)[1, 65] == pytest.approx(2.0)


def test_bounded_mode_holds_its_ceiling():
    count = 5000
    batch = blank(
        count,
        time_us=np.arange(count) * 100,
        ip_version=np.full(count, 4),
        ip_src_lo=np.arange(count),
        ip_dst_lo=np.full(count, 7),
    )
    afterimage = AfterImage("bounded", max_streams=64, max_links=32)
    assert np.isfinite(afterimage.update(batch)).all()
    assert afterimage.counts["streams"] <= 4 * 64
    assert afterimage.counts["links"] <= 2 * 32
    assert afterimage.counts["forgotten_full"] > 0


def test_bounded_mode_forgets_what_is_idle():
    afterimage = AfterImage("bounded", horizon=60.0)
    afterimage.update(
        blank(100, ip_version=np.full(100, 4), ip_src_lo=np.arange(100), time_us=np.arange(100))
    )
    held = afterimage.counts["streams"]
    afterimage.update(blank(100, time_us=np.full(100, 10**9)))
    assert afterimage.counts["streams"] < held / 10


def test_time_in_seconds_is_the_captures_own():
    rows = list(tsv_rows(2000))
    batch = batch_of(rows)
    wanted = [float(row["frame.time_epoch"]) for row in rows]
    assert seconds(batch).tolist() == wanted
    nanoseconds = RecordBatch({**batch, "time_ns": batch["time_us"] * 1000})
    assert seconds(nanoseconds).tolist() == wanted
    assert seconds(RecordBatch({**batch, "time_s": np.array(wanted)})).tolist() == wanted


def test_ceilings_that_hold_no_packet_are_refused():
    with pytest.raises(ValueError, match="max_streams=1"):
        AfterImage("bounded", max_streams=1)


def test_features_that_somebody_holds_are_not_overwritten():
    """Nor where only some rows of them are held."""
    batch, room, afterimage, other = real(2_000), FeatureRoom(), AfterImage(), AfterImage()
    parts = [part(batch, at, at + 100) for at in range(0, 2_000, 100)]
    held = [afterimage.update(each, room)[10:] for each in parts]
    assert all(np.array_equal(rows, other.update(each)[10:]) for rows, each in zip(held, parts, strict=True))


def test_memory_for_features_is_used_again():
    """Also for somebody who holds the last ones until the next have come."""
    room = FeatureRoom()
    last = [room.of(5_000) for _ in range(2)].pop()
    tracemalloc.start()
    try:
        for rows in (5_000, 100, 5_000, 5_000):
            last = room.of(rows)
            assert last.shape == (rows, WIDTH)
        assert tracemalloc.get_traced_memory()[1] < last.nbytes / 10
    finally:
        tracemalloc.stop()
