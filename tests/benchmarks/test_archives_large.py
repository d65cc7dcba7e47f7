"""The benchmark of a large archive finds as many items as it asks for, on a small one."""

import pytest

from benchmarks import archives, archives_large


def test_a_small_archive_is_filled_and_asked(monkeypatch, tmp_path, capsys):
    """Every query checks how many items it finds."""
    monkeypatch.setattr(archives_large, "KEYS", 20)
    monkeypatch.setattr(archives_large, "_QUERIES", 5)
    found = archives_large.figures_of(25_000, tmp_path)
    assert found["items"] == 24_000
    assert len(found["insert_items_per_s_tenths"]) == 10
    assert 200 < found["bytes_per_item"] < 300
    assert set(found["query_ms"]) == {"key_and_time", "pattern_and_time", "time"}
    assert not list(tmp_path.iterdir())
    archives_large.show(found)
    assert "24,000 items" in capsys.readouterr().out


@pytest.mark.parametrize("words", [["--items", "5"], ["--items", "200000", "--folder", "/nowhere"]])
def test_misuse_is_named(words, capsys):
    with pytest.raises(SystemExit) as ended:
        archives.main(words)
    assert ended.value.code == 2
    assert words[-1] in capsys.readouterr().err
