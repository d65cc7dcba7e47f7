"""The walk that both code generators share: graphs of nodes and states -> nested blocks.

p4c's pipelines are acyclic graphs whose branches meet again.  The place where all branches of a node
have met is its immediate post-dominator: a branch is written as a block that ends there.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from dataplane.compiler.layout import Layout, walk
from dataplane.compiler.simplify import simplify
from dataplane.errors import ProgramError, Unsupported
from dataplane.v1model.tree import (
    ConditionNode,
    Exit,
    Expression,
    If,
    Node,
    Parser,
    Pipeline,
    Program,
    Statement,
    TableNode,
)

MAX_TEXT = 32 << 20
"""Characters of generated code: where ways part and meet again without order, nodes are written many times."""
MAX_DEPTH = 90
"""Nested blocks; Python's own compiler takes 100."""
NO_ACTION = -1
"""What runs on a miss in a table without default action."""


def successors(node: Node) -> tuple[str | None, ...]:
    if isinstance(node, ConditionNode):
        return (node.yes, node.no)
    if node.by_hit:
        return (node.next_on_hit, node.next_on_miss)
    return (*node.next_by_action.values(), node.next_on_miss)


def order(pipeline: Pipeline) -> list[str]:
    """Nodes reachable from the start, each before its successors.  Raises ProgramError on a cycle."""
    state: dict[str, bool] = {}

    def following(name: str) -> tuple[str | None, ...]:
        ahead = successors(pipeline.nodes[name])
        for each in ahead:
            if each is not None and state.get(each) is False:
                raise ProgramError(f"cycle through {each} in the {pipeline.name} pipeline")
        return ahead

    return _depth_first(pipeline.start, following, state)[::-1]


def _depth_first(
    start: str | None, following: Callable[[str], tuple[str | None, ...]], state: dict[str, bool]
) -> list[str]:
    """Names reachable from the start, each behind what follows it; `state` is False while that is visited.

    Without recursion: a pipeline may be thousands of tables long.
    """
    done: list[str] = []
    path: list[tuple[str, Iterator[str | None]]] = []

    def enter(name: str) -> None:
        state[name] = False
        path.append((name, iter(following(name))))

    if start is not None:
        enter(start)
    while path:
        name, ahead = path[-1]
        further = next((each for each in ahead if each is not None and each not in state), None)
        if further is not None:
            enter(further)
        else:
            path.pop()
            state[name] = True
            done.append(name)
    return done


def joins(pipeline: Pipeline) -> dict[str, str | None]:
    """Immediate post-dominator of each node; None = the pipeline's end."""
    rank: dict[str | None, int] = {None: 1 << 30}
    names = order(pipeline)
    rank |= {name: i for i, name in enumerate(names)}
    result: dict[str, str | None] = {}

    def meet(a: str | None, b: str | None) -> str | None:
        while a != b:
            if rank[a] < rank[b]:
                a = result[a] if a is not None else None
            else:
                b = result[b] if b is not None else None
        return a

    for name in reversed(names):
        following = successors(pipeline.nodes[name])
        place = following[0]
        for other in following[1:]:
            place = meet(place, other)
        result[name] = place
    return result


def state_order(parser: Parser) -> list[str]:
    """Reachable states, in topological order as far as there is one."""

    def following(name: str) -> tuple[str | None, ...]:
        state = parser.states[name]
        return (*(case.next for case in state.cases), state.default)

    return _depth_first(parser.start, following, {})[::-1]


def may_exit(body: Sequence[Statement]) -> bool:
    return any(isinstance(node, Exit) for node in walk(tuple(body)))


class Generator(ABC):
    """Writes a pipeline as nested blocks; a subclass knows the language."""

    def __init__(self, program: Program, layout: Layout) -> None:
        self.program = program
        self.layout = layout
        self.lines: list[str] = []
        self.depth = 0
        self.written = 0

    def line(self, text: str) -> None:
        self.written += len(text)
        if self.written > MAX_TEXT or self.depth > MAX_DEPTH:
            raise Unsupported(
                f"a program of more than {MAX_TEXT} characters or {MAX_DEPTH} nested blocks, when it is written out,"
                " is not supported by the embedded switch"
            )
        self.lines.append("    " * self.depth + text)

    @contextmanager
    def block(self, head: str) -> Iterator[None]:
        self.open(head)
        yield
        self.close()

    @abstractmethod
    def open(self, head: str) -> None: ...

    @abstractmethod
    def close(self) -> None: ...

    @abstractmethod
    def expression(self, e: Expression) -> str:
        """A simplified expression as a value that can be tested or assigned."""

    @abstractmethod
    def statement(self, s: Statement) -> None: ...

    @abstractmethod
    def lookup(self, node: TableNode) -> None:
        """Code that finds the entry, counts and leaves hit, action and parameters in local names."""

    @abstractmethod
    def branch(self, head: str, condition: str) -> None:
        """Open `if`, `elif` (a further branch) or, with an empty condition, `else`."""

    @abstractmethod
    def leave_on_exit(self) -> None: ...

    @abstractmethod
    def nothing(self) -> None: ...

    @abstractmethod
    def begin_action(self, number: int) -> None:
        """The body of this action follows."""

    hit_test: str
    action_test: str
    either: str

    def run(self, body: Sequence[Statement]) -> None:
        if not body:
            self.nothing()
        for statement in body:
            if isinstance(statement, If):
                self.if_statement(statement)
            else:
                self.statement(statement)

    def if_statement(self, s: If) -> None:
        self.branch("if", self.expression(simplify(s.condition)))
        self.run(s.then)
        if s.otherwise:
            self.branch("else", "")
            self.run(s.otherwise)
        self.close()

    def pipeline(self, pipeline: Pipeline) -> None:
        self.joins = joins(pipeline)
        self.chain(pipeline, pipeline.start, None)

    def chain(self, pipeline: Pipeline, name: str | None, stop: str | None) -> None:
        if name == stop or name is None:
            self.nothing()
        while name is not None and name != stop:
            node = pipeline.nodes[name]
            if isinstance(node, ConditionNode):
                self.condition(pipeline, node)
                name = self.joins[name]
            else:
                name = self.table(pipeline, node)

    def condition(self, pipeline: Pipeline, node: ConditionNode) -> None:
        join = self.joins[node.name]
        self.branch("if", self.expression(simplify(node.condition)))
        self.chain(pipeline, node.yes, join)
        if node.no != join:
            self.branch("else", "")
            self.chain(pipeline, node.no, join)
        self.close()

    def table(self, pipeline: Pipeline, node: TableNode) -> str | None:
        if node.hidden_action is not None:
            body = self.program.actions[node.hidden_action].body
            self.run(body)
            if may_exit(body):
                self.leave_on_exit()
            return node.next_by_action.get(node.hidden_action, node.next_on_miss)
        self.lookup(node)
        bodies = {n: self.program.actions[n].body for n in node.actions}
        self.dispatch({n: b for n, b in bodies.items() if b})
        if any(may_exit(b) for b in bodies.values()):
            self.leave_on_exit()
        return self.follow(pipeline, node)

    def dispatch(self, bodies: dict[int, tuple[Statement, ...]]) -> None:
        head = "if"
        for number, body in bodies.items():
            self.branch(head, self.action_test.format(number))
            self.begin_action(number)
            self.run(body)
            head = "elif"
        if bodies:
            self.close()

    def follow(self, pipeline: Pipeline, node: TableNode) -> str | None:
        """Branch on hit or action where the way parts; the node where all ways have met."""
        if len(set(successors(node))) == 1:
            return successors(node)[0]
        join = self.joins[node.name]
        if node.by_hit:
            self.branch("if", self.hit_test)
            self.chain(pipeline, node.next_on_hit, join)
            self.branch("else", "")
            self.chain(pipeline, node.next_on_miss, join)
            self.close()
            return join
        ways: dict[str | None, list[int]] = {}
        for number, following in {**node.next_by_action, NO_ACTION: node.next_on_miss}.items():
            ways.setdefault(following, []).append(number)
        head = "if"
        for following, numbers in ways.items():
            if following != join:
                self.branch(head, self.one_of(numbers))
                self.chain(pipeline, following, join)
                head = "elif"
        if head != "if":
            self.close()
        return join

    def one_of(self, numbers: Sequence[int]) -> str:
        return self.either.join(self.action_test.format(n) for n in numbers)
