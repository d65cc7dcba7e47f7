"""From demand and costs to processes, cores, memory, bytes and the bottleneck.  Pure.

    cores = idle + packets x cost of one in a long list + batches x cost of a batch x (1 - cores)

A packet costs less where more come at once, since batches are larger.  What one more packet costs in a batch that
comes anyway is the difference of two measured rates; the rest is what the batches cost.  A batch belongs to one
switch, so it is measured at one switch, at the rate of one.  What comes while a process is busy waits, and is taken
with what comes after it: the last factor.  So a busy process needs less for a packet, and is full when packets alone
fill it.  Between two measured rates cores are interpolated; beyond the highest, a packet costs what it costs there.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from sdnator.plan.costs import Costs, ProcessCost
from sdnator.plan.demand import PipelineDemand

ARCHIVE = "archive (SQLite)"
FULL = 0.7
"""Largest share of the cores to use on average; the rest is for bursts."""
MOST_SWITCHES = 256
"""That Kitsune and firewall follow (`apps.kitsune.service`, `apps.firewall.service`)."""
MOST_QUERIES = 256
"""Packet requests in one switch (`p4/include/telemetry.p4`)."""
MOST_BLOCKS = 4096
"""Of the firewall, by default (`rules.max_blocks`)."""
PARTITIONS = 4
"""Of a reliable topic on Kafka, by default."""
QUOTA_GB = 10 * (1 << 30) / 1e9
"""Of the embedded archive, by default."""
_SLIGHT_US = 0.05
_DAY_S = 86_400
_STEPS = 100


@dataclass(frozen=True)
class PartRow:
    """The processes of one name."""

    name: str
    processes: int
    each: float
    """Cores that one of them uses."""
    cores: float
    mib: float
    """Of all of them."""
    grows_with: tuple[str, ...]


@dataclass(frozen=True)
class Bottleneck:
    """What comes to its limit first."""

    name: str
    share: float
    """Of its limit, a core or what SQLite takes, that is used; above 1: it does not suffice."""
    pps: float
    """Packets a second, with the same switches, at which it comes to its limit; infinite: packets are not the cause."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a pipeline takes."""

    rows: tuple[PartRow, ...]
    processes: int
    cores: float
    """Used on average."""
    cores_to_provide: int
    """With room for bursts."""
    mib: float
    updates_in: float
    """Bytes a second that Data Updates receives; without replicas."""
    updates_out: float
    archive_gb_per_day: float
    archive_gb: float
    """For as many days as it keeps."""
    keys: int
    """Channels and streams on Data Updates; 0: not measured."""
    partitions: int
    """Of all topics, if Data Updates is Kafka."""
    bottleneck: Bottleneck
    notes: tuple[str, ...]


def plan(demand: PipelineDemand, costs: Costs) -> Plan:
    """What `demand` takes where parts cost what `costs` say."""
    rows = tuple(_row(name, cost, demand, costs.rates) for name, cost in costs.processes.items())
    cores = sum(row.cores for row in rows)
    archived = _archived(demand, costs, demand.pps)
    queries, consumers = demand.queries, demand.consumers
    received = at_rate(costs.rates, costs.updates_in, _rate(demand, demand.pps))
    sent = at_rate(costs.rates, costs.updates_out, _rate(demand, demand.pps))
    reliable, best_effort = costs.topics
    gb_per_day = archived * _DAY_S / 1e9
    return Plan(
        rows=rows,
        processes=sum(row.processes for row in rows),
        cores=cores,
        cores_to_provide=math.ceil(cores / FULL),
        mib=sum(row.mib for row in rows),
        updates_in=demand.switches * received + demand.pps * queries * costs.query_updates_in,
        updates_out=demand.switches * sent
        + demand.pps * (queries * costs.query_updates_out + consumers * costs.consumer_updates_out),
        archive_gb_per_day=gb_per_day,
        archive_gb=gb_per_day * demand.archive_days,
        keys=costs.keys + (demand.switches - 1) * costs.switch_keys + queries if costs.keys else 0,
        partitions=reliable * PARTITIONS + best_effort,
        bottleneck=bottleneck(demand, costs),
        notes=tuple(_notes(demand, costs, cores, gb_per_day)),
    )


def at_rate(rates: Sequence[float], per_packet: Sequence[float], rate: float) -> float:
    """What `rate` packets a second take a second, given what one takes at each of `rates`."""
    if not per_packet:
        return 0.0
    points = [(0.0, 0.0), *((at, at * each) for at, each in zip(rates, per_packet, strict=True))]
    for (low, below), (high, above) in pairwise(points):
        if rate <= high:
            return below + (above - below) * (rate - low) / (high - low)
    return rate * per_packet[-1]


def in_long_lists(rates: Sequence[float], per_packet: Sequence[float]) -> float:
    """What one more packet costs where many come at once: between the two highest rates, where both were measured.

    Args:
        rates: at which costs were measured, ascending.
        per_packet: what a packet cost at each of them, batches included.
    """
    if len(per_packet) < 2:
        return min(per_packet, default=0.0)
    (low, below), (high, above) = list(zip(rates, per_packet, strict=True))[-2:]
    slope = (high * above - low * below) / (high - low)
    return min(max(0.0, slope), *per_packet)


def bottleneck(demand: PipelineDemand, costs: Costs) -> Bottleneck:
    """The process, or the archive, that uses the largest share of its limit."""
    found = {name: _each(cost, demand, costs.rates, demand.pps) for name, cost in costs.processes.items()}
    if costs.sqlite_bytes_per_s:
        found[ARCHIVE] = _archived(demand, costs, demand.pps) / costs.sqlite_bytes_per_s
    name = max(found, key=lambda each: found[each])
    return Bottleneck(name, found[name], _full_at(name, demand, costs))


def _row(name: str, cost: ProcessCost, demand: PipelineDemand, rates: Sequence[float]) -> PartRow:
    each = _each(cost, demand, rates, demand.pps)
    number = demand.switches if cost.per_switch else 1
    further = 0.0 if cost.per_switch else (demand.switches - 1) * cost.switch_mib
    return PartRow(name, number, each, number * each, number * cost.mib + further, tuple(_grows_with(cost)))


def _each(cost: ProcessCost, demand: PipelineDemand, rates: Sequence[float], pps: float) -> float:
    """Cores of one process."""
    switches = 1 if cost.per_switch else demand.switches
    rate = _rate(demand, pps)
    one = at_rate(rates, cost.us_per_packet, rate) / 1e6
    packets = min(one, rate * in_long_lists(rates, cost.us_per_packet) / 1e6)
    busy = cost.idle_cores + one
    # of those batches that find the process idle; measured were those that did
    batches = (one - packets) / (1 - busy) if busy < 1 else 0.0
    more = demand.queries * cost.us_per_query + demand.consumers * cost.us_per_consumer
    fixed = cost.idle_cores + (switches - 1) * cost.switch_cores + switches * rate * more / 1e6
    least = fixed + switches * (packets if busy < 1 else one)
    return max(least, (least + switches * batches) / (1 + switches * batches))


def _archived(demand: PipelineDemand, costs: Costs, pps: float) -> float:
    """Bytes a second."""
    packets = demand.switches * at_rate(costs.rates, costs.archive, _rate(demand, pps))
    return packets + pps * demand.queries * costs.query_archive + demand.switches * costs.archive_idle


def _rate(demand: PipelineDemand, pps: float) -> float:
    return pps / demand.switches


def _share(name: str, demand: PipelineDemand, costs: Costs, pps: float) -> float:
    if name == ARCHIVE:
        return _archived(demand, costs, pps) / costs.sqlite_bytes_per_s
    return _each(costs.processes[name], demand, costs.rates, pps)


def _full_at(name: str, demand: PipelineDemand, costs: Costs) -> float:
    """Packets a second at which a share is 1, by bisection; it never falls with the rate."""
    if _share(name, demand, costs, 0.0) >= 1:
        return math.inf
    low, high = 0.0, demand.pps
    for _ in range(_STEPS):
        if _share(name, demand, costs, high) >= 1:
            break
        low, high = high, 2 * high
    else:
        return math.inf
    for _ in range(_STEPS):
        middle = (low + high) / 2
        low, high = (low, middle) if _share(name, demand, costs, middle) >= 1 else (middle, high)
    return low


def _grows_with(cost: ProcessCost) -> Iterator[str]:
    if cost.per_switch or cost.switch_cores or cost.switch_mib:
        yield "switches"
    if max(cost.us_per_packet, default=0.0) > _SLIGHT_US:
        yield "packets"
    if cost.us_per_query > _SLIGHT_US:
        yield "queries"
    if cost.us_per_consumer > _SLIGHT_US:
        yield "consumers"


def _notes(demand: PipelineDemand, costs: Costs, cores: float, gb_per_day: float) -> Iterator[str]:
    """What the figures do not say."""
    rate = _rate(demand, demand.pps)
    low, high = costs.rates[0], costs.rates[-1]
    if rate > high:
        yield (
            f"{rate:,.0f} packets a second at each switch is more than was measured (up to {high:,.0f}): "
            f"extrapolated from what a packet costs there"
        )
    elif rate < low:
        yield (
            f"{rate:,.3g} packets a second at each switch is less than was measured (from {low:,.0f}): batches are "
            "smaller there, so a packet costs more than is shown"
        )
    yield from _not_measured(demand, costs)
    if cores > costs.cores:
        yield f"the costs are from a machine with {costs.cores} cores; others are faster or slower"
    if demand.switches > MOST_SWITCHES:
        yield f"Kitsune and firewall follow {MOST_SWITCHES} switches at most: divide them between several pipelines"
    if demand.queries > MOST_QUERIES:
        yield f"a switch serves {MOST_QUERIES} requests for packets at most; some of these queries will be refused"
    if demand.blocks:
        yield (
            f"{demand.blocks:,} blocks are {demand.blocks * demand.switches:,} table entries, since each is in "
            "every switch; they hardly add CPU time to a packet, and how much memory they take was not measured"
        )
    if demand.blocks > MOST_BLOCKS:
        yield f"the firewall holds {MOST_BLOCKS:,} blocks at most, unless rules.max_blocks says otherwise"
    if gb_per_day * demand.archive_days > QUOTA_GB:
        yield (
            f"the default quota of the embedded archive keeps {_span(QUOTA_GB / gb_per_day)} of this; set quota of [up]"
        )


def _not_measured(demand: PipelineDemand, costs: Costs) -> Iterator[str]:
    """What the demand has and the costs have not."""
    processes = costs.processes.values()
    if demand.queries and not any(each.us_per_query for each in processes):
        yield "what a further query costs was not measured: nothing is counted for it"
    if demand.consumers and not any(each.us_per_consumer for each in processes):
        yield "what a further consumer costs was not measured: nothing is counted for it"
    if demand.switches > 1 and not any(each.switch_cores or each.switch_mib for each in processes):
        yield (
            "what a further switch without packets costs the processes of the pipeline was not measured: nothing is "
            "counted for it"
        )


def _span(days: float) -> str:
    return f"{days:.1f} days" if days >= 1 else f"{days * 24:.1f} hours"
