"""AfterImage as published, done the obvious way: one object per stream and scale, every link told at once.

As slow as the published code, and the denominator of the benchmark.

Reference:
    Mirsky et al., Kitsune, NDSS 2018, section IV-B.
"""

import math
from collections.abc import Mapping

LAMBDAS = (5, 3, 1, 0.1, 0.01)
"""Decay rates, 1/s."""


class _Stream:
    def __init__(self, name: str, rate: float, time: float, is_jitter: bool) -> None:
        self.name = name
        self.rate = rate
        self.is_jitter = is_jitter
        self.linear_sum: float = 0
        self.squared_sum: float = 0
        self.weight = 1e-20
        self.last = time
        self.cached_mean = math.nan
        self.cached_variance = math.nan
        self.cached_deviation = math.nan
        self.links: list[_Link] = []

    def insert(self, value: float, time: float) -> None:
        if self.is_jitter:
            gap = time - self.last
            value = max(0, gap)
        self.decay(time)
        self.linear_sum += value
        self.squared_sum += math.pow(value, 2)
        self.weight += 1
        self.cached_mean = math.nan
        self.cached_variance = math.nan
        self.cached_deviation = math.nan
        for link in self.links:
            link.update(self.name, value, time)

    def decay(self, time: float) -> None:
        gap = time - self.last
        if gap > 0:
            factor = math.pow(2, -self.rate * gap)
            self.linear_sum = self.linear_sum * factor
            self.squared_sum = self.squared_sum * factor
            self.weight = self.weight * factor
            self.last = time

    def mean(self) -> float:
        if math.isnan(self.cached_mean):
            self.cached_mean = self.linear_sum / self.weight
        return self.cached_mean

    def variance(self) -> float:
        if math.isnan(self.cached_variance):
            self.cached_variance = abs(self.squared_sum / self.weight - math.pow(self.mean(), 2))
        return self.cached_variance

    def deviation(self) -> float:
        if math.isnan(self.cached_deviation):
            self.cached_deviation = math.sqrt(self.variance())
        return self.cached_deviation

    def statistics(self) -> list[float]:
        return [self.weight, self.mean(), self.variance()]


class _Link:
    def __init__(self, first: _Stream, second: _Stream, time: float) -> None:
        self.ends = [first, second]
        self.residuals: list[float] = [0, 0]
        self.product_sum: float = 0
        self.weight = 1e-20
        self.last = time

    def update(self, name: str, value: float, time: float) -> None:
        near = 0 if name == self.ends[0].name else 1
        far = 1 - near
        self.ends[far].decay(time)
        gap = time - self.last
        if gap > 0:
            factor = math.pow(2, -self.ends[near].rate * gap)
            self.product_sum *= factor
            self.weight *= factor
            self.last = time
            self.residuals[near] *= factor
        residual = value - self.ends[near].mean()
        self.product_sum += residual * self.residuals[far]
        self.weight += 1
        self.residuals[near] = residual

    def covariance(self) -> float:
        return self.product_sum / self.weight

    def statistics(self) -> list[float]:
        first, second = self.ends
        radius = math.sqrt(math.pow(first.variance(), 2) + math.pow(second.variance(), 2))
        magnitude = math.sqrt(math.pow(first.mean(), 2) + math.pow(second.mean(), 2))
        deviations = first.deviation() * second.deviation()
        correlation = self.covariance() / deviations if deviations != 0 else 0
        return [radius, magnitude, self.covariance(), correlation]


class _StreamTable:
    def __init__(self) -> None:
        self.streams: dict[str, _Stream] = {}

    def stream(self, name: str, rate: float, time: float, is_jitter: bool = False) -> _Stream:
        key = name + "_" + str(rate)
        if key not in self.streams:
            self.streams[key] = _Stream(name, rate, time, is_jitter)
        return self.streams[key]

    def one(self, name: str, time: float, value: float, rate: float, is_jitter: bool = False) -> list[float]:
        stream = self.stream(name, rate, time, is_jitter)
        stream.insert(value, time)
        return stream.statistics()

    def pair(self, name: str, peer: str, time: float, value: float, rate: float) -> list[float]:
        result = self.one(name, time, value, rate)
        first = self.stream(name, rate, time)
        second = self.stream(peer, rate, time)
        for link in first.links:
            if link.ends[0].name == peer or link.ends[1].name == peer:
                break
        else:
            link = _Link(first, second, time)
            first.links.append(link)
            second.links.append(link)
        link.update(name, value, time)
        return result + link.statistics()


class NaiveAfterImage:
    """The features of one packet after the other; unlike the product's, it keeps every stream it has ever seen."""

    def __init__(self) -> None:
        self.mac_ip = _StreamTable()
        self.hosts = _StreamTable()
        self.jitter = _StreamTable()
        self.sockets = _StreamTable()

    def update(self, fields: Mapping[str, str]) -> list[float]:  # noqa: C901 - one screen, as published
        """Take a packet and return its 100 features.

        Args:
            fields: of tshark, as text, as `sdnator.testing.packet_rows.tsv_rows` gives them.
        """
        time, size = float(fields["frame.time_epoch"]), int(fields["frame.len"])
        source_mac, destination_mac = fields["eth.src"], fields["eth.dst"]
        if fields["ip.src"] or fields["ip.dst"]:
            source, destination = fields["ip.src"], fields["ip.dst"]
        else:
            source, destination = fields["ipv6.src"], fields["ipv6.dst"]
        source_port = fields["tcp.srcport"] + fields["udp.srcport"]
        destination_port = fields["tcp.dstport"] + fields["udp.dstport"]
        if source_port == "":
            if fields["arp.opcode"] != "":
                source_port = destination_port = "arp"
                source, destination = fields["arp.src.proto_ipv4"], fields["arp.dst.proto_ipv4"]
            elif fields["icmp.type"] != "":
                source_port = destination_port = "icmp"
            elif source + source_port + destination + destination_port == "":
                source, destination = source_mac, destination_mac
        if source_port == "arp":
            sockets = (source_mac, destination_mac)
        else:
            sockets = (source + source_port, destination + destination_port)
        mac_ip: list[float] = []
        hosts: list[float] = []
        gaps: list[float] = []
        between: list[float] = []
        for rate in LAMBDAS:
            mac_ip += self.mac_ip.one(source_mac + source, time, size, rate)
        for rate in LAMBDAS:
            hosts += self.hosts.pair(source, destination, time, size, rate)
        for rate in LAMBDAS:
            gaps += self.jitter.one(source + destination, time, 0, rate, is_jitter=True)
        for rate in LAMBDAS:
            between += self.sockets.pair(*sockets, time, size, rate)
        return mac_ip + hosts + gaps + between
