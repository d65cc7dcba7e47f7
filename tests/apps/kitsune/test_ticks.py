"""A second is over when the switch's time has left it, also when no packet says so."""

import numpy as np
import pytest

from apps.kitsune.service import ALERT, PACKETS, SWITCHES, KitsuneService, Settings
from sdnator.testing.packet_rows import blank
from tests.apps.hostile import NOW, Hands

SECOND = 1_000_000_000
PACKETS_KEY = "network.packets.p4runtime_ctrl.{}.all"
STATE_KEY = "network.switch.p4runtime_ctrl.{}"


def packets(first, count, at_ns, length=60):
    return blank(
        count,
        time_us=np.full(count, at_ns // 1000) + np.arange(count),
        arrival=np.arange(first, first + count, dtype=np.uint64),
        length=np.full(count, length),
    )


def tick(engine, at_ns, arrival, switch="s1"):
    value = {"switch": switch, "event_time": at_ns, "arrival": arrival}
    engine.hand(SWITCHES, STATE_KEY.format(switch), value)


@pytest.fixture
def engine():
    """Kitsune has learnt sixty packets, and ten of this second were unlike them."""
    made = Hands()
    service = KitsuneService(made, Settings(fm_grace=20, ad_grace=40, threshold=1e-9))  # type: ignore[arg-type]
    service.start()
    made.hand(PACKETS, PACKETS_KEY.format("s1"), packets(0, 61, NOW - 5 * SECOND))
    made.hand(PACKETS, PACKETS_KEY.format("s1"), packets(61, 10, NOW, length=1500))
    assert made.values(ALERT) == []
    return made


def test_tick_of_a_silent_switch_raises_the_alert_of_the_last_second_once(engine):
    tick(engine, NOW + SECOND // 2, 70)
    assert engine.values(ALERT) == []
    for later in (1, 2):
        tick(engine, NOW + later * SECOND, 70)
    assert [alert["event_time"] for alert in engine.values(ALERT)] == [NOW + SECOND]


def test_tick_that_overtakes_packets_closes_nothing(engine):
    """The switch has sent a packet that has not been scored yet."""
    tick(engine, NOW + SECOND, 71)
    assert engine.values(ALERT) == []
    engine.hand(PACKETS, PACKETS_KEY.format("s1"), packets(71, 1, NOW + SECOND // 4))
    tick(engine, NOW + SECOND, 71)
    assert len(engine.values(ALERT)) == 1


def test_every_switch_must_have_left_the_second(engine):
    engine.hand(PACKETS, PACKETS_KEY.format("s2"), packets(0, 1, NOW))
    tick(engine, NOW + SECOND, 70)
    assert engine.values(ALERT) == []
    tick(engine, NOW + SECOND, 0, switch="s2")
    assert len(engine.values(ALERT)) == 1
