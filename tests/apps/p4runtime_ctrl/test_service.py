"""The controller as a process between a real switch, real Data Updates and a real Coordinator."""

import numpy as np
import pytest

from apps.packets import PACKET_COLUMNS
from due import Capability
from tests.apps.p4runtime_ctrl.stage import BASE_US, PACKETS, Heard, Stage, block, end, frame, wait_for

DECISIONS = Capability("network.block.firewall.*", delivery="reliable", archive="always")
CONFIRMATIONS = "network.confirmation.p4runtime_ctrl.*"
STATE = "network.switch.p4runtime_ctrl.s1"


@pytest.fixture
def stage(tmp_path):
    with Stage(tmp_path) as made:
        yield made


def test_packets_decisions_and_confirmations(stage):
    controller = stage.controller()
    engine = stage.engine(capabilities=(DECISIONS,))
    heard = Heard(engine, PACKETS, CONFIRMATIONS, STATE)
    wait_for(lambda: any("packets" in value["telemetry"] for value in heard.values("switch")), why=stage.log)
    feed = stage.feed()
    count = 5000
    frames = [frame(1 + n % 3) for n in range(count)]
    feed.send([1000 * n for n in range(count)], [len(f) for f in frames], frames)
    wait_for(lambda: len(heard.arrivals()) == count, why=stage.log)
    batches = [item for item in heard.items if item.key == PACKETS]
    assert list(batches[0].value.columns) == list(PACKET_COLUMNS)
    columns = {name: np.concatenate([b.value[name] for b in batches]) for name in PACKET_COLUMNS}
    assert columns["arrival"].tolist() == list(range(count))
    assert columns["sequence"].tolist() == list(range(1, count + 1))
    assert columns["time_us"].tolist() == [BASE_US + 1000 * n for n in range(count)]
    assert columns["ip_src_lo"][:3].tolist() == [0x0A000001, 0x0A000002, 0x0A000003]
    assert batches[-1].event_time == (BASE_US + 1000 * (count - 1)) * 1000

    engine.write("network.block.firewall.ipv4", block(1, 1).to_value(), event_time=1)
    wait_for(lambda: heard.values("confirmation"), why=stage.log)
    (confirmed,) = heard.values("confirmation")
    assert (confirmed["id"], confirmed["state"], confirmed["arrival"]) == ("d1", "installed", count - 1)
    feed.send([10_000_000 + n for n in range(30)], [60] * 30, [frame(1 + n % 3) for n in range(30)])
    wait_for(lambda: len(heard.arrivals()) == count + 20, why=stage.log)
    wait_for(
        lambda: any(b["packets"] == 10 for v in heard.values("switch") for b in v["blocks"]), why=stage.log
    )
    assert heard.values("switch")[-1]["lost"] == 0
    engine.write("network.block.firewall.ipv4", block(2, 1, "unblock").to_value(), event_time=2)
    wait_for(lambda: len(heard.values("confirmation")) == 2, why=stage.log)
    assert heard.values("confirmation")[1]["state"] == "removed"
    feed.close()
    assert end(controller) == 0


def test_packets_are_copied_only_while_somebody_wants_them(stage):
    stage.controller()
    engine = stage.engine("listener")
    state = Heard(engine, STATE)
    feed = stage.feed()

    def copied():
        feed.send([1], [60], [frame(1)])
        got = []
        wait_for(lambda: got.append(feed.verdicts()) or any(got))
        return b"".join(got)[0] & 1

    assert copied() == 0
    packets = Heard(engine, PACKETS)
    wait_for(
        lambda: any(value["telemetry"] == ["packets"] for value in state.values("switch")), why=stage.log
    )
    assert copied() == 1
    packets.stop()
    wait_for(lambda: state.values("switch")[-1]["telemetry"] == [], why=stage.log)
    assert copied() == 0
    feed.close()


def test_packets_of_one_port_are_a_key_of_their_own(stage):
    stage.controller()
    engine = stage.engine("listener")
    one, other = "network.packets.p4runtime_ctrl.s1.1", "network.packets.p4runtime_ctrl.s1.2"
    heard = Heard(engine, one, other, STATE)
    wait_for(lambda: any(v["telemetry"] == ["port1", "port2"] for v in heard.values("switch")), why=stage.log)
    feed = stage.feed()
    feed.send([1, 2], [60, 60], [frame(1), frame(2)])
    wait_for(lambda: any(item.key == one for item in heard.items), why=stage.log)
    assert sum(len(item.value) for item in heard.items if item.key == one) == 2
    assert not any(item.key == other for item in heard.items)
    feed.close()


def test_wrong_settings_are_one_clear_line(tmp_path, capsys):
    from apps.p4runtime_ctrl import service

    settings = tmp_path / "s.json"
    settings.write_text('{"switches": [], "program": "/nowhere.json", "p4info": "/nowhere"}')
    assert service.main(["--settings", str(settings), "--directory", str(tmp_path), "--stay"]) == 2
