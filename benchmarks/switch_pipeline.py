"""The compiled switch program alone, without ports and gRPC: `python -m benchmarks.switch_pipeline --json FILE`.

pipeline_pps: frames per second of the full program with 11 queries active and mixed traffic, batches of
1,024 frames from Python to Python, median of the rounds.  block_10k_ratio: the rate with 10,000 block_src
and 1,000 ternary block entries over that with 10, in the thread's own time, runs alternating.
pipeline_full_pps: the same with the entries that adapter and controller write for all eleven queries, and 10,000
blocks.  *_cpu_pps: frames per second of this thread's own time, which other programs hardly change; *_range: the
least and the most of the rounds.  pipeline_full_block_*: by blocks of frames, as ports hand them in, with no Python
object for a frame that leaves.
"""

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from benchmarks import measure
from benchmarks.switch_product import product_switch
from dataplane.frame_block import FrameBlock
from dataplane.v1model.program import load
from dataplane.v1model.switch import Replica, Switch
from dataplane.v1model.tables import Exact, Lpm, Range, TableEntry, Ternary
from dataplane.v1model.tree import Program

_PROGRAM = Path(__file__).resolve().parent.parent / "p4" / "sdnator.json"
_BATCH = 1024
_SECONDS = 1.0
_QUERIES = 11
_START_US = 60_000_000
_ALL = (1 << 256) - 1
_HOSTS = 1000
_BAD_FRAMES = 1_000_000
_ANY = Ternary(0, 0)
_SYN, _SYN_ACK, _DATA = 0x02, 0x12, 0x18


def main(argv: Sequence[str] | None = None) -> int:
    """Run, print, write."""
    chosen = measure.arguments("switch_pipeline", __doc__, rounds=9).parse_args(argv)
    figures = {"machine": measure.machine(), **figures_of(_SECONDS * chosen.scale, chosen.rounds)}
    for name, value in figures.items():
        print(f"{name:24} {value}")
    measure.write_json(chosen.json, figures)
    return 0


def figures_of(seconds: float, rounds: int) -> dict[str, Any]:
    """All figures; `seconds` of traffic for each round."""
    program = load(_PROGRAM.read_bytes())
    started = time.perf_counter()
    few = prepared(program, blocks=10, ternary=10)
    compiled = time.perf_counter() - started
    many = prepared(program, blocks=10_000, ternary=1000)
    full = product_switch(program)
    insert_blocks(full, blocks=10_000, ternary=0)
    frames = traffic(20 * _BATCH)
    ways: dict[str, Callable[[], tuple[float, float]]] = {
        "pipeline": lambda: rate(few, frames, seconds),
        "pipeline_full": lambda: rate(full, frames, seconds),
        "pipeline_full_block": lambda: rate(full, frames, seconds, in_blocks=True),
    }
    walls: dict[str, list[float]] = {name: [] for name in ways}
    own: dict[str, list[float]] = {name: [] for name in ways}
    ratios = []
    for _ in range(rounds):
        for name, way in ways.items():
            wall, busy = way()
            walls[name].append(wall)
            own[name].append(busy)
        ratios.append(rate(many, frames, seconds)[1] / own["pipeline"][-1])
    return {
        **{f"{name}_pps": round(statistics.median(found)) for name, found in walls.items()},
        **{f"{name}_cpu_pps": round(statistics.median(found)) for name, found in own.items()},
        **{f"{name}_cpu_range": [round(min(found)), round(max(found))] for name, found in own.items()},
        "block_10k_ratio": round(statistics.median(ratios), 3),
        "pipeline_load_s": round(compiled, 2),
        **shares(few, frames),
        **{f"full_{name}": share for name, share in shares(full, frames).items()},
        **bad_frames(few, frames, round(_BAD_FRAMES * min(1.0, seconds / _SECONDS))),
    }


def shares(switch: Switch, frames: Sequence[bytes]) -> dict[str, float]:
    """How many of the frames were copied to the controller, and made a digest."""
    result = switch.process_many(1, frames, range(_START_US, _START_US + len(frames)))
    return {
        "copied_share": round(len(result.packet_ins) / len(frames), 3),
        "digest_share": round(len(result.digests) / len(frames), 3),
    }


def bad_frames(switch: Switch, frames: Sequence[bytes], count: int) -> dict[str, int]:
    """Random bytes of 0 to 9,216 and mutilated frames: how many got their verdict, and how many did not parse."""
    random = Random(3)
    before = switch.statistics()["parser_errors"]
    survived = 0
    while survived < count:
        batch = [_bad(random, frames) for _ in range(min(_BATCH, count - survived))]
        survived += len(switch.process_many(1, batch, [_START_US] * len(batch)).verdicts)
    return {"bad_frames": survived, "bad_frames_unparsed": switch.statistics()["parser_errors"] - before}


def _bad(random: Random, frames: Sequence[bytes]) -> bytes:
    if random.random() < 0.5:
        return random.randbytes(random.choice([0, 1, 14, 60, 300, 1514, random.randint(0, 9216)]))
    data = bytearray(random.choice(frames))
    for _ in range(random.randint(1, 6)):
        data[random.randrange(len(data))] = random.getrandbits(8)
    return bytes(data[: random.randint(0, len(data))])


def rate(
    switch: Switch, frames: Sequence[bytes], seconds: float, *, in_blocks: bool = False
) -> tuple[float, float]:
    """Frames per second of the clock on the wall and of this thread's, over about `seconds`.

    The frames' own clock runs at 1 µs a frame.
    """
    starts = range(0, len(frames), _BATCH)
    none: list[int] = []
    blocks = [FrameBlock.of(none, none, frames[start : start + _BATCH]) for start in starts]
    sent = 0
    started, busy = time.perf_counter(), time.thread_time()
    while True:
        for start, block in zip(starts, blocks, strict=True):
            first, end = _START_US + sent, _START_US + sent + len(block.captured)
            if in_blocks:
                times = np.arange(first, end, dtype=np.int64)
                switch.process_block(1, FrameBlock(times, block.captured, block.captured, block.data))
            else:
                switch.process_many(1, frames[start : start + _BATCH], range(first, end))
            sent += len(block.captured)
        passed = time.perf_counter() - started
        if passed >= seconds:
            return sent / passed, sent / (time.thread_time() - busy)


def prepared(program: Program, *, blocks: int, ternary: int) -> Switch:
    """The program with 11 queries, wires, a protected service and so many block entries."""
    switch = Switch(program)
    switch.set_clone_session(1, [Replica(510, 1)])
    switch.tables["ingress.forward_port"].insert(TableEntry((Exact(1),), "ingress.to_port", (2,)))
    insert_blocks(switch, blocks, ternary)
    _queries(switch)
    return switch


def insert_blocks(switch: Switch, blocks: int, ternary: int) -> None:
    """`block_entries`, inserted."""
    for table, entry in block_entries(blocks, ternary):
        switch.tables[table].insert(entry)


def block_entries(blocks: int, ternary: int) -> Iterator[tuple[str, TableEntry]]:
    """Entries of block_src and block, with their table; for addresses that send nothing: every frame is
    looked up, none is stopped."""
    for n in range(blocks):
        yield "ingress.block_src", TableEntry((Exact(1), Exact(0xC0000000 + n)), "ingress.drop_src")
    random = Random(1)
    for n in range(ternary):
        yield "ingress.block", _block(random, n)


def _block(random: Random, n: int) -> TableEntry:
    """Blocks as an operator writes them: ten shapes of masks, varying prefixes."""
    key = [_ANY] * 12
    key[5] = Ternary(1, 1)
    length = random.choice([16, 20, 24, 28, 32])
    mask = ((1 << length) - 1) << (32 - length) | ((1 << 96) - 1) << 32
    key[6 + n % 2] = Ternary((0xC0000000 + n * 7919 * 256) % (1 << 32) & mask, mask)
    if n % 3 == 0:
        key[8] = Ternary(6, 0xFF)
    if n % 5 == 0:
        key[10] = Ternary(1 + n % 1000, 0xFFFF)
    return TableEntry(tuple(key), "ingress.drop_frame", (), 1 + n)


def _queries(switch: Switch) -> None:
    """Eleven queries, eight of them counted in the switch, two of them sending copies."""
    tables = switch.tables
    everything = (1 << _QUERIES) - 1
    for name in ("link", "src", "dst", "sport"):
        tables[f"ingress.telemetry_{name}"].set_default(f"ingress.match_{name}", (everything,))
    for n, prefix in enumerate((0x0A000000, 0x0A010000, 0x0A020000)):
        entry = TableEntry((Exact(1), Lpm(prefix, 112)), "ingress.match_src", (everything & ~(1 << n),))
        tables["ingress.telemetry_src"].insert(entry)
    l4 = tables["ingress.telemetry_l4"]
    syn, ack, udp, other = 0b00000011111, 0b00001100000, 0b11100000000, 0b00010000000
    shapes = ((6, _SYN, 0x17, syn), (6, _SYN_ACK, 0x17, ack), (6, 0, 0, other), (17, 0, 0, udp))
    for n, (protocol, flags, mask, queries) in enumerate(shapes):
        key = (Ternary(protocol, 0xFF), Ternary(flags, mask), Ternary(1, 1), _ANY)
        l4.insert(TableEntry(key, "ingress.match_l4", (queries | other,), 100 - n))
    ports = tables["ingress.telemetry_dport"]
    ports.set_default("ingress.match_dport", (everything & ~(0b10000000001),))
    ports.insert(TableEntry((Range(22, 23),), "ingress.match_dport", (everything,), 1))
    ports.insert(TableEntry((Range(53, 53),), "ingress.match_dport", (everything,), 1))
    tables["ingress.telemetry_active"].set_default(
        "ingress.set_active", (everything, 0b10000000000, 0b00001000000)
    )
    for stage in range(8):
        table = tables[f"ingress.count_{stage}.queries"]
        for query in (stage, stage + 8)[: 2 if stage + 8 < _QUERIES else 1]:
            bit = 1 << query
            reciprocal = (1 << 64) // 3_000_000
            params = (query, bit, 0, _ALL >> 128, 0, 0, 40, 0, reciprocal, 0, 32768, 0, 0)
            entry = TableEntry((Ternary(bit, bit),), f"ingress.count_{stage}.count", params, 1 + query)
            table.insert(entry)


def traffic(count: int) -> list[bytes]:
    """Mixed frames of 1,000 hosts: TCP data and SYNs, UDP, ICMP errors that quote, ARP, IPv6."""
    random = Random(2)
    makers: list[tuple[float, Callable[[Random], bytes]]] = [
        (0.55, lambda r: _ipv4(r, 6, _tcp(r, _DATA), r.choice([0, 40, 400]))),
        (0.70, lambda r: _ipv4(r, 6, _tcp(r, r.choice([_SYN, _SYN_ACK])), 0)),
        (0.88, lambda r: _ipv4(r, 17, _udp(r), 60)),
        (0.93, lambda r: _ipv4(r, 1, b"\3\3" + bytes(6) + _ipv4(r, 17, _udp(r), 0)[14:], 0)),
        (0.96, _arp),
        (1.00, _ipv6),
    ]
    frames = []
    for _ in range(count):
        chance = random.random()
        frames.append(next(make for limit, make in makers if chance < limit)(random))
    return frames


def _ends(random: Random) -> bytes:
    return (
        b"\2\0\0\0"
        + random.randrange(_HOSTS).to_bytes(2, "big")
        + b"\2\0\0\0"
        + random.randrange(_HOSTS).to_bytes(2, "big")
    )


def _address(random: Random) -> bytes:
    number = random.randrange(_HOSTS)
    return bytes([10, number % 4, number // 250, 1 + number % 250])


def _tcp(random: Random, flags: int) -> bytes:
    ports = random.randint(1024, 60000).to_bytes(2, "big") + random.choice([80, 443, 22, 23, 8080]).to_bytes(
        2, "big"
    )
    return ports + random.randbytes(8) + bytes([0x50, flags]) + b"\x20\0\0\0\0\0"


def _udp(random: Random) -> bytes:
    return (
        random.randint(1024, 60000).to_bytes(2, "big")
        + random.choice([53, 123, 10240]).to_bytes(2, "big")
        + b"\0\x44\0\0"
    )


def _ipv4(random: Random, protocol: int, body: bytes, payload: int) -> bytes:
    total = (20 + len(body) + payload).to_bytes(2, "big")
    head = (
        b"\x45\0" + total + b"\0\1\x40\0" + bytes([64, protocol, 0, 0]) + _address(random) + _address(random)
    )
    return _ends(random) + b"\x08\0" + head + body + bytes(payload)


def _arp(random: Random) -> bytes:
    ends = _ends(random)
    return ends + b"\x08\x06\0\1\x08\0\6\4\0\1" + ends[6:] + _address(random) + bytes(6) + _address(random)


def _ipv6(random: Random) -> bytes:
    addresses = b"\xfe\x80" + bytes(10) + _address(random) + b"\xfe\x80" + bytes(10) + _address(random)
    return _ends(random) + b"\x86\xdd\x60\0\0\0\0\x14\6\x40" + addresses + _tcp(random, _DATA)


if __name__ == "__main__":
    raise SystemExit(main())
