"""Two veth pairs and a switch between them: what it forwards, copies and digests, embedded and BMv2 alike.

The sender raises its rate step by step; the figure is the highest rate that came through.  A step that
loses more than a tenth is the last.  block_10k_ratio: forwarding with 10,000 block_src and 1,000 ternary block
entries / with 10 of each; the sender may be slower than the embedded switch, whose own fall is measured without
wires (switch_pipeline).
"""

import os
import shutil
import socket
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks.switch_control import writes
from benchmarks.switch_pipeline import block_entries
from benchmarks.switch_stage import (
    ArrivalCounter,
    SwitchProcess,
    every_packet,
    frame,
    primary,
    process,
    program,
)
from benchmarks.switch_streams import count_stream, digest_entry
from dataplane.bmv2 import PROGRAM, Bmv2
from dataplane.p4runtime.schema import bind
from dataplane.p4runtime.table_codec import TableCodec
from dataplane.v1model.program import load
from p4rt import p4runtime
from sdnator.capture.interfaces import VethPair
from sdnator.testing.p4runtime_client import EntryBuilder, P4RuntimeClient, insert

RATES = (
    2_000,
    5_000,
    8_000,
    12_000,
    16_000,
    20_000,
    30_000,
    40_000,
    60_000,
    80_000,
    120_000,
    160_000,
    240_000,
)
_TICK_S = 0.002
_LOST = 0.1
_SETTLE_S = 0.4


def possible() -> bool:
    """Veth pairs need root."""
    return os.geteuid() == 0 and shutil.which("ip") is not None


def bmv2_installed() -> bool:
    return shutil.which(PROGRAM) is not None


def send_process(pipe: Any, interface: str) -> None:
    """Sends (rate, seconds) as told; answers with the number of frames."""
    raw = socket.socket(socket.AF_PACKET, socket.SOCK_RAW)
    raw.bind((interface, 0))
    sent_frame = frame()
    pipe.send("ready")
    while order := pipe.recv():
        rate, seconds = order
        started, sent = time.monotonic(), 0
        while (passed := time.monotonic() - started) < seconds:
            due = int(rate * passed) - sent
            for _ in range(due):
                raw.send(sent_frame)
            sent += max(due, 0)
            time.sleep(_TICK_S)
        pipe.send(sent)
    raw.close()


def wire(kind: str, folder: Path, seconds: float) -> dict[str, float]:
    """forward_pps, packet_in_pps, digest_pps and entries_per_s of `kind`: embedded or bmv2."""
    figures: dict[str, float] = {}
    for what in ("forward_pps", "forward_pps_10k_blocks", "packet_in_pps", "digest_pps"):
        with ExitStack() as stack:
            entry, leave = VethPair.make(stack, "bi"), VethPair.make(stack, "bo")
            controller = _switch(kind, folder / what, entry.far, leave.near, stack)
            names = EntryBuilder(program().p4info)
            seen = _prepare(what, controller, names, leave.far)
            pipe = stack.enter_context(process(send_process, entry.near))
            figures[what] = _highest(pipe, seen, seconds)
            if what == "digest_pps":
                figures |= writes(controller, 10_000, 500, 3)
    figures["block_10k_ratio"] = figures["forward_pps_10k_blocks"] / figures["forward_pps"]
    return figures


def _switch(kind: str, folder: Path, one: str, two: str, stack: ExitStack) -> P4RuntimeClient:
    if kind == "bmv2":
        address = stack.enter_context(Bmv2({1: one, 2: two})).address
    else:
        switch = SwitchProcess(folder, (f"1=veth:{one}", f"2=veth:{two}"))
        stack.callback(switch.close)
        address = switch.address
    controller = primary(address)
    stack.callback(controller.close)
    return controller


def _prepare(what: str, controller: P4RuntimeClient, names: EntryBuilder, out: str) -> Callable[[], int]:
    """Set the switch up; a counter of what has come through."""
    if what.startswith("forward_pps"):
        _block(controller, *((10, 10) if what == "forward_pps" else (10_000, 1_000)))
        action = names.tables["ingress.forward_port"].action_refs[0].id
        name = next(a.preamble.name for a in names.info.actions if a.preamble.id == action)
        controller.write(insert(names.entry("ingress.forward_port", {"ingress_port": 1}, name, [2])))
        statistics = Path(f"/sys/class/net/{out}/statistics/rx_packets")
        return lambda: int(statistics.read_text())
    every_packet(controller, names, copies=what == "packet_in_pps", digests=what == "digest_pps")
    if what == "digest_pps":
        controller.write(insert(digest_entry(names)))
    seen = ArrivalCounter()
    count_stream(controller, seen)
    return lambda: seen.total


def _block(controller: P4RuntimeClient, blocks: int, ternary: int) -> None:
    config = program()
    schema = bind(config.p4info, load(bytes(config.p4_device_config)))
    codecs = {name: TableCodec(schema.table_of(name)) for name in ("ingress.block_src", "ingress.block")}
    updates = []
    for name, entry in block_entries(blocks, ternary):
        entity = p4runtime.Entity()
        codecs[name].write(entry, entity.table_entry)
        updates.append(insert(entity))
    for first in range(0, len(updates), 500):
        controller.write(*updates[first : first + 500])


def _highest(pipe: Any, seen: Callable[[], int], seconds: float) -> float:
    best = 0.0
    for rate in RATES:
        before = seen()
        pipe.send((rate, seconds))
        sent = int(pipe.recv())
        time.sleep(_SETTLE_S)
        came = seen() - before
        best = max(best, min(came, sent) / seconds)
        if came < sent * (1 - _LOST):
            break
    return best
