"""Entries are built by name, checked against the program, and shown by name."""

import pytest

from apps.messages import TableUpdate
from apps.p4runtime_ctrl.errors import EntryError, P4InfoError
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from sdnator.testing.product_program import program
from tests.requirements import shared_data


def insert(table, match, action, priority=0, **params):
    return TableUpdate(
        kind="insert", table=table, match=match, action=action, params=params, priority=priority
    )


def test_an_entry_and_its_name():
    update = insert("ingress.block_mac", {"ingress_port": 3, "eth_src": "02:00:00:00:00:01"}, "drop_mac")
    entry = program().entry(update)
    assert [match.exact.value for match in entry.match] == [b"\x03", b"\x02\x00\x00\x00\x00\x01"]
    assert program().describe(entry) == "ingress.block_mac[ingress_port=3,eth_src=02:00:00:00:00:01]"


def test_ternary_lpm_and_range_leave_out_what_matches_everything():
    match = {"src": ["10.0.0.0", "255.0.0.0"], "dport": 23, "dst": [0, 0]}
    entry = program().entry(insert("block", match, "drop_frame", 5))
    assert (
        program().describe(entry) == f"ingress.block[src=10.0.0.0&{hex((1 << 128) - (1 << 24))},dport=23]@5"
    )
    entry = program().entry(
        insert("telemetry_src", {"is_ipv4": 1, "src": "10.0.0.0/8"}, "match_src", queries=1)
    )
    assert program().describe(entry) == "ingress.telemetry_src[is_ipv4=1,src=10.0.0.0/8]"
    entry = program().entry(insert("telemetry_dport", {"dport": [0, 65535]}, "match_dport", 1, queries=1))
    assert not entry.match
    entry = program().entry(insert("telemetry_dport", {"dport": [80, 90]}, "match_dport", 1, queries=1))
    assert program().describe(entry) == "ingress.telemetry_dport[dport=80..90]@1"


def test_a_modify_without_match_is_the_default_action():
    update = TableUpdate(
        kind="modify",
        table="telemetry_active",
        action="set_active",
        params={"active": 1, "copies": 1, "digests": 0},
    )
    entry = program().entry(update)
    assert entry.is_default_action
    assert program().describe(entry) == "ingress.telemetry_active[default]"


@pytest.mark.parametrize(
    ("update", "reason"),
    [
        (insert("ingress.blok", {}, "x"), "no table 'ingress.blok' in the program; it has ingress.limit"),
        (insert("block_src", {"src": 1}, "drop_src"), "ingress.block_src is_ipv4: an exact match field needs"),
        (insert("block_src", {"source": 1}, "drop_src"), "no match field 'source'; it has is_ipv4, src"),
        (insert("block_src", {"is_ipv4": 2, "src": 1}, "drop_src"), "is_ipv4: 2 does not fit into 1 bits"),
        (insert("block_src", {"is_ipv4": 1, "src": 1}, "drop"), "no action 'drop' for this; allowed are ingress.drop_src"),
        (insert("block_src", {"is_ipv4": 1, "src": 1}, "pass_src"), "no action 'pass_src'"),
        (insert("block_src", {"is_ipv4": 1, "src": 1}, "drop_src", x=1), "no parameter 'x'; it takes none"),
        (insert("block_src", {"is_ipv4": 1, "src": 1}, "drop_src", 4), "have no priority"),
        (insert("block", {"dport": 1}, "drop_frame"), "priority of at least 1"),
        (insert("forward_port", {"ingress_port": 1}, "to_port"), "port: the parameter needs a value"),
        (insert("telemetry_dport", {"dport": [9, 3]}, "match_dport", 1, queries=0), "range 9..3 is empty"),
        (insert("block", {"dport": [1, 2, 3]}, "drop_frame", 1), "is not a pair"),
        (TableUpdate(kind="modify", table="block_src", action="drop_src"), "default action is constant"),
        (
            TableUpdate(
                kind="insert", table="forward_port", match={"ingress_port": 1}, action="to_port",
                params={"port": 2}, idle_timeout_ns=5,
            ),
            "no idle time-out",
        ),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_by_name(update, reason):
    with pytest.raises(EntryError) as caught:
        program().entry(update)
    assert reason in str(caught.value)


def test_a_foreign_program_is_read_and_its_lacks_are_named():
    small = ProgramInfo.from_text(shared_data("p4/small.p4info.txtpb").read_text())
    entry = small.entry(insert("acl", {"h.ip.src": "10.0.0.1"}, "fwd", 1, port=2))
    assert small.describe(entry) == "I.acl[h.ip.src=167772161]@1"
    with pytest.raises(P4InfoError, match="lacks timestamp"):
        small.header("packet_in", ["ingress_port", "timestamp"])
    for text in ("{ not a p4info", "tables { match_fields { match_type: 4294967295 } }"):
        with pytest.raises(P4InfoError, match="not a p4info"):
            ProgramInfo.from_text(text)


def test_a_table_with_an_action_that_is_not_there_is_refused():
    text = 'tables { preamble { id: 1 name: "t" } action_refs { id: 31829035 } }'
    with pytest.raises(P4InfoError, match="has action 31829035, which is not there"):
        ProgramInfo.from_text(text)
