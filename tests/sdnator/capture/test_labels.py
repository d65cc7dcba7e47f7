"""Labels of all three forms read the same, and what does not fit is named with its line."""

import gzip

import numpy as np
import pytest

from sdnator.capture.labels import (
    Labels,
    LengthMismatch,
    MalformedLabels,
    MissingLabels,
    labels_path,
    read_labels,
    write_labels,
)
from sdnator.testing.table_samples import LABELS, OWN_LABELS


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("form", LABELS)
def test_three_forms(tmp_path, form, packed):
    """The same labels in three forms, plain and gzipped."""
    path = tmp_path / "labels"
    data = LABELS[form].encode()
    path.write_bytes(gzip.compress(data) if packed else data)
    labels = read_labels(path, 4)
    assert labels.attack.tolist() == [False, True, True, False]
    assert labels.first_attack == 1
    expected = {"aa:bb:cc:dd:ee:ff", "10.0.0.9"} if form == "own" else set()
    assert labels.attackers == expected
    assert labels.attacker(2) == ("10.0.0.9" if form == "own" else "")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "no labels"),
        ("index,label,attacker\n", "no labels"),
        ("index,label,attacker\n0,0,\n2,1,x\n", "line 3 is for packet '2' where 1 is due"),
        ("index,label,attacker\n0,0\n", "line 2 has 2 columns"),
        ("0\n1,2\n", "line 2 has 2 columns"),
        ("0\n2\n", "label 2 is '2'"),
        ("label\n0\n", "label 1 is 'label'"),
        ("0\n\n1\n", "line 2 has 0 columns"),
        ("\xff\xfe", "not a label file"),
    ],
)
def test_malformed(tmp_path, content, words):
    path = tmp_path / "labels.csv"
    path.write_bytes(content.encode("latin-1"))
    with pytest.raises(MalformedLabels, match=words) as caught:
        read_labels(path)
    assert str(path) in str(caught.value)


def test_cut_gzip_is_malformed(tmp_path):
    path = tmp_path / "labels.gz"
    path.write_bytes(gzip.compress(OWN_LABELS.encode())[:-12])
    with pytest.raises(MalformedLabels, match="not a label file"):
        read_labels(path)


def test_missing(tmp_path):
    with pytest.raises(MissingLabels, match="no such file"):
        read_labels(tmp_path / "none.csv")
    with pytest.raises(MissingLabels, match="cannot be read"):
        read_labels(tmp_path)


def test_length_mismatch(tmp_path):
    """Too few or too many labels are an error; a cut capture may have labels left over."""
    path = tmp_path / "labels.csv"
    path.write_text(OWN_LABELS)
    with pytest.raises(LengthMismatch, match="4 labels for 5 packets"):
        read_labels(path, 5)
    labels = read_labels(path)
    with pytest.raises(LengthMismatch):
        labels.for_packets(3)
    with pytest.raises(LengthMismatch):
        labels.for_packets(5, cut=True)
    assert len(labels.for_packets(3, cut=True)) == 3
    assert labels.for_packets(4) is labels


def test_written_labels_read_back(tmp_path):
    path = tmp_path / "out.labels.csv"
    labels = Labels.of(np.array([False, True, True]), ["", "a", "b"])
    write_labels(path, labels)
    assert path.read_text() == "index,label,attacker\n0,0,\n1,1,a\n2,1,b\n"
    again = read_labels(path, 3)
    assert again.names == ("", "a", "b")
    assert [p.name for p in tmp_path.iterdir()] == ["out.labels.csv"]


def test_no_attack_at_all():
    assert Labels.of([False, False]).first_attack is None
    assert Labels.of([]).first_attack is None
    with pytest.raises(LengthMismatch):
        Labels.of([True], ["a", "b"])


def test_labels_path():
    assert labels_path("x/OUT.pcap").name == "OUT.labels.csv"
    assert labels_path("OUT.pcap.gz").name == "OUT.labels.csv"
    assert labels_path("OUT").name == "OUT.labels.csv"
