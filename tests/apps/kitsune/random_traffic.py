"""Small networks in which everything happens: for comparing the C trackers with their Python twins."""

import numpy as np

from due import RecordBatch
from sdnator.testing.packet_rows import blank

ADDRESSES = np.array(
    [0xC0A80201, 0xC0A80202, 0xC0A80203, 0x0A000005, 0x08080808, 0x08080809, 0, 0xE0000001], "u8"
)
PORTS = np.array([20, 22, 23, 53, 67, 80, 443, 1_023, 1_024, 33_000, 50_000, 60_000], "i4")
FLAGS = np.array([0x02, 0x12, 0x10, 0x11, 0x04, 0x14, 0x18, 0x00], "u1")
BASE_US = 1_600_000_000_000_000


def traffic(random: np.random.Generator, count: int, start_s: float, hosts: int = 8) -> RecordBatch:
    """Packets of all kinds, in bursts, some late."""
    gap = float(random.choice([1e-4, 1e-2, 0.3]))
    times = start_s + np.cumsum(random.exponential(gap, count))
    times = np.where(random.random(count) < 0.05, times - random.exponential(2.0, count), times)
    kind = random.choice(6, count, p=[0.45, 0.2, 0.1, 0.1, 0.1, 0.05])
    version = np.where(random.random(count) < 0.1, 6, 4)
    source, target = (random.choice(ADDRESSES[:hosts], count) for _ in range(2))
    if random.random() < 0.3:  # a flood from many addresses, or a scan of many
        many = random.integers(0x09000000, 0x09000000 + 500, count).astype("u8")
        source, target = (many, target) if random.random() < 0.5 else (source, many)
    tcp, udp, arp, icmp, quoted = kind == 0, kind == 1, kind == 2, kind == 3, kind == 4
    half = quoted & (random.random(count) < 0.5)
    is_tcp, is_udp = tcp | half, udp | (quoted & ~half)
    ports = [random.choice(PORTS, count) for _ in range(2)]
    ip = ~arp & (kind != 5)
    high = np.where(ip & (version == 6), np.uint64(0x20010DB800000000), 0)
    mac = (source & 0xF) + np.where(random.random(count) < 0.05, 0x100, 0)
    return blank(
        count,
        time_us=BASE_US + np.round(times * 1e6).astype("i8"),
        arrival=np.arange(count) + int(start_s * 1_000),
        port=random.integers(1, 3, count),
        length=random.choice([60, 500, 1_500], count),
        eth_src=mac,
        eth_dst=np.where(random.random(count) < 0.1, 0xFFFFFFFFFFFF, target & 0xF),
        arp_op=np.where(arp, random.integers(1, 3, count), -1),
        arp_src_ip=np.where(arp, source, 0),
        arp_dst_ip=np.where(arp, target, 0),
        ip_version=np.where(ip, version, 0),
        ip_src_hi=high,
        ip_dst_hi=high,
        ip_src_lo=np.where(ip, source, 0),
        ip_dst_lo=np.where(ip, target, 0),
        tcp_sport=np.where(is_tcp, ports[0], -1),
        tcp_dport=np.where(is_tcp, ports[1], -1),
        udp_sport=np.where(is_udp, ports[0], -1),
        udp_dport=np.where(is_udp, ports[1], -1),
        quoted=quoted,
        tcp_flags=np.where(tcp, random.choice(FLAGS, count), 0),
        icmp_type=np.where(icmp & (version == 4), random.choice([0, 8, 3], count), np.where(quoted, 3, -1)),
        icmp6_type=np.where(icmp & (version == 6), random.choice([128, 129], count), -1),
    )


def scores_of(random: np.random.Generator, count: int) -> np.ndarray:
    """Mostly benign; some far above, and what is no number."""
    scores = random.lognormal(-1.0, 1.0, count)
    wild = random.random(count) < 0.02
    return np.where(wild, random.choice([np.nan, np.inf, 1e9, 0.0], count), scores)
