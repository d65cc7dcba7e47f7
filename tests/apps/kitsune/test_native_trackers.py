"""The C trackers of senders and victims return what their Python twins return, and the whole detector does."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apps.kitsune import senders as senders_module
from apps.kitsune import victims as victims_module
from apps.kitsune.accused import Accused
from apps.kitsune.afterimage import AfterImage, seconds
from apps.kitsune.kernel import ColumnError, load_kernel
from apps.kitsune.kernel_rows import KernelRows, RowRoom
from apps.kitsune.senders import Senders
from apps.kitsune.victims import VictimRates
from apps.messages import Target
from sdnator.testing.packet_rows import part
from tests.apps.firewall.enforcement.test_eve import decision
from tests.apps.kitsune.behaviour.test_native import plain
from tests.apps.kitsune.random_traffic import scores_of, traffic
from tests.naive.kitsune.senders import PythonSenders
from tests.naive.kitsune.victims import PythonVictimRates

TRAINING = 700


def seconds_of(found):
    """What is told of anomalous seconds."""
    return repr(
        [(each.second, each.record.identity, each.record.training_rate, *_tally(each)) for each in found]
    )


def _tally(each):
    tally = each.tally
    counted = (tally.packets, tally.over, tally.peak, tally.first_over, tally.hosts, tally.evidence)
    return (*counted, each.anomalous_seconds)


def records_of(senders):
    known = [
        (record.identity, record.training_rate, record.training_destinations, record.last_second)
        for record in senders.known()
    ]
    return sorted(known)


def feed(sides, random, start_s, left, step):
    count = int(random.integers(1, 400))
    batch, scores = traffic(random, count, start_s), scores_of(random, count) * 3
    trained, switch = min(left, count), f"s{count % 2}"
    how = {
        "scores": scores,
        "trained": trained,
        "threshold": 1.0,
        "evidence": lambda rows: rows * 1_000 + step,
    }
    found = [side.add(batch, switch, **how) for side in sides]
    assert seconds_of(found[0]) == seconds_of(found[1])
    assert records_of(sides[0]) == records_of(sides[1])
    who = (switch, 1, int(batch["eth_src"][-1]), (4, 0, int(batch["ip_src_lo"][-1])))
    assert sides[0].rates(who) == sides[1].rates(who)
    return left - trained


@pytest.mark.parametrize("small", [False, True], ids=["usual limits", "small limits"])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_anomalous_seconds_roles_and_rates_are_equal(small, seed):
    """Late packets, clocks set back, conversations, errors that quote, blocks, forgotten senders, a model file."""
    random = np.random.default_rng(seed)
    with pytest.MonkeyPatch.context() as patch:
        if small:
            patch.setattr(senders_module, "MOST_SENDERS", 30)
            patch.setattr(senders_module, "MOST_CONVERSATIONS", 20)
        sides, left, at = [PythonSenders(), Senders()], TRAINING, 100.0
        for step in range(14):
            left = feed(sides, random, at, left, step)
            at += float(random.choice([-30, 1, 20, 80]))
            if step == 6:
                address = Target(kind="mac", address="00:00:00:00:00:02")
                for side in sides:
                    side.blocked.decide(decision(id="d1", action="block", switch="s1", target=address))
            if random.random() < 0.2:
                assert seconds_of(sides[0].finish()) == seconds_of(sides[1].finish())
        assert sides[0].clock_jumps == sides[1].clock_jumps
        states = [json.loads(json.dumps(side.to_state())) for side in sides]
        assert plain(states[0]) == plain(states[1])
        again = [PythonSenders.from_state(states[0]), Senders.from_state(states[0])]
        feed(again, random, at, 0, 99)


@given(seed=st.integers(0, 2**32 - 1), most=st.sampled_from([5, 1_000]))
@settings(max_examples=10, deadline=None)
def test_usual_traffic_is_equal(seed, most):
    random = np.random.default_rng(seed)
    with pytest.MonkeyPatch.context() as patch:
        for name in ("MOST_KINDS", "MOST_SOURCES", "MOST_SOURCES_OF_ALL"):
            patch.setattr(victims_module, name, most)
        sides, left, at = [PythonVictimRates(), VictimRates()], TRAINING, 0.0
        for _ in range(8):
            count = int(random.integers(1, 300))
            batch, trained = traffic(random, count, at), min(left, count)
            for side in sides:
                side.add(batch, trained)
            left, at = left - trained, at + float(random.choice([-70, 0.5, 5]))
        assert sides[0].to_state() == sides[1].to_state()
        for host, kind, *_ in sides[0].to_state():
            assert sides[0].usual(host, kind) == sides[1].usual(host, kind)


def test_columns_that_do_not_fit_are_refused():
    """Neither missing ones nor others of another length reach C."""
    batch = dict(traffic(np.random.default_rng(1), 10, 0.0))
    rates = VictimRates()
    with pytest.raises(ColumnError, match="tcp_flags"):
        rates.add({name: column for name, column in batch.items() if name != "tcp_flags"}, 0)
    with pytest.raises(ColumnError, match="time_us"):
        rates.add({name: column for name, column in batch.items() if name != "time_us"}, 0)
    with pytest.raises(ColumnError, match="equally long"):
        rates.add({**batch, "port": batch["port"][:5]}, 0)


@pytest.mark.parametrize("mode", ["reference", "bounded"])
def test_features_of_columns_that_were_checked_before_are_the_same(mode):
    """A detector checks a batch once, for features and trackers."""
    batch, kernel = traffic(np.random.default_rng(3), 300, 0.0), load_kernel()
    one, other = (AfterImage(mode, kernel=kernel) for _ in range(2))
    for count in (300, 1, 0):
        given_columns = part(batch, 0, count)
        assert np.array_equal(one.update(given_columns), other.update(KernelRows(kernel, given_columns)))


@pytest.mark.parametrize("accused", [[], [2], [1, 5, 8, 77]])
def test_benign_packets_are_counted_as_the_accused_are_left_out(accused):
    """By C for drift, by numpy for the model that trains beside the one in use; memory of the batch before is reused."""
    random, kernel, known, room = np.random.default_rng(5), load_kernel(), Accused(), RowRoom()
    for mac in accused:
        known.accuse(mac, 0.0)
    for count in (300, 40):
        batch, scores = traffic(random, count, 0.0), scores_of(random, count)
        rows = KernelRows(kernel, batch, room)
        benign = known.benign(batch, 0.0)
        left = np.arange(count) >= 7
        left &= True if benign is None else benign
        found = rows.benign(7, scores, 0.5, known.macs(0.0))
        above, times = int(np.count_nonzero(~(scores[left] <= 0.5))), rows.seconds[left]
        assert found == (int(left.sum()), above, times.min(), times.max())
    assert len(known.macs(3_600.0)) == 0
    assert KernelRows(kernel, batch, room).benign(40, scores, 0.5, known.macs(0.0))[0] == 0


def test_scores_at_or_above_the_threshold_are_counted_as_by_numpy():
    """What is no number is above it, too."""
    random, kernel = np.random.default_rng(6), load_kernel()
    rows, scores = KernelRows(kernel, traffic(random, 300, 0.0)), scores_of(random, 300)
    scores[[8, 9, 10]] = 0.5, np.nan, np.inf
    for first in (0, 7, 300):
        assert rows.over(first, scores, 0.5) == np.count_nonzero(~(scores[first:] < 0.5))


def test_nanoseconds_become_seconds_as_in_numpy():
    """Before 1970, too, and whatever the layout."""
    random = np.random.default_rng(4)
    rows = dict(traffic(random, 999, 100.0).items())
    for times in (
        1_600_000_000_000_000_000 + random.integers(-(10**12), 10**12, 999),
        random.integers(-(2**62), 2**62, 1_998)[::2],
        np.arange(999, dtype="i4"),
    ):
        batch = rows | {"time_ns": times}
        assert KernelRows(load_kernel(), batch).seconds.tobytes() == seconds(batch).tobytes()
