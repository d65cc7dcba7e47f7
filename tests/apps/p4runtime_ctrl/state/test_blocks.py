"""A decision becomes the entry that carries it out, or a reason why it cannot."""

import pytest

from apps.messages import Decision, Target
from apps.p4runtime_ctrl.errors import EntryError
from apps.p4runtime_ctrl.state.blocks import table_update
from sdnator.testing.product_program import program


def decision(action, target):
    return Decision(
        id="d1", action=action, switch="s1", target=target, reason="a test", event_time=1, expires=0
    )


@pytest.mark.parametrize(
    ("target", "handle"),
    [
        (Target(kind="ip", address="10.0.0.1"), "ingress.block_src[is_ipv4=1,src=10.0.0.1]"),
        (Target(kind="ip", address="2001:db8::1"), "ingress.block_src[is_ipv4=0,src=2001:db8::1]"),
        (
            Target(kind="mac", address="02:00:00:00:00:01", port=3),
            "ingress.block_mac[ingress_port=3,eth_src=02:00:00:00:00:01]",
        ),
        (Target(kind="mac", address="02:00:00:00:00:01"), "ingress.block[eth_src=02:00:00:00:00:01]@1"),
    ],
)
def test_block_and_unblock_are_one_entry(target, handle):
    for action, kind in (("block", "insert"), ("unblock", "delete")):
        update = table_update(decision(action, target), program())
        assert update.kind == kind
        assert program().describe(program().entry(update)) == handle


def test_a_target_that_is_no_address():
    with pytest.raises(EntryError, match=r"'10.0.0' is not an IP address"):
        table_update(decision("block", Target(kind="ip", address="10.0.0")), program())
