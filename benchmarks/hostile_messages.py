"""Messages between the apps, as values of DUE: each app's decoders, and what is made of packet columns behind them."""

import random
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np

from apps.enforcement import AllowedEntries, EnforcementReport, HeldBlock
from apps.enforcers import arrivals as enforcers
from apps.enforcers.webhook_enforcer.exchange import answer_in, listing_in
from apps.evidence import Evidence, TrainingState
from apps.firewall import arrivals as firewall
from apps.incidents import Incident
from apps.kitsune import service as kitsune
from apps.kitsune.model_instructions import ModelInstruction, instruction_in
from apps.messages import (
    Alert,
    Answer,
    Confirmation,
    Decision,
    Exhibit,
    FalseAlarm,
    Ground,
    Instruction,
    MessageError,
    Sender,
    TableCommand,
    TableUpdate,
    Target,
)
from apps.p4runtime_ctrl import arrivals as controller
from apps.p4runtime_ctrl.errors import EntryError
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.southbound.packet_out import PacketOuts
from apps.p4runtime_ctrl.telemetry.demand import Offer
from apps.packets import read_frames
from apps.sonata_adapter import arrivals as adapter
from apps.sonata_adapter.evidence.count_baseline import CountBaseline
from benchmarks.hostile_mutation import mutate_text, mutate_value
from benchmarks.hostile_target import DecoderTarget
from coordinator.admission import Admission
from coordinator.checkpoint import checkpoint_in
from coordinator.registry import Checkpoint, Registry
from due import Item, RecordBatch
from due.codec import decode_value, encode_value
from due.errors import DecodeError
from due.membership import Registration
from sdnator.p4_program import find
from sdnator.testing.switch_traffic import network_frame

_NOW = 1_700_000_000_000_000_000
_WRITERS = {"sonata": "sonata_adapter", "firewall_kept": "firewall"}
Decode = Callable[[Item], object]


def frames(count: int = 40) -> list[bytes]:
    """Network frames of all kinds that the product's tests know."""
    chance = random.Random(3)
    return [network_frame(chance) for _ in range(count)]


def packets() -> RecordBatch:
    """The columns of some frames."""
    found = frames()
    rows = np.arange(len(found))
    lengths = [len(frame) for frame in found]
    return read_frames(
        found,
        lengths=lengths,
        times_us=(rows + _NOW // 1000).tolist(),
        ports=[1] * len(found),
        sequence=(rows + 1).tolist(),
        arrival=rows.tolist(),
    )


def _decoding(key: str, decode: Decode) -> Callable[[bytes], object]:
    named = key.split(".")[2]
    app = _WRITERS.get(named, named)

    def attack(data: bytes) -> object:
        return decode(Item(key, decode_value(data), _NOW, _NOW, app, "i1", 1))

    return attack


def _target(app: str, key: str, decode: Decode, *values: Any) -> DecoderTarget:
    words = (app, decode.__name__.removesuffix("_in").strip("_"), key.split(".")[1])
    name = " ".join(word for word in words if word != "from_item")
    errors = (MessageError, DecodeError, EntryError)
    return DecoderTarget(name, _decoding(key, decode), errors, tuple(map(encode_value, values)), mutate_value)


_SENDER = Sender(switch="s1", port=3, mac="aa:bb:cc:dd:ee:ff", ip="10.0.0.1")
ALERT = Alert(
    id="a1", sender=_SENDER, event_time=_NOW, first_packet=7, packets=9, over=8, peak_score=2.5,
    anomalous_seconds=3, rate=9.0, training_rate=1.0, mac_addresses=1, reason="many",
)  # fmt: skip
_TARGET = Target(kind="ip", address="10.0.0.0/8")
DECISION = Decision(
    id="d1", action="block", switch="s1", target=_TARGET, reason="anomalous", event_time=_NOW, expires=_NOW + 1,
    evidence=(Exhibit(key="network.anomaly.kitsune.alert", timestamp=_NOW, summary="3 of 10"),),
)  # fmt: skip
CONFIRMATION = Confirmation(
    id="d1", switch="s1", state="installed", action="block", target=_TARGET, handle="t[a=1]", event_time=_NOW
)
_COMMAND = TableCommand(
    id="c1",
    updates=(
        TableUpdate(
            kind="insert",
            table="ingress.block_src",
            match={"is_ipv4": 1, "src": "10.0.0.1"},
            action="ingress.drop_src",
        ),
    ),
    requests=({"name": "q1", "bit": 3, "conditions": {"protocol": 6}, "copy": False, "active": True},),
)
_REPORT = EnforcementReport(
    enforcer="nftables", place="h1", working=True, event_time=_NOW, blocks=(HeldBlock(id="d1", target=_TARGET, packets=3),)
)  # fmt: skip
_LESSON = FalseAlarm(
    id="d1", grounds=(Ground(source="kitsune.targets", sender=_SENDER, service="tcp/445", nats=9.0),),
    event_time=_NOW, expires=_NOW + 1,
)  # fmt: skip
_INSTRUCTION = Instruction(id="i1", verb="block", subject="10.0.0.1", reason="mine", seconds=60)
STATE = {
    "switch": "s1", "primary": True, "event_time": _NOW, "base_us": _NOW // 1000,
    "blocks": [{"id": "d1", "packets": 5}], "change": "primary",
}  # fmt: skip
_OFFER = Offer(name="q1", bit=3, switch="s1", conditions={"ip.dst": "10.0.0.0/8", "tcp.flags": [2, 18]})
_TRAINING = TrainingState(packets=9, wanted=10, done=False, seconds=60.0, senders=3, event_time=_NOW)
_BASELINE = CountBaseline(
    text="query ddos", low=11, newcomer=20.0, middle=12.0, highest={"10.0.0.1": 12.0}, event_time=_NOW
)
_EVIDENCE = {
    "id": "e1", "kind": "scan", "source": "contacts", "sender": _SENDER.to_value(), "victims": ["10.0.0.2"],
    "victim_count": 1, "service": "tcp/22", "packets": 9, "text": "9 failed", "nats": 9.5, "since": _NOW, "event_time": _NOW + 5,
}  # fmt: skip
INCIDENT = {
    "id": "i1", "kind": "scan", "change": "opened", "attacker_text": "192.0.2.66", "begun": _NOW, "last": _NOW + 20,
    "event_time": _NOW + 20, "victims": ["192.0.2.1"], "attacker": _SENDER.to_value(), "nats": 12.0,
    "actions": [{"remedy": "block", "since": _NOW + 1, "effective": _NOW + 7}],
}  # fmt: skip
_QUESTIONS = RecordBatch({name: np.arange(4).astype(kind) for name, kind in controller.QUESTION.items()})
_SEND = {"port": [1, 2], "length": [3, 4], "frames": b"abcdefg"}


def _reported() -> RecordBatch:
    batch = packets()
    mark = np.ones(len(batch), "u1")
    return RecordBatch({**batch, "crossed": mark, "overflow": mark})


def _raw() -> dict[str, Any]:
    found, batch = frames(), packets()
    names = {
        "lengths": "length",
        "times_us": "time_us",
        "ports": "port",
        "sequence": "sequence",
        "arrival": "arrival",
    }
    return {"frames": found, **{name: batch[column] for name, column in names.items()}}


def _ones(**kinds: str) -> RecordBatch:
    return RecordBatch({name: np.ones(5, kind) for name, kind in kinds.items()})


_PROGRAM = ProgramInfo.from_text(find().p4info.read_text(encoding="utf-8"))
_OUTS = PacketOuts(_PROGRAM, _NOW // 1000)


def command_and_requests_in(item: Item) -> list[Any]:
    """A command, and the entries that it means."""
    command, _, requests = controller.command_and_requests_in(item)
    return [*(_PROGRAM.entry(update) for update in command.updates), *requests]


def frames_in(item: Item) -> list[Any]:
    """Frames for a switch, as packet-outs."""
    return _OUTS.frames(controller.frames_in(item))


def questions_in(item: Item) -> object:
    """A request for cells, as packet-outs."""
    return _OUTS.questions(controller.questions_in(item))


_CHECKPOINT = Checkpoint(
    epochs={"app": 7, "other": 9},
    active={"app": "i"},
    registrations=(Registration(app_id="app", instance_id="i", revision=1, heartbeat=0.5, started=1),),
)


def _checkpoint(data: bytes) -> Checkpoint:
    registry = Registry("c")
    return Admission(registry).checkpoint(checkpoint_in(decode_value(data)))


_COUNTED = {
    "window": "u4", "count": "i8", "src_hi": "u8", "src_lo": "u8", "dst_hi": "u8", "dst_lo": "u8", "port": "u2",
    "length": "u2", "source_port": "u2", "time_us": "i8",
}  # fmt: skip
_PACKETS = packets()
_SWITCH_KEY = "network.switch.p4runtime_ctrl.s1"

TARGETS = (
    _target("firewall", "network.anomaly.kitsune.alert", Alert.from_item, ALERT.to_value()),
    _target(
        "firewall", "network.confirmation.p4runtime_ctrl.s1", Confirmation.from_item, CONFIRMATION.to_value()
    ),
    _target("firewall", "network.enforced.nftables.h1", firewall.report_in, _REPORT.to_value()),
    _target("firewall", "network.false_alarm.firewall.taught", FalseAlarm.from_item, _LESSON.to_value()),
    _target("enforcers", "network.block.firewall.ipv4", enforcers.decision_in, DECISION.to_value()),
    _target(
        "enforcers",
        "network.allowed.firewall",
        enforcers.allowed_in,
        AllowedEntries(entries=("10.0.0.0/8", "aa:bb:cc:dd:ee:ff")).to_value(),
    ),
    _target(
        "kitsune",
        "network.instruction.operator.kitsune",
        instruction_in,
        ModelInstruction(id="o1", verb="retrain").to_value(),
    ),
    DecoderTarget(
        "webhook answer", answer_in, (MessageError,), (b'{"state": "installed", "cause": ""}',), mutate_text
    ),
    DecoderTarget(
        "webhook listing",
        listing_in,
        (MessageError,),
        (b'{"blocks": [{"id": "d1", "packets": 3}]}',),
        mutate_text,
    ),
    _target("firewall", "network.block.firewall.ipv4", Decision.from_item, DECISION.to_value()),
    _target("firewall", "network.p4_command.firewall.s1", TableCommand.from_item, _COMMAND.to_value()),
    _target("firewall", "network.instruction.cli.firewall", Instruction.from_item, _INSTRUCTION.to_value()),
    _target(
        "firewall",
        "network.answer.firewall.cli",
        firewall.answer_in,
        Answer(id="i1", done=True, text="x").to_value(),
    ),
    _target("firewall", _SWITCH_KEY, firewall.state_in, STATE),
    _target(
        "firewall",
        "network.handshake.sonata.tcp",
        firewall.handshake_in,
        {"source": "10.0.0.1", "service": "10.0.0.2", "port": 80, "at": _NOW},
    ),
    _target(
        "firewall",
        "network.traffic_query.sonata.syn_flood",
        firewall.flood_in,
        {"dst": "10.0.0.1", "count": 9, "window_start": _NOW},
    ),
    _target("firewall", "network.traffic_capture.sonata.tcp", firewall.syns_in, _PACKETS),
    _target("firewall", "network.traffic_capture.sonata.tcp", firewall.syn_acks_in, _PACKETS),
    _target("firewall", "network.traffic_capture.sonata.arp", firewall.arps_in, _PACKETS),
    _target("firewall", "network.evidence.kitsune.contacts", Evidence.from_item, _EVIDENCE),
    _target("firewall", "network.training.kitsune", firewall.training_in, _TRAINING.to_value()),
    _target("firewall", "network.incident.firewall.scan", Incident.from_item, INCIDENT),
    _target("kitsune", _SWITCH_KEY, kitsune.tick_in, STATE),
    _target(
        "controller",
        "network.clock.replay.s1",
        controller.ClockReached.from_item,
        {"switch": "s1", "event_time": _NOW},
    ),
    _target("kitsune", "network.packets.p4runtime_ctrl.s1.all", kitsune.packets_in, _PACKETS),
    _target("kitsune", "network.block.firewall.ipv4", Decision.from_item, DECISION.to_value()),
    _target("controller", _SWITCH_KEY, controller.told_in, STATE),
    _target("controller", "network.block.firewall.ipv4", Decision.from_item, DECISION.to_value()),
    _target("controller", "network.p4_command.app.s1", command_and_requests_in, _COMMAND.to_value()),
    _target("controller", "network.telemetry.firewall.q1", controller.offer_in, _OFFER.to_value()),
    _target("controller", "network.cell_request.sonata.s1", questions_in, _QUESTIONS),
    _target("controller", "network.packet_out.firewall.s1", frames_in, _SEND),
    _target("sonata", _SWITCH_KEY, adapter.state_in, STATE),
    _target(
        "sonata",
        "network.telemetry_counters.p4runtime_ctrl.s1",
        adapter.counters_in,
        _ones(bit="u1", packets="u8"),
    ),
    _target("sonata", "network.p4_command.sonata.s1", adapter.command_in, _COMMAND.to_value()),
    _target("sonata", "network.packets.p4runtime_ctrl.s1.q", adapter.data_in, _PACKETS),
    _target("sonata", "network.frames.p4runtime_ctrl.s1.q", adapter.data_in, _raw()),
    _target("sonata", "network.digests.p4runtime_ctrl.s1.q", adapter.data_in, _reported()),
    _target("sonata", "network.counts.p4runtime_ctrl.s1.q", adapter.data_in, _ones(**_COUNTED)),
    _target("sonata", "network.cell.p4runtime_ctrl.s1", adapter.cells_in, _ones(id="u8", count="u4")),
    _target("sonata", "network.training.kitsune", adapter.training_in, _TRAINING.to_value()),
    _target("sonata", "network.baseline.sonata_adapter.ddos", adapter.baseline_in, _BASELINE.to_value()),
    DecoderTarget(
        "coordinator checkpoint",
        _checkpoint,
        (DecodeError,),
        (encode_value(msgspec.to_builtins(_CHECKPOINT)),),
        mutate_value,
    ),
)
