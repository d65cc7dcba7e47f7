"""Kitsune refuses what is no batch of packets, counts it, and goes on with what is one."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as examples

from apps.kitsune.afterimage import AfterImage
from apps.kitsune.kernel import ColumnError
from apps.kitsune.model_instructions import INSTRUCTIONS
from apps.kitsune.service import BLOCKS, INTERESTS, PACKETS, SCORE, SWITCHES, KitsuneService, Settings
from sdnator.testing.packet_rows import blank, part
from tests.apps.firewall.enforcement.test_eve import decision
from tests.apps.hostile import NOW, Hands, mutations, values
from tests.naive.kitsune.afterimage import PythonAfterImage

KEY = "network.packets.p4runtime_ctrl.s1.all"
SWITCH = "network.switch.p4runtime_ctrl.s1"
BLOCK = "network.block.firewall.ipv4"
ROWS = 20
GENUINE = {
    PACKETS: (KEY, blank(ROWS, time_us=np.full(ROWS, NOW // 1000))),
    BLOCKS: (BLOCK, decision().to_value()),
    INSTRUCTIONS: (INSTRUCTIONS, {"id": "o1", "verb": "retrain"}),
    SWITCHES: (SWITCH, {"switch": "s1", "event_time": NOW, "arrival": 3}),
}


def started():
    engine = Hands()
    service = KitsuneService(engine, Settings(fm_grace=20, ad_grace=20))  # type: ignore[arg-type]
    service.start()
    return engine, service


def mixed(count):
    """Packets of three hosts at steady times."""
    random = np.random.default_rng(1)
    hosts = random.integers(1, 4, (2, count))
    addresses = {"ip_version": np.full(count, 4), "ip_src_lo": hosts[0], "ip_dst_lo": hosts[1]}
    times = NOW // 1000 + 10_000 * np.arange(count)
    return blank(count, time_us=times, length=random.integers(60, 1500, count), **addresses)


def still_works(engine, service):
    before = service.health()["packets"]
    engine.hand(PACKETS, *GENUINE[PACKETS])
    assert service.health()["packets"] == before + ROWS
    assert engine.values(SCORE)[-1]["count"] == ROWS


def test_all_interests_are_tried():
    """A new interest of Kitsune has to be fuzzed, too."""
    assert {interest.key for interest in INTERESTS} == GENUINE.keys()


@pytest.mark.parametrize("pattern", GENUINE)
def test_hostile_values_are_refused_and_counted(pattern, caplog):
    """Every wrong value under every key leaves Kitsune alive; the log stays short."""
    key, genuine = GENUINE[pattern]
    engine, service = started()
    number = 0
    for number, value in enumerate(mutations(genuine), start=1):  # noqa: B007 - the last one is used
        engine.hand(pattern, key, value)
    still_works(engine, service)
    health = service.health()
    assert health["refused_messages"] > number / 5
    assert sum(health["refused_by_cause"].values()) == health["refused_messages"]
    assert sum("refused a message" in record.message for record in caplog.records) < 20


@pytest.mark.parametrize("pattern", GENUINE)
def test_nobody_speaks_for_another_app(pattern):
    """A genuine message under another app's key does nothing, and is counted."""
    engine, service = started()
    engine.hand(pattern, *GENUINE[pattern], app="intruder")
    health = service.health()
    assert health["refused_by_cause"] == {"sender": 1}
    assert (health["packets"], health["blocked"]) == (0, 0)


@examples(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(values)
def test_any_plain_value_under_any_key(value):
    """Whatever values hypothesis makes, no callback raises."""
    engine, service = started()
    for pattern, (key, genuine) in GENUINE.items():
        engine.hand(pattern, key, value)
        if isinstance(genuine, dict) and isinstance(value, dict):
            engine.hand(pattern, key, {**genuine, **value})
    still_works(engine, service)


def test_one_time_far_ahead_changes_no_other_score():
    """Packets around one from the year 2073 score as if it had come in time."""
    batch = mixed(400)
    damaged = {name: batch[name].copy() for name in batch}
    damaged["time_us"][350] += 50 * 365 * 86_400 * 1_000_000
    mended = {name: batch[name].copy() for name in batch}
    mended["time_us"][350] = batch["time_us"][:350].max()
    found = []
    for given_batch in (damaged, mended):
        engine, _ = started()
        for at in range(0, 400, 50):
            engine.hand(PACKETS, KEY, part(given_batch, at, at + 50))
        found.append(np.concatenate([value["score"] for value in engine.values(SCORE)]))
    assert np.isfinite(found[0]).all()
    assert np.allclose(found[0][351:], found[1][351:], rtol=1e-6)


@pytest.mark.parametrize("kind", [PythonAfterImage, AfterImage])
def test_columns_of_other_lengths_are_refused(kind):
    """A longer time column must not be read beyond the end of the others."""
    image = kind()
    columns = dict(blank(5))
    for name, wrong in (
        ("time_us", np.zeros(5000, "i8")),
        ("tcp_sport", np.zeros(4, "i4")),
        ("eth_src", np.zeros((5, 2), "u8")),
        ("length", np.array(["a"] * 5)),
        ("length", np.array(["2020"] * 5, "M8[ns]")),
    ):
        with pytest.raises(ColumnError):
            image.update({**columns, name: wrong})
    del columns["ip_src_lo"]
    with pytest.raises(ColumnError, match="ip_src_lo"):
        image.update(columns)
    assert image.update(blank(5)).shape == (5, 100)
