"""Graphs of tables and conditions as nested blocks: where branches meet, and cycles refused."""

import pytest

from dataplane.compiler.control import joins, order
from dataplane.errors import ProgramError
from dataplane.v1model.tree import ConditionNode, Const, Node, Pipeline


def pipeline(**edges: tuple[str | None, str | None]) -> Pipeline:
    nodes: dict[str, Node] = {n: ConditionNode(n, Const(1), yes, no) for n, (yes, no) in edges.items()}
    return Pipeline("ingress", next(iter(edges)), nodes)


def test_branches_meet_at_the_first_common_node():
    graph = pipeline(a=("b", "c"), b=("d", "d"), c=("d", "d"), d=("e", None), e=(None, None))
    assert joins(graph) == {"a": "d", "b": "d", "c": "d", "d": None, "e": None}
    assert order(graph)[0] == "a"


def test_a_branch_that_skips_ahead():
    graph = pipeline(a=("b", "d"), b=("c", "d"), c=("d", None), d=(None, None))
    assert joins(graph) == {"a": None, "b": None, "c": None, "d": None}


def test_unreachable_nodes_are_left_out():
    assert order(pipeline(a=(None, None), b=("a", "a"))) == ["a"]


def test_cycles_are_refused():
    with pytest.raises(ProgramError, match="cycle through a in the ingress pipeline"):
        order(pipeline(a=("b", None), b=("a", None)))
