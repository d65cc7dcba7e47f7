"""Tables and lines stay within 100 columns, and no word is cut."""

import os
import subprocess
import sys

from hypothesis import given
from hypothesis import strategies as st

from sdnator.cli.main import COMMANDS, GROUPS
from sdnator.cli.plain_table import WIDTH, fitted, plain_table

WORDS = st.lists(st.text("abcd", min_size=1, max_size=12), max_size=40).map(" ".join)


@given(st.lists(st.tuples(WORDS, WORDS, WORDS), min_size=1, max_size=6))
def test_no_line_is_longer_and_every_word_is_there(rows):
    shown = plain_table(("a", "b", "c"), rows)
    assert max(map(len, shown.split("\n"))) <= WIDTH
    given_words = sorted(word for row in rows for cell in row for word in cell.split())
    assert sorted(" ".join(shown.split("\n")[1:]).split()) == given_words


def test_a_name_that_is_longer_than_a_line_is_whole():
    name = "network." + "x" * 120
    assert name in plain_table(("key", "made by"), [(name, "kitsune")])
    assert name in fitted(f"  a b {name}")


def test_help_is_in_groups_and_fits():
    """On a terminal of 200 columns, too."""
    done = subprocess.run(
        [sys.executable, "-m", "sdnator.cli.main", "--help"],
        capture_output=True, text=True, check=True, env={**os.environ, "COLUMNS": "200"},
    )  # fmt: skip
    assert max(map(len, done.stdout.splitlines())) <= WIDTH
    places = [done.stdout.index(f" {group} ─") for group in GROUPS]
    assert places == sorted(places)
    assert {name for names in GROUPS.values() for name in names} <= set(COMMANDS)
