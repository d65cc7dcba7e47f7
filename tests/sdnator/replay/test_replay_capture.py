"""`sdnator.replay_capture` refuses wrong arguments before any process is started, and says what to give."""

import pytest

import sdnator
from sdnator.datasets.catalogue import TrainingLength
from sdnator.datasets.mirai_like import MiraiLikeOptions, make
from sdnator.datasets.names import NamedCapture
from sdnator.errors import BadInput
from sdnator.replay.replay_capture import _training


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    path = tmp_path_factory.mktemp("captures") / "short.pcap"
    make(MiraiLikeOptions(seed=2, benign_seconds=5, attack_seconds=1), path)
    return path


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"train": 10}, "at least 11 packets"),
        ({"train": (0, 5)}, r"train=\(0, 5\)"),
        ({"pace": 0.0}, "pace=0.0"),
        ({"pace": float("nan")}, "pace=nan"),
        ({"telemetry": "sflow"}, "packet-in"),
        ({"reaction": 0.0}, "reaction=0.0: give 0.001 to 60"),
        ({"train": 10_000_000}, "packets, but training alone needs 10,000,001"),
    ],
)
def test_a_wrong_argument_is_named(capture, arguments, text):
    """The error names the argument or the capture, and what would be accepted."""
    with pytest.raises(BadInput, match=text):
        sdnator.replay_capture(capture, **arguments)


def test_a_report_folder_with_other_files_is_refused_first(capture, tmp_path):
    """Nothing is replayed for a report that could not be written."""
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(BadInput, match="thesis"):
        sdnator.replay_capture(capture, report=tmp_path)


def test_a_missing_capture_is_named(tmp_path):
    """A path that leads nowhere is an error of the input."""
    with pytest.raises(BadInput, match=r"nowhere\.pcap"):
        sdnator.replay_capture(tmp_path / "nowhere.pcap")


@pytest.mark.parametrize(
    ("train", "published", "expected"),
    [
        (12_000, None, (1_090, 10_910)),
        ((30, 70), None, (30, 70)),
        (None, None, (5_000, 50_000)),
        (None, TrainingLength(fm_grace=100, ad_grace=900), (100, 900)),
        (11, TrainingLength(fm_grace=100, ad_grace=900), (1, 10)),
    ],
)
def test_training_is_split_as_published(tmp_path, train, published, expected):
    """One packet in eleven goes to the feature map; an argument wins over the data set's publication."""
    found = NamedCapture(capture=tmp_path / "some.pcap", labels=None, training=published)
    assert _training(train, found) == expected
