"""Tables cut nothing and leave no blanks at line ends."""

from sdnator.cli.plain_table import plain_table


def test_columns_are_as_wide_as_their_widest_cell():
    long = "network.traffic_query.sonata.ddos:" + "x" * 300
    lines = plain_table(("by", "key"), [("sonata_adapter", long), ("a", "b")]).splitlines()
    assert lines == ["by              key", f"sonata_adapter  {long}", "a               b"]


def test_a_table_without_rows_is_its_head():
    assert plain_table(("packets", "entry"), []) == "packets  entry"
