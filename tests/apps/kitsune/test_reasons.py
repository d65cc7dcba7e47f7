"""What an alert says of a sender: compared with training, and which autoencoders and features moved most."""

import numpy as np
import pytest

from apps.kitsune.kitnet import KitNet
from apps.kitsune.reasons import _comparisons, explanations, reason
from apps.kitsune.senders import AnomalousSecond, SenderRecord, Tally
from tests.naive.kitsune.reasons import moved_most


@pytest.mark.parametrize(
    ("hosts", "end"), [(0, "40 packets/s"), (1, "40 packets/s to 1 host"), (7, "40 packets/s to 7 hosts")]
)
def test_hosts_are_named_where_there_are_any(hosts, end):
    """A second of packets without addresses was sent to no host: then none is counted."""
    (text,) = _comparisons("a camera", 40, 0, hosts, 0)
    assert text.endswith(end)


@pytest.mark.parametrize("groups", [[range(100)], [range(7), range(7, 20), [20], range(21, 100)]])
def test_what_moved_most_is_found_as_in_python(groups):
    """Groups of different sizes, features and errors that are no numbers, rows behind those of training."""
    random = np.random.default_rng(len(groups))
    model = KitNet(100, fm_grace=10, ad_grace=20, feature_map=[list(group) for group in groups])
    model.learn(random.normal(size=(31, 100)))
    features, errors = random.normal(scale=3, size=(40, 100)), random.random((30, len(groups)))
    features[15, 30], features[16, 3], errors[7, 0] = np.nan, np.inf, np.nan
    chosen = np.array([39, 10, 15, 16, 17, 25], np.int32)
    with np.errstate(invalid="ignore"):
        wanted = [moved_most(model, features[row], errors[row - 10]) for row in chosen]
    assert model.moved_most(features, errors, chosen, 10) == wanted
    assert model.moved_most(features, errors, chosen[:0], 10) == []


@pytest.mark.parametrize(
    ("moved", "end"),
    [
        (
            [3, 1, 0, 1],
            "3 and 1 moved most: rate of packets from this MAC and address over 0.2 s, mean size of packets from this MAC and address over 0.2 s",
        ),
        ([0, -1, 52, -1], "0 moved most: spread of gaps between packets of the two hosts over 0.2 s"),
    ],
)
def test_a_reason_compares_and_names_what_moved(moved, end):
    record = SenderRecord(("s1", 1, 2, (4, 0, 0xC0A80201)), training_rate=5)
    (evidence,) = explanations([moved])
    tally = Tally(packets=9, over=8, peak=3.0, evidence=evidence)
    assert reason(AnomalousSecond(7, record, tally, 1), 1.0) == (
        "192.168.2.1 sends no more than in training, but differently; "
        f"8 of 9 packets scored over 1, the highest 3; autoencoders {end}"
    )
