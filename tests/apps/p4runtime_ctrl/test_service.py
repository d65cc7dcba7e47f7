"""The controller as a process between a real switch, real Data Updates and a real Coordinator."""

import numpy as np
import pytest
from scapy.utils import RawPcapReader

from apps.messages import TableCommand, TableUpdate
from apps.packets import PACKET_COLUMNS, read_frames
from dataplane.ports.capture_port import CaptureFeed
from due import Capability
from sdnator.testing.controller_run import BASE_US, PACKETS, ControllerRun, Heard, block, end, frame
from sdnator.testing.switch_target import SwitchTarget
from sdnator.testing.waiting import wait_for
from tests.requirements import shared_data

DECISIONS = Capability("network.block.firewall.*", delivery="reliable", archive="always")
CONFIRMATIONS = "network.confirmation.p4runtime_ctrl.*"
STATE = "network.switch.p4runtime_ctrl.s1"


@pytest.fixture
def stage(tmp_path):
    with ControllerRun(tmp_path) as made:
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
    assert "ended with exit code 0" in end(controller)


def test_the_state_of_a_silent_switch_is_repeated_and_archived_once(stage):
    """Or apps that subscribe after its last change would know nothing of it."""
    stage.controller()
    engine = stage.engine("late")
    heard = Heard(engine, STATE)

    def same() -> int:
        values = heard.values("switch")
        return sum(value == values[-1] for value in values)

    wait_for(lambda: same() >= 3, why=lambda: f"{heard.values('switch')}\n{stage.log()}")
    archived, before = len(engine.get(STATE)), len(heard.items)
    wait_for(lambda: len(heard.items) >= before + 3, why=stage.log)
    assert len(engine.get(STATE)) == archived


@pytest.mark.parametrize("archive_packets", [True, False])
def test_packets_are_archived_unless_the_settings_say_otherwise_and_states_always(stage, archive_packets):
    controller = stage.controller(archive_packets=archive_packets)
    engine = stage.engine("listener")
    heard = Heard(engine, PACKETS, STATE)
    wait_for(lambda: any("packets" in value["telemetry"] for value in heard.values("switch")), why=stage.log)
    feed = stage.feed()
    feed.send(range(100), [60] * 100, [frame(1)] * 100)
    wait_for(lambda: len(heard.arrivals()) == 100, why=stage.log)
    feed.close()
    assert "ended with exit code 0" in end(controller)
    assert sum(len(item.value) for item in engine.get(PACKETS)) == (100 if archive_packets else 0)
    assert engine.get(STATE)


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

    # until it has heard of the Coordinator the controller asks for everything
    wait_for(lambda: copied() == 0, why=stage.log)
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
    wait_for(lambda: any(v["telemetry"] == ["port2", "port1"] for v in heard.values("switch")), why=stage.log)
    feed = stage.feed()
    feed.send([1, 2], [60, 60], [frame(1), frame(2)])
    wait_for(lambda: sum(len(item.value) for item in heard.items if item.key == one) == 2, why=stage.log)
    assert not any(item.key == other for item in heard.items)
    feed.close()


CAPTURES = (
    "kitsune/mirai2000",
    "captures/ssh_guessing",
    "captures/ftp_bruteforce",
    "captures/synflood_one_source",
)


def real_frames():
    """Times in us since the first second, lengths on the wire and bytes, of real captures, one after the other."""
    times, lengths, frames = [], [], []
    for name in CAPTURES:
        with RawPcapReader(str(shared_data(f"{name}.pcap"))) as reader:
            found = [(m.sec * 1_000_000 + m.usec, m.wirelen, data) for data, m in reader]
        first = found[0][0] - (times[-1] if times else 0)
        times += [time - first for time, _, _ in found]
        lengths += [length for _, length, _ in found]
        frames += [frame for _, _, frame in found]
    return times, lengths, frames


def strange_frames():
    """What the switch's parser does not follow, between frames that it does."""
    ethernet = bytes.fromhex("0200000000ff020000000001")
    ports = bytes.fromhex("03e80035001a0000") + b"x" * 18

    def six(protocol, payload):
        head = b"\x86\xdd\x60" + bytes(3) + len(payload).to_bytes(2, "big") + bytes([protocol, 64])
        return ethernet + head + b"\x20\x01" + bytes(14) + b"\x20\x02" + bytes(14) + payload

    udp = frame(3)[12:]
    return [
        ethernet + bytes.fromhex("0032aaaa03000000") + udp,  # SNAP
        ethernet + bytes.fromhex("91000005") + udp,
        ethernet + bytes.fromhex("8100000581000006") + udp,
        ethernet + bytes.fromhex("810000058100000681000007") + udp,
        six(51, bytes.fromhex("1104") + bytes(22) + ports),  # authentication header
        six(136, ports),
        six(0, bytes.fromhex("3c00") + bytes(6) + bytes.fromhex("3c00") + bytes(6)
            + bytes.fromhex("3c00") + bytes(6) + bytes.fromhex("1100") + bytes(6) + ports),
        six(58, bytes.fromhex("0104") + bytes(6) + six(60, bytes.fromhex("1100") + bytes(6) + ports)[14:]),
        six(58, bytes.fromhex("8000") + bytes(6)),
        frame(4)[:30],
        frame(5)[:36],
        frame(5).replace(b"\x08\x00\x45", b"\x08\x00\x65", 1),
        frame(6)[:23] + b"\x02" + frame(6)[24:],  # IGMP
        frame(7)[:20] + b"\x00\x10" + frame(7)[22:],  # a later fragment
        ethernet[:9],
    ]  # fmt: skip


def all_frames():
    """A real capture with strange frames strewn in."""
    times, lengths, frames = real_frames()
    for place, strange in enumerate(strange_frames() * 4):
        at = 20 + 31 * place
        times.insert(at, times[at])
        lengths.insert(at, len(strange))
        frames.insert(at, strange)
    return times, lengths, frames


def told_of(state, count):
    """A state of after the last of so many digests, and of the records made from copies."""
    return state["digests"] == count and state["fell_back"] == state["packet_in"]


def test_digests_give_the_same_records_as_copied_frames(stage):
    times, lengths, frames = all_frames()
    stage.controller(telemetry="digest")
    engine = stage.engine("listener")
    heard = Heard(engine, PACKETS, STATE)
    wait_for(lambda: any(v["telemetry"] == ["packets"] for v in heard.values("switch")), why=stage.log)
    feed = stage.feed()
    feed.send(times, lengths, frames)
    wait_for(lambda: len(heard.arrivals()) == len(frames), 90, why=stage.log)
    # pings and the like of the capture come as copies, too
    wait_for(lambda: told_of(heard.values("switch")[-1], len(frames)), 90, why=stage.log)
    state = heard.values("switch")[-1]
    assert (state["skipped"], state["lost"]) == (0, 0)
    assert 4 * 12 <= state["packet_in"] < len(frames) // 4
    batches = [item.value for item in heard.items if item.key == PACKETS]
    got = {name: np.concatenate([batch[name] for batch in batches]) for name in PACKET_COLUMNS}
    padded = [frame.ljust(length, b"\0")[:256] for frame, length in zip(frames, lengths, strict=True)]
    count = np.arange(len(frames))
    want = read_frames(
        padded,
        lengths=lengths,
        times_us=np.array(times) + BASE_US,
        ports=np.ones(len(frames)),
        sequence=count + 1,
        arrival=count,
    )
    different = {name: np.flatnonzero(got[name] != want[name]).tolist()[:5] for name in PACKET_COLUMNS}
    assert not {name: rows for name, rows in different.items() if rows}
    feed.close()


def test_frames_are_published_to_who_wants_them(stage):
    stage.controller()
    engine = stage.engine("listener")
    heard = Heard(engine, "network.frames.p4runtime_ctrl.s1.all", STATE)
    wait_for(lambda: any(v["telemetry"] == ["packets"] for v in heard.values("switch")), why=stage.log)
    feed = stage.feed()
    feed.send([1, 2], [60, 60], [frame(1), frame(2)])
    wait_for(
        lambda: sum(len(value["frames"]) for value in heard.values("network.frames")) == 2, why=stage.log
    )
    values = heard.values("network.frames")  # in one batch or in two
    assert [each for value in values for each in value["frames"]] == [frame(1), frame(2)]
    sources = [source for value in values for source in read_frames(**value)["ip_src_lo"].tolist()]
    assert sources == [0x0A000001, 0x0A000002]
    feed.close()


def test_an_offer_is_sent_under_its_name_while_observed(stage):
    stage.controller()
    offers = Capability("network.telemetry.listener.*", delivery="reliable", archive="always")
    engine = stage.engine("listener", capabilities=(offers,))
    heard = Heard(engine, "network.packets.p4runtime_ctrl.s1.dns", STATE)
    offer = {"name": "dns", "bit": 3, "conditions": {"src": "10.0.0.2", "protocol": 17, "dport": 53}}
    wait_for(lambda: engine.wanted("network.telemetry.listener.dns"), why=stage.log)
    engine.write("network.telemetry.listener.dns", offer)
    wait_for(lambda: any(v["telemetry"] == ["dns"] for v in heard.values("switch")), why=stage.log)
    feed = stage.feed()
    feed.send([1, 2, 3], [60] * 3, [frame(1), frame(2), frame(3)])
    wait_for(lambda: heard.values("network.packets"), why=stage.log)
    assert [batch["arrival"].tolist() for batch in heard.values("network.packets")] == [[1]]
    engine.write("network.telemetry.listener.dns", {**offer, "active": False})
    wait_for(lambda: heard.values("switch")[-1]["telemetry"] == [], why=stage.log)
    feed.close()


def test_idle_entries_are_removed_by_the_capture_clock(stage):
    commands = Capability("network.p4_command.listener.*", delivery="reliable", archive="always")
    engine = stage.engine("listener", capabilities=(commands,))
    heard = Heard(engine, CONFIRMATIONS, STATE)  # before there is anything to confirm
    stage.controller()
    wait_for(lambda: engine.wanted("network.p4_command.listener.s1"), why=stage.log)
    wait_for(lambda: any(value["primary"] for value in heard.values("switch")), why=stage.log)
    entry = TableUpdate(
        kind="insert",
        table="block_src",
        match={"is_ipv4": 1, "src": "10.0.0.1"},
        action="drop_src",
        idle_timeout_ns=2_000_000_000,
    )
    wrong = TableUpdate(
        kind="insert", table="block_src", match={"is_ipv4": 1, "src": "10.0.0.300"}, action="drop_src"
    )
    engine.write("network.p4_command.listener.s1", TableCommand(id="c1", updates=(entry,)).to_value())
    engine.write("network.p4_command.listener.s1", TableCommand(id="c2", updates=(wrong,)).to_value())
    wait_for(lambda: len(heard.values("confirmation")) == 2, why=stage.log)
    good, bad = heard.values("confirmation")
    assert (good["id"], good["state"]) == ("c1", "installed")
    assert (bad["id"], bad["state"]) == ("c2", "failed")
    assert "ingress.block_src src: '10.0.0.300' is not a number" in bad["cause"]
    feed = stage.feed()
    for second in range(8):
        feed.send([second * 1_000_000], [60], [frame(2)])
    wait_for(lambda: any(v["state"] == "expired" for v in heard.values("confirmation")), why=stage.log)
    assert heard.values("confirmation")[-1]["handle"] == good["handle"]
    feed.close()


def test_stations_are_learnt_and_forgotten_by_the_capture_clock(tmp_path):
    with ControllerRun(tmp_path, forward={}, learn={"ports": [1, 2], "age_s": 2.0}) as stage:
        stage.controller(telemetry="digest")
        heard = Heard(stage.engine("listener"), PACKETS, STATE, CONFIRMATIONS)
        wait_for(lambda: any(v["telemetry"] == ["packets"] for v in heard.values("switch")), why=stage.log)
        feed = stage.feed()

        def learnt():
            return heard.values("network.switch")[-1]["learnt"]

        feed.send([1, 2], [60, 60], [frame(1), frame(2)])
        wait_for(lambda: learnt() == 2, 90, why=lambda: (heard.values("switch")[-1], stage.log()))
        wait_for(lambda: len(heard.arrivals()) == 2, 90, why=stage.log)
        sent = 2
        while learnt() == 2:
            feed.send([sent * 1_000_000], [60], [frame(2)])
            sent += 1
            assert sent < 100_000
            wait_for(lambda: len(heard.arrivals()) == sent, 90, why=stage.log)  # noqa: B023 - run at once
        assert learnt() == 1
        assert not heard.values("confirmation"), "nobody asked for these entries"
        feed.close()


def test_two_switches_are_kept_apart(stage, tmp_path):
    sockets = tmp_path / "second.sock"
    other = SwitchTarget("embedded", tmp_path, ports=(f"1=capture:{sockets}", "2=null"))
    other.start()
    try:
        first = {"name": "s1", "address": stage.target.address, "insecure": True, "forward": {"1": 2}}
        stage.controller(
            switches=[
                first,
                {**first, "name": "s2", "address": other.address, "base_us": 5_000_000},
            ]
        )
        engine = stage.engine(capabilities=(DECISIONS,))
        heard = Heard(engine, "network.packets.p4runtime_ctrl.*.all", CONFIRMATIONS, "network.switch.**")

        def telling():
            return {v["switch"] for v in heard.values("network.switch") if v["telemetry"] == ["packets"]}

        wait_for(lambda: telling() == {"s1", "s2"}, why=stage.log)
        engine.write("network.block.firewall.ipv4", block(1, 1).to_value())
        wait_for(lambda: len(heard.values("confirmation")) == 1, why=stage.log)
        feeds = {"s1": stage.feed(), "s2": CaptureFeed(str(sockets))}
        for feed in feeds.values():
            feed.send([1, 2], [60, 60], [frame(1), frame(2)])

        def column(switch, name):
            """Of all batches: two frames may come in one or in two."""
            batches = heard.values(f"network.packets.p4runtime_ctrl.{switch}.")
            return [value for batch in batches for value in batch[name].tolist()]

        wait_for(lambda: (column("s1", "arrival"), column("s2", "arrival")) == ([1], [0, 1]), why=stage.log)
        assert column("s2", "time_us") == [5_000_001, 5_000_002]
        other.kill()
        wait_for(
            lambda: any(v["switch"] == "s2" and not v["connected"] for v in heard.values("network.switch"))
        )
        engine.write("network.block.firewall.ipv4", block(2, 2).to_value())
        wait_for(lambda: any(v["id"] == "d2" for v in heard.values("confirmation")), why=stage.log)
        for feed in feeds.values():
            feed.close()
    finally:
        other.stop()


def test_wrong_settings_are_one_clear_line(tmp_path, capsys):
    from apps.p4runtime_ctrl import service

    settings = tmp_path / "s.json"
    settings.write_text('{"switches": [], "program": "/nowhere.json", "p4info": "/nowhere"}')
    assert service.main(["--settings", str(settings), "--directory", str(tmp_path), "--stay"]) == 2
