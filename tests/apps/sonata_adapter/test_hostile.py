"""The adapter refuses what is no message, counts it, and goes on with what is one."""

from itertools import count

import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as examples

from apps.packets import PACKET_COLUMNS
from apps.sonata_adapter.planner.placement import SwitchLimits
from apps.sonata_adapter.service import CELLS, INTERESTS, SWITCHES, TRAININGS, Settings, SonataAdapterService
from due import Assignment, Item, RecordBatch
from sdnator.testing.controller_run import frame
from tests.apps.hostile import NOW, Hands, mutations, values

PREFIX = "network.traffic_query.sonata"
WANTED = (
    f"{PREFIX}.port_scan", f"{PREFIX}.syn_flood:window=200ms", f"{PREFIX}.slowloris", f"{PREFIX}.dns_tunnel",
    f"{PREFIX}.zorro", f"{PREFIX}.new_tcp", f"{PREFIX}.incomplete_flows", "network.traffic_capture.sonata.tcp",
    "network.handshake.sonata.tcp", "network.evidence.sonata_adapter.arp_scan",
)  # fmt: skip
ROWS = 5
TIMES = np.arange(NOW // 1000, NOW // 1000 + ROWS)
STATE = (
    "network.switch.p4runtime_ctrl.s1",
    {"switch": "s1", "primary": True, "base_us": 0, "event_time": NOW},
)


def packets(**more):
    empty = {name: np.full(ROWS, -1 if kind[0] == "i" else 0, kind) for name, kind in PACKET_COLUMNS.items()}
    return RecordBatch({**empty, "arrival": np.arange(ROWS, dtype="u8"), "time_us": TIMES, **more})


COUNTS = ("window", "count", "src_hi", "src_lo", "dst_hi", "dst_lo", "port", "length", "source_port")
ONES = np.ones(ROWS, "u1")
GENUINE = {
    "switch": STATE[1],
    "training": {
        "packets": 5, "wanted": 10, "done": False, "seconds": 60.0, "senders": 2, "event_time": NOW,
    },
    "packets": packets(),
    "digests": packets(crossed=ONES, overflow=ONES),
    "counts": RecordBatch({**{name: np.ones(ROWS, "i8") for name in COUNTS}, "time_us": TIMES}),
    "frames": {
        "frames": [frame(1)] * ROWS, "lengths": np.full(ROWS, 60, "u4"), "times_us": TIMES,
        "ports": np.ones(ROWS, "u2"), "sequence": np.arange(ROWS, dtype="u8"), "arrival": np.arange(ROWS, dtype="u8"),
    },
    "cell": RecordBatch({"id": np.arange(ROWS, dtype="u8"), "count": np.ones(ROWS, "u4")}),
}  # fmt: skip


def started():
    engine = Hands()
    service = SonataAdapterService(engine, Settings(queries="/nowhere"))  # type: ignore[arg-type]
    service.start()
    engine.hand(SWITCHES, *STATE)
    engine.callback(tuple(Assignment(key) for key in WANTED))
    return engine, service


def places(engine, kind):
    """Pattern and key of what the adapter observes of a kind."""
    patterns = [pattern for pattern in engine.subjects if pattern.startswith(f"network.{kind}.")]
    return [(pattern, pattern.replace("*", "s1")) for pattern in patterns]


def still_works(engine, service):
    """A flood is found."""
    service.tick()
    before = service.health()["results"]
    for pattern, key in places(engine, "packets"):
        engine.hand(pattern, key, packets(tcp_flags=np.full(ROWS, 2), tcp_sport=ONES, tcp_dport=ONES))
    service.tick()
    assert service.health()["results"] >= before


def test_all_interests_are_tried():
    """What is observed for these queries is of every kind that there is."""
    engine, _ = started()
    assert {pattern.split(".")[1] for pattern in engine.subjects} <= GENUINE.keys()
    assert {interest.key for interest in INTERESTS} == {SWITCHES, TRAININGS}
    assert CELLS in engine.subjects or not places(engine, "cell")


@pytest.mark.parametrize("kind", GENUINE)
def test_hostile_values_are_refused_and_counted(kind, caplog):
    """Every wrong value of every kind leaves the adapter alive; the log stays short."""
    engine, service = started()
    found = places(engine, kind)[:1]
    number = 0
    for pattern, key in found:
        for value in mutations(GENUINE[kind]):
            number += 1
            engine.hand(pattern, key, value)
        service.tick()
    health = service.health()
    still_works(engine, service)
    assert found
    assert health["refused_messages"] > number / 5
    assert sum(health["refused_by_cause"].values()) == health["refused_messages"]
    assert sum("refused a message" in record.message for record in caplog.records) < 20


@pytest.mark.parametrize("kind", GENUINE)
def test_nobody_speaks_for_another_app(kind):
    """A genuine message under another app's key does nothing, and is counted."""
    engine, service = started()
    for pattern, key in places(engine, kind)[:1]:
        engine.hand(pattern, key, GENUINE[kind], app="intruder")
        assert service.health()["refused_by_cause"] == {"sender": 1}


@examples(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(values)
def test_any_plain_value_under_any_key(value):
    """Whatever values hypothesis makes, no callback raises."""
    engine, service = started()
    for pattern in list(engine.subjects):
        engine.hand(pattern, pattern.replace("*", "s1"), value)
    still_works(engine, service)


def test_one_time_far_ahead_closes_no_window():
    """Packets, reports and a state from the year 2073 are left out; what follows is not late."""
    engine, service = started()
    far = 50 * 365 * 86_400 * 1_000_000
    for ahead in (0, far, 1000):
        for kind in ("packets", "digests", "frames"):
            value = dict(GENUINE[kind])
            name = "times_us" if kind == "frames" else "time_us"
            value[name] = TIMES + np.array([0, 0, ahead, 0, 0])
            for pattern, key in places(engine, kind)[:1]:
                engine.hand(pattern, key, value if kind == "frames" else RecordBatch(value))
    service.tick()
    health = service.health()
    assert health["times_doubted"] >= 2
    assert health["late"] == 0


def test_a_clock_that_was_ahead_and_is_set_right_costs_few_packets():
    """Those that do not agree on the new time yet; everything after them has whole windows again."""
    engine = Hands()
    settings = Settings(queries="/nowhere", limits=SwitchLimits(stages=0))
    service = SonataAdapterService(engine, settings)  # type: ignore[arg-type]
    service.start()
    engine.hand(SWITCHES, *STATE)
    key = f"{PREFIX}.new_tcp:threshold=40,window=3s"
    engine.callback((Assignment(key),))
    ((pattern, stream),) = places(engine, "packets")
    begin, day, arrival = NOW // 1000, 86_400_000_000, count()
    begin -= begin % 3_000_000
    syns = {"tcp_flags": np.full(ROWS, 2), "tcp_sport": ONES, "tcp_dport": ONES, "ip_proto": np.full(ROWS, 6)}
    syns |= {"ip_version": np.full(ROWS, 4), "eth_type": np.full(ROWS, 0x800)}

    def send(first_us):
        times = first_us + np.arange(ROWS)
        numbers = np.array([next(arrival) for _ in times], dtype="u8")
        engine.hand(pattern, stream, packets(**syns, time_us=times, arrival=numbers))

    for ahead in (0, day, 0):
        for n in range(90):
            send(begin + ahead + n * 100_000)
    health = service.health()
    found = [value["window_start"] // 1000 for name, value in engine.written if name.startswith(PREFIX)]
    right = [begin, begin + 3_000_000, begin + 6_000_000]
    assert found == [*right, *(each + day for each in right), *right]
    assert (health["clocks_set_back"], health["times_doubted"], health["late"]) == (1, 4 + 19, 0)


def test_a_clock_that_was_set_back_has_the_switch_count_differences_anew():
    """What waits in it for the end of a window would wait for a far one: entries of another generation forget it."""
    engine, service = started()
    reports = GENUINE["digests"]
    ((pattern, key), *_) = places(engine, "digests")
    for ahead in (0, 86_400_000_000, 0, 0, 0, 0):
        engine.hand(pattern, key, RecordBatch({**reports, "time_us": TIMES + ahead}))
    command = [value for name, value in engine.written if name.startswith("network.p4_command.")][-1]
    assert service.health()["clocks_set_back"] == 1
    assert {update["kind"] for update in command["updates"]} == {"delete", "insert"}
    assert {"generation" in update["params"] for update in command["updates"] if update["params"]} == {True}


def test_switches_are_bounded_and_archives_are_checked():
    """Names of switches come from outside as well, and so does what is archived."""
    engine = Hands()
    for number, value in enumerate([None, {"base_us": "x"}, np.ones(2), STATE[1], {"primary": True}]):
        engine.archived.append(Item(STATE[0], value, NOW + number, NOW, "p4runtime_ctrl", "i", number))
    service = SonataAdapterService(engine, Settings(queries="/nowhere"))  # type: ignore[arg-type]
    service.start()
    for number in range(400):
        name = f"w{number}"
        engine.hand(SWITCHES, f"network.switch.p4runtime_ctrl.{name}", {**STATE[1], "switch": name})
    health = service.health()
    assert len(health["switches"]) == 256
    assert health["refused_by_cause"]["size"] == 145
    assert health["refused_messages"] == 148
