"""The text form of queries.

    # hosts that try many ports
    query my_scan(window=3s, threshold=40):
        filter tcp.flags == SYN
        map src = ip.src, port = tcp.dport
        distinct
        reduce by src: ports = count()
        filter ports >= threshold

Parameters other than the window are numbers; the text gives their defaults, and a key may override them.  The
other side of a join is indented below it:

        join left on dst with:
            filter tcp.flags == FIN
            map dst = ip.src
            reduce by dst: fins = count()

`gate dst = ip.dst: count() >= 10 where udp.sport == 53`, as the first line, has a host's packets looked at only from
its tenth DNS answer of the window on.  `len` and `entropy` measure `dns.name` and `payload` of packets: `filter len(dns.name) >= 50`.
`join` is `inner`, `left`, `outer` or `anti`.  Aggregates are `count()`, `sum(…)`, `max(…)`.
Every error names line and column.
"""

import re
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final, NoReturn, get_args

import msgspec

from apps.sonata_adapter.errors import InvalidRequest, QueryError, QueryTextError
from apps.sonata_adapter.query.catalogue import Template, Values
from apps.sonata_adapter.query.dataflow import compile_query
from apps.sonata_adapter.query.expressions import (
    FLAG_PATTERNS,
    FUNCTIONS,
    OTHER_NAMES,
    PACKET_FIELDS,
    BinaryOperation,
    Contains,
    Expression,
    Field,
    Not,
    Number,
    Operator,
    Term,
    Within,
    canonical_prefix,
    size_of,
)
from apps.sonata_adapter.query.language import (
    MOST_GATE,
    Aggregate,
    Distinct,
    Filter,
    Function,
    Gate,
    Join,
    JoinKind,
    Map,
    Pipeline,
    Query,
    Reduce,
    Step,
    output_kinds,
)
from apps.sonata_adapter.query.parameters import Parameter, number, window

_TOKEN: Final = re.compile(
    r"""(?P<space>\s+|\#.*)
      | (?P<address>[0-9]+\.[0-9]+\.[0-9]+\.[0-9]+(?:/[0-9]+)?
                  | (?:[0-9A-Fa-f]{0,4}:){2,7}[0-9A-Fa-f]{0,4}(?:/[0-9]+)?)
      | (?P<duration>[0-9]+(?:ms|s|m|h)\b)
      | (?P<number>0x[0-9A-Fa-f]+|[0-9]+)
      | (?P<name>[A-Za-z_][A-Za-z0-9_]*(?:\.[A-Za-z_][A-Za-z0-9_]*)*)
      | (?P<text>"(?:[^"\\]|\\.)*")
      | (?P<sign>==|!=|<=|>=|[-+*/%&|<>=(),:])""",
    re.VERBOSE,
)
_LEVELS: Final[tuple[tuple[str, ...], ...]] = (("or",), ("and",), ("==", "!=", "<", "<=", ">", ">=", "in", "contains"), ("|",), ("&",), ("+", "-"), ("*", "/", "%"))  # fmt: skip
_COMPARISON: Final = 2
_JOINS: Final[tuple[JoinKind, ...]] = get_args(JoinKind)
_WINDOW: Final = window(3_000)
_DEEPEST: Final = 50
"""Brackets, signs and `not` within each other."""
MOST_TEXT: Final = 65_536
"""Characters of a text of queries."""
_MOST_LINES: Final = 1_000
_MOST_TOKENS: Final = 256
"""Of a line; an expression as deep as that can be worked on."""
_LARGEST: Final = 256
"""Parts of an expression when each field of a map is written out as what the map makes it of."""
_MOST_JOINS: Final = 4
"""Joins within each other."""
_MOST_NAME: Final = 64
_MOST_PARAMETER: Final = 1_000_000_000
_MOST_NUMBER: Final = (1 << 63) - 1
_LONGEST_NUMBER: Final = 19
"""Digits."""
_ESCAPES: Final = re.compile(r"""(?:[^\\]|\\(?:x[0-9A-Fa-f]{2}|[\\'"abfnrtv]))*""")


class _Token(msgspec.Struct, frozen=True):
    kind: str
    text: str
    column: int


class _Line(msgspec.Struct, frozen=True):
    number: int
    indent: int
    tokens: tuple[_Token, ...]


def parse_queries(text: str, where: str = "query") -> list[Template]:
    """Read the queries of a text.

    Args:
        text: at most 65,536 characters and 1,000 lines.
        where: name of the file, for errors.

    Returns:
        A template for each query, in order.

    Raises:
        QueryTextError: the text is wrong; `line` and `column` count from 1.
    """
    if len(text) > MOST_TEXT:
        raise QueryTextError(
            where, 1, 1, f"{len(text):,} characters; a text of queries has {MOST_TEXT:,} at most"
        )
    if len(text.splitlines()) > _MOST_LINES:
        raise QueryTextError(where, _MOST_LINES + 1, 1, f"too long; {_MOST_LINES} lines at most")
    lines = [
        line for line in (_line(where, n, raw) for n, raw in enumerate(text.splitlines(), 1)) if line.tokens
    ]
    templates: list[Template] = []
    at = 0
    while at < len(lines):
        end = at + 1
        while end < len(lines) and lines[end].indent > lines[at].indent:
            end += 1
        template = _query(where, lines[at], lines[at + 1 : end])
        if any(template.name == other.name for other in templates):
            raise QueryTextError(where, lines[at].number, 1, f"query {template.name} is defined twice")
        templates.append(template)
        at = end
    if not templates:
        raise QueryTextError(where, 1, 1, "no query in it; begin with 'query NAME(window=3s):'")
    return templates


def _line(where: str, number_: int, raw: str) -> _Line:
    tokens = []
    at = 0
    while at < len(raw):
        found = _TOKEN.match(raw, at)
        if found is None:
            raise QueryTextError(where, number_, at + 1, f"{raw[at]!r} is not allowed here")
        if found.lastgroup != "space":
            tokens.append(_Token(str(found.lastgroup), found[0], at + 1))
        at = found.end()
        if len(tokens) > _MOST_TOKENS:
            raise QueryTextError(where, number_, at, f"too long; {_MOST_TOKENS} tokens per line at most")
    return _Line(number_, len(raw) - len(raw.lstrip()), tuple(tokens))


class _Reader:
    """Tokens of one line, one after the other."""

    def __init__(self, where: str, line: _Line, parameters: Mapping[str, int]) -> None:
        self._where = where
        self._line = line
        self._parameters = parameters
        self._at = 0
        self._depth = 0

    def fail(self, what: str) -> NoReturn:
        tokens = self._line.tokens
        last = tokens[-1]
        column = tokens[self._at].column if self._at < len(tokens) else last.column + len(last.text)
        raise QueryTextError(self._where, self._line.number, column, what)

    @property
    def token(self) -> _Token:
        tokens = self._line.tokens
        return tokens[self._at] if self._at < len(tokens) else _Token("end", "the end of the line", 0)

    def next(self) -> _Token:
        token = self.token
        self._at += 1
        return token

    def accept(self, *texts: str) -> str:
        """The next token's text if it is one of these; else empty."""
        if self.token.kind != "text" and self.token.text in texts:
            return self.next().text
        return ""

    def expect(self, text: str) -> None:
        if not self.accept(text):
            self.fail(f"expected {text!r}, found {self.token.text}")

    def name(self, what: str) -> str:
        if self.token.kind != "name":
            self.fail(f"expected {what}, found {self.token.text}")
        return self.next().text

    def end(self) -> None:
        if self.token.kind != "end":
            self.fail(f"expected the end of the line, found {self.token.text}")

    def names(self, what: str) -> tuple[str, ...]:
        found = [self.name(what)]
        while self.accept(","):
            found.append(self.name(what))
        return tuple(sorted(set(found)))

    def expression(self, level: int = 0) -> Expression:
        if level == len(_LEVELS):
            return self._atom()
        if level == _COMPARISON and self.token.text == "not" and self.token.kind != "text":
            return self._deeper(self._negation)
        left = self.expression(level + 1)
        while operator := self.accept(*_LEVELS[level]):
            left = self._combined(left, operator, level)
        return left

    def _combined(self, left: Expression, operator: str, level: int) -> Expression:
        token = self.token
        if operator == "contains":
            return self._contains(left)
        if token.kind == "address" or operator == "in":
            return self._within(left, operator)
        if token.text in FLAG_PATTERNS and operator in ("==", "!="):
            self.next()
            held = (Term(left) == FLAG_PATTERNS[token.text]).node
            return held if operator == "==" else Not(held)
        known: Operator = operator  # type: ignore[assignment]
        return BinaryOperation(known, left, self.expression(level + 1))

    def _contains(self, left: Expression) -> Expression:
        if left != Field("payload"):
            self.fail('only payload can contain a text, as in: payload contains "zorro"')
        if self.token.kind != "text":
            self.fail(f"expected a text in double quotes, found {self.token.text}")
        inner = self.token.text[1:-1]
        if not _ESCAPES.fullmatch(inner):
            self.fail('a backslash stands before x and two hexadecimal digits, \\, ", n, r or t')
        self.next()
        try:
            return Contains(inner.encode("latin-1").decode("unicode_escape").encode("latin-1"))
        except UnicodeError:
            self._at -= 1
            self.fail("a text holds characters up to \\xff; write other bytes as \\x00")

    def _within(self, left: Expression, operator: str) -> Expression:
        if not isinstance(left, Field) or operator not in ("==", "!=", "in"):
            self.fail("an address is compared with a field, by ==, != or in")
        if self.token.kind != "address":
            self.fail(f"expected an address or prefix, found {self.token.text}")
        try:
            held = Within(left, canonical_prefix(self.token.text))
        except QueryError as error:
            self.fail(str(error))
        self.next()
        return Not(held) if operator == "!=" else held

    def _negation(self) -> Expression:
        self.expect("not")
        return Not(self.expression(_COMPARISON))

    def _atom(self) -> Expression:
        return self._deeper(self._plain_atom)

    def _deeper(self, read: Callable[[], Expression]) -> Expression:
        self._depth += 1
        if self._depth > _DEEPEST:
            self.fail("brackets are nested too deeply")
        try:
            return read()
        finally:
            self._depth -= 1

    def number(self, low: int = 0, high: int = _MOST_NUMBER) -> int:
        """The whole number that comes next, within these bounds."""
        text = self.token.text
        if self.token.kind != "number":
            self.fail(f"expected a whole number, found {text}")
        digits, base = (text[2:], 16) if text.startswith("0x") else (text, 10)
        if base == 10 and len(digits) > 1 and digits[0] == "0":
            self.fail(f"{text[:20]} begins with 0; write {digits.lstrip('0')[:20] or '0'}")
        if len(digits) > _LONGEST_NUMBER or not low <= int(digits, base) <= high:
            self.fail(f"{text[:20]} is out of bounds; give a whole number from {low} to {high}")
        self.next()
        return int(digits, base)

    def _call(self, function: str) -> Expression:
        """The field that holds a function of a packet's text."""
        made = f"{function}({self.token.text})"
        if made not in PACKET_FIELDS:
            known = ", ".join(name for name in PACKET_FIELDS if name.startswith(f"{function}("))
            self.fail(f"{function} is of a packet's text: {known}")
        self.next()
        self.expect(")")
        return Field(made)

    def _plain_atom(self) -> Expression:
        if self.accept("("):
            inner = self.expression()
            self.expect(")")
            return inner
        if self.accept("-"):
            return BinaryOperation("-", Number(0), self._atom())
        token = self.token
        if token.kind == "number":
            return Number(self.number())
        if token.kind == "name" and token.text not in ("and", "or", "not", "in", "contains"):
            self.next()
            if token.text in FUNCTIONS and self.accept("("):
                return self._call(token.text)
            known = self._parameters.get(token.text)
            return _field(token.text) if known is None else Number(known)
        return self.fail(f"expected a field or a number, found {token.text}")


def _field(name: str) -> Field:
    return Field(OTHER_NAMES.get(name, name))


def _query(where: str, head: _Line, body: list[_Line]) -> Template:
    reader = _Reader(where, head, {})
    if not reader.accept("query"):
        reader.fail("a query begins with 'query NAME(window=3s):'")
    name = reader.name("the name of the query")
    if "." in name:
        raise QueryTextError(where, head.number, head.tokens[1].column, "the name of a query may have no dot")
    if len(name) > _MOST_NAME:
        what = f"the name of a query has {_MOST_NAME} letters at most"
        raise QueryTextError(where, head.number, head.tokens[1].column, what)
    parameters = _parameters(reader)
    reader.expect(":")
    reader.end()
    if not body:
        raise QueryTextError(where, head.number, 1, f"query {name} has no steps")
    query = _build(where, name, tuple(body), {each.name: each.default for each in parameters})
    if query.gated is not None:
        try:
            compile_query(query)
        except QueryError as error:
            raise QueryTextError(where, body[0].number, body[0].tokens[0].column, str(error)) from None
    fields = ", ".join(query.fields)
    return Template(
        name=name,
        meaning=f"defined in {where}",
        result=fields,
        parameters=parameters,
        build=partial(_build, where, name, tuple(body)),
    )


def _build(where: str, name: str, body: tuple[_Line, ...], values: Values) -> Query:
    numbers = {key: int(value) for key, value in values.items() if key != "window"}
    lines = list(body)
    gate = _gate(where, name, lines.pop(0), numbers) if lines[0].tokens[0].text == "gate" else None
    if not lines:
        raise QueryTextError(where, body[0].number, 1, f"query {name} has no steps behind its gate")
    return Query(name, int(values["window"]), _block(where, lines, numbers), gate)


def _gate(where: str, name: str, line: _Line, parameters: Mapping[str, int]) -> Gate:
    """`gate dst = ip.dst: count() >= 10 where udp.sport == 53`."""
    reader = _Reader(where, line, parameters)
    reader.expect("gate")
    field_name = reader.name("the name of a field")
    key = reader.expression() if reader.accept("=") else Field(field_name)
    for sign in (":", "count", "(", ")", ">="):
        reader.expect(sign)
    known = parameters.get(reader.token.text)
    at_least = reader.number(1, MOST_GATE) if known is None else known
    if known is not None:
        reader.next()
    reader.expect("where")
    condition = reader.expression()
    reader.end()
    try:
        made = Query(name).gate(Term(condition), at_least, **{field_name: Term(key)}).gated
    except QueryError as error:
        raise QueryTextError(where, line.number, line.tokens[0].column, str(error)) from None
    assert made is not None  # noqa: S101 - it was just made
    return made


def _parameters(reader: _Reader) -> tuple[Parameter, ...]:
    found: dict[str, Parameter] = {"window": _WINDOW}
    if reader.accept("("):
        while not reader.accept(")"):
            name = reader.name("the name of a parameter")
            if "." in name or len(name) > _MOST_NAME:
                reader.fail(f"the name of a parameter may have no dot, and {_MOST_NAME} letters at most")
            reader.expect("=")
            if name in found and name != "window":
                reader.fail(f"parameter {name} is given twice")
            found[name] = _parameter(reader, name)
            if reader.token.text != ")":
                reader.expect(",")
    return tuple(found.values())


def _parameter(reader: _Reader, name: str) -> Parameter:
    text = reader.token.text
    if name != "window":
        if reader.token.kind != "number":
            reader.fail(f"parameter {name} is a whole number from 1, not {text}")
        return number(name, reader.number(1, _MOST_PARAMETER), "a number of the query")
    try:
        default = _WINDOW.parse(text)
    except InvalidRequest as error:
        reader.fail(str(error))
    reader.next()
    return window(int(default))


def _block(where: str, lines: list[_Line], parameters: Mapping[str, int], joins: int = 0) -> Pipeline:
    steps: list[Step] = []
    sizes: Mapping[str, int] = {}
    indent = lines[0].indent
    at = 0
    while at < len(lines):
        line = lines[at]
        end = at + 1
        while end < len(lines) and lines[end].indent > indent:
            end += 1
        if line.indent != indent:
            raise QueryTextError(where, line.number, line.indent + 1, "not aligned with the steps before")
        reader = _Reader(where, line, parameters)
        steps.append(_step(where, reader, lines[at + 1 : end], parameters, joins))
        sizes = _sizes(reader, steps[-1], sizes)
        try:
            output_kinds(steps)
        except QueryError as error:
            raise QueryTextError(where, line.number, line.tokens[0].column, str(error)) from None
        at = end
    return tuple(steps)


def _sizes(reader: _Reader, step: Step, sizes: Mapping[str, int]) -> Mapping[str, int]:
    """How many parts the fields have after a step, written out; those that are not named have one."""
    if isinstance(step, Map):
        found = {name: size_of(value, sizes) for name, value in step.fields}
    else:
        written = (
            step.condition if isinstance(step, Filter) else step.value if isinstance(step, Reduce) else None
        )
        found = {"": 0 if written is None else size_of(written, sizes)}
    if max(found.values(), default=0) > _LARGEST:
        reader.fail(f"too large when written out; {_LARGEST} parts at most, so take fewer steps")
    return found if isinstance(step, Map) else sizes


def _step(
    where: str, reader: _Reader, beneath: list[_Line], parameters: Mapping[str, int], joins: int
) -> Step:
    word = reader.accept("filter", "map", "distinct", "reduce", "join")
    if not word:
        reader.fail(f"expected filter, map, distinct, reduce or join, found {reader.token.text}")
    if word == "join":
        if joins >= _MOST_JOINS:
            reader.fail(f"joins are nested too deeply; {_MOST_JOINS} within each other at most")
        return _join(where, reader, beneath, parameters, joins)
    if beneath:
        raise QueryTextError(
            where, beneath[0].number, beneath[0].indent + 1, f"there is nothing beneath {word}"
        )
    step = _simple_step(reader, word)
    reader.end()
    return step


def _simple_step(reader: _Reader, word: str) -> Step:
    if word == "filter":
        return Filter(reader.expression())
    if word == "distinct":
        return Distinct()
    return _map(reader) if word == "map" else _reduce(reader)


def _map(reader: _Reader) -> Map:
    fields: dict[str, Expression] = {}
    while True:
        name = reader.name("the name of a field")
        fields[name] = reader.expression() if reader.accept("=") else Field(name)
        if not reader.accept(","):
            return Map(tuple(sorted(fields.items())))


def _reduce(reader: _Reader) -> Reduce:
    reader.expect("by")
    keys = reader.names("a key")
    reader.expect(":")
    name = reader.name("the name of the new field")
    reader.expect("=")
    made = _aggregate(reader)
    return Reduce(keys, name, made.function, made.value)


def _aggregate(reader: _Reader) -> Aggregate:
    word = reader.accept("count", "sum", "max")
    if not word:
        reader.fail(f"expected count(), sum(…) or max(…), found {reader.token.text}")
    reader.expect("(")
    value: Expression = Number(1) if word == "count" else reader.expression()
    reader.expect(")")
    function: Function = "max" if word == "max" else "sum"
    return Aggregate(function, value)


def _join(
    where: str, reader: _Reader, beneath: list[_Line], parameters: Mapping[str, int], joins: int
) -> Join:
    chosen = next((kind for kind in _JOINS if reader.accept(kind)), "inner")
    kind: JoinKind = chosen  # type: ignore[assignment]
    reader.expect("on")
    keys = reader.names("a field to join on")
    reader.expect("with")
    reader.expect(":")
    reader.end()
    if not beneath:
        reader.fail("the other side of a join is written beneath it, indented further")
    return Join(_block(where, beneath, parameters, joins + 1), keys, kind)
