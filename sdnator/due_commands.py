"""`sdnator observe` and `sdnator get`: data as it comes, and data of the past."""

import json
import math
import os
import queue
import re
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import unquote, urlsplit

import typer

from sdnator import running
from sdnator.errors import BadInput, PipelineError
from sdnator.item_rates import SECONDS, Rates, headline

if TYPE_CHECKING:
    from due import Item

_UNITS_NS = {
    "ms": 10**6,
    "s": 10**9,
    "min": 60 * 10**9,
    "m": 60 * 10**9,
    "h": 3_600 * 10**9,
    "d": 86_400 * 10**9,
}
_DURATION = re.compile(r"(\d+(?:\.\d+)?)(ms|s|min|m|h|d)")
_WAITING = 10_000
"""Items that may wait for the terminal; more are counted as missed, since a viewer must not hold back producers."""
_LOOK_SECONDS = 0.1
_WINDOWS_NS = (60 * 10**9, 3_600 * 10**9, 86_400 * 10**9)
_TEXT_WIDTH = 200
_PLOTTED = SECONDS

KeyArgument = Annotated[
    str, typer.Argument(help="A key; * is one segment, ** any number at its end.", metavar="KEY")
]
Updates = Annotated[
    str,
    typer.Option(help="Data Updates; default: of the running pipeline.", metavar="URL", envvar="DUE_UPDATES"),
]
Archive = Annotated[
    str,
    typer.Option(
        help="Data Archives; default: of the pipeline, or its last file.", metavar="URL", envvar="DUE_ARCHIVE"
    ),
]


def observe(
    key: KeyArgument,
    *,
    duration: Annotated[
        str, typer.Option("--for", help="How long: 30s, 5m, 1h; default: until Ctrl-C.")
    ] = "",
    count: Annotated[int, typer.Option(help="End after so many items; 0: never.", min=0)] = 0,
    updates: Updates = "",
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a line for each item.")] = False,
    plot: Annotated[
        bool, typer.Option("--plot", help="Rates with a sparkline each second, instead of the items.")
    ] = False,
) -> None:
    """Show items as they come.  Data that is made on demand is made while this runs.

    What comes faster than it can be shown is skipped, counted, and told on standard error.  With --plot
    and --json, one JSON object a second with the rates.

    Example: sdnator observe 'network.anomaly.kitsune.*' --for 30s --json
    """
    wanted = typed_key(key)
    seconds = duration_ns(duration, "--for") / 1e9 if duration else math.inf
    url = updates or running.need().updates
    with _stopping() as stopped, _items(wanted, url) as (waiting, lost):
        begin = time.monotonic()
        rates = Rates(begin)
        shown = _Shown(as_json, plot, rates)
        while not stopped() and (not count or rates.items < count):
            now = time.monotonic()
            if now - begin >= seconds:
                break
            if rates.pass_time(now):
                shown.second()
            try:
                item = waiting.get(timeout=min(begin + seconds - now, _LOOK_SECONDS))
            except queue.Empty:
                continue
            rates.add(item.value)
            shown.item(item, last=waiting.empty())
        shown.end()
        missed, mean = lost(), rates.mean(time.monotonic())
    more = f", {missed:,} missed: they came faster than they could be shown" if missed else ""
    hint = "" if rates.items else "; `sdnator keys` shows what is made"
    rows = f", {rates.records:,} records" if rates.records != rates.items else ""
    print(f"sdnator: {rates.items:,} items{rows}, {mean:,.1f} a second{more}{hint}", file=sys.stderr)


class _Shown:
    """What `observe` prints: items, or a line of rates each second (in place, on a terminal)."""

    def __init__(self, as_json: bool, plot: bool, rates: Rates) -> None:
        self._as_json = as_json
        self._plot = plot
        self._rates = rates
        self._newest = ""
        self._in_place = plot and not as_json and sys.stdout.isatty()

    def item(self, item: "Item", *, last: bool) -> None:
        if not self._plot:
            print(_json_line(item) if self._as_json else text_line(item), flush=last)
        elif not self._as_json:
            self._newest = headline(item.value)

    def second(self) -> None:
        if not self._plot:
            return
        rates = self._rates
        if self._as_json:
            now = {"items": rates.items, "records": rates.records, "records_per_s": rates.last}
            print(json.dumps(now), flush=True)
            return
        text = f"{rates.last:>9,}/s  {rates.line():<{_PLOTTED}}  {self._newest}"
        width = shutil.get_terminal_size().columns
        print(f"\r{text[: width - 1]}\x1b[K" if self._in_place else text, end=self._ending, flush=True)

    @property
    def _ending(self) -> str:
        return "" if self._in_place else "\n"

    def end(self) -> None:
        if self._in_place:
            print()


@contextmanager
def _items(key: str, url: str) -> "Iterator[tuple[queue.Queue[Item], Callable[[], int]]]":
    """A bounded queue of what comes under a key, and how many items found no room in it."""
    import tempfile

    from due import CONSUMER, Engine, Options
    from due.errors import DueError

    waiting: queue.Queue[Item] = queue.Queue(_WAITING)
    lost = [0]

    def put(item: "Item") -> None:
        try:
            waiting.put_nowait(item)
        except queue.Full:
            lost[0] += 1

    with tempfile.TemporaryDirectory(prefix="sdnator-observe-") as folder:
        engine = Engine(
            Options(updates=url, archive=f"sqlite://{folder}/none.db", directory=folder, spool_bytes=0)
        )
        try:
            # a name of its own: instances of one app would share a reliable stream among them
            engine.init(f"observe-{os.getpid()}-{time.time_ns() % 10**6:06d}", CONSUMER)
            engine.observe(key).subscribe(put)
            yield waiting, lambda: lost[0]
        except DueError as error:
            raise PipelineError(str(error)) from None
        finally:
            engine.close()


@contextmanager
def _stopping() -> Iterator[Callable[[], bool]]:
    """Ctrl-C and SIGTERM mean: finish."""
    came: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda got, _: came.append(got)) for number in numbers}
    try:
        yield lambda: bool(came)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def get(
    key: KeyArgument,
    *,
    since: Annotated[str, typer.Option(help="From: 1h, 7d (ago), or a UTC time 2024-05-01T12:00.")] = "",
    until: Annotated[str, typer.Option(help="To, like --since.")] = "",
    limit: Annotated[int, typer.Option(help="At most so many, the youngest.", min=1)] = 1_000,
    archive: Archive = "",
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a line for each item.")] = False,
) -> None:
    """Show items of the past, oldest first; no pipeline needs to run.

    Example: sdnator get 'network.block.firewall.*' --since 1h
    """
    from due.errors import DueError, InvalidOption, InvalidQuery

    wanted = {"dataKey": typed_key(key)}
    now = time.time_ns()
    start = instant_ns(since, now, "--since") if since else 0
    end = instant_ns(until, now, "--until") if until else now + 1
    try:
        items, more = _from_archive(archive or known_archive(), wanted, start, end, limit)
    except (InvalidOption, InvalidQuery) as error:
        raise BadInput(str(error)) from None
    except DueError as error:
        raise PipelineError(str(error)) from None
    for item in items:
        print(_json_line(item) if as_json else text_line(item))
    if more:
        print(f"sdnator: there are older ones; --limit {limit} ends here", file=sys.stderr)
    elif not items:
        print(f"sdnator: nothing under {wanted['dataKey']} in that time", file=sys.stderr)


def known_archive() -> str:
    """Data Archives of the running pipeline, or the file of the last one."""
    found = running.find()
    return found.archive if found is not None else running.default_archive()


def _from_archive(
    url: str, query: Mapping[str, Any], start: int, end: int, limit: int
) -> "tuple[list[Item], bool]":
    from due.backends import open_archive

    # opening would make the file
    if url.startswith("sqlite:") and not Path(unquote(urlsplit(url).path)).exists():
        raise BadInput(
            f"there is no archive at {url} yet: start a pipeline with `sdnator up`, or give --archive"
        )
    driver = open_archive(url)
    try:
        return youngest(driver.find, query, start, end, limit)
    finally:
        driver.close()


def youngest(
    find: "Callable[[Mapping[str, Any]], list[Item]]",
    query: Mapping[str, Any],
    start: int,
    end: int,
    limit: int,
) -> "tuple[list[Item], bool]":
    """The youngest items, oldest first, and whether there are older ones; times in ns, `end` not included.

    Looks at the last minute first and farther back while there is too little: the archive may be large.
    """
    items: list[Item] = []
    for window in (*_WINDOWS_NS, end - start):
        left = max(start, end - window)
        items = find({"$and": [query, {"timestamp": {"$gte": left, "$lt": end}}]})
        if len(items) > limit or left == start:
            break
    return items[-limit:], len(items) > limit


def typed_key(text: str) -> str:
    """A key as people type it, canonical: addresses in specs need not be encoded.  Raises BadInput."""
    from due.errors import InvalidKey
    from due.keys import Key, encode

    path, colon, specs = text.partition(":")
    encoded = []
    for spec in specs.split(",") if colon else ():
        name, equals, value = spec.partition("=")
        values = (
            one if one == "*" or re.search("%[0-9A-F]{2}", one) else encode(one) for one in value.split("|")
        )
        encoded.append(name + equals + "|".join(values))
    try:
        return Key.parse(path + colon + ",".join(encoded)).text
    except InvalidKey as error:
        raise BadInput(str(error)) from None


def duration_ns(text: str, option: str) -> int:
    """`30s`, `10m`, `1.5h`, `7d` as ns; raises BadInput."""
    found = _DURATION.fullmatch(text.strip())
    if found is None:
        raise BadInput(f"{option} {text}: give a time such as 30s, 10m, 1h or 7d")
    return round(float(found[1]) * _UNITS_NS[found[2]])


def instant_ns(text: str, now: int, option: str) -> int:
    """A time ago, or a point in time (UTC unless it says otherwise), as ns since the epoch; raises BadInput."""
    if _DURATION.fullmatch(text.strip()):
        return now - duration_ns(text, option)
    try:
        when = datetime.fromisoformat(text.strip())
    except ValueError:
        raise BadInput(
            f"{option} {text}: give a time ago such as 1h, or one such as 2024-05-01T12:00"
        ) from None
    aware = when if when.tzinfo else when.replace(tzinfo=UTC)
    return int(aware.timestamp()) * 10**9 + aware.microsecond * 1_000


def _json_line(item: "Item") -> str:
    from coordinator.views import item as as_json

    return json.dumps(as_json(item), ensure_ascii=False)


def text_line(item: "Item") -> str:
    """Time, key and value on one line; what is long is told by its size."""
    when = datetime.fromtimestamp(item.event_time / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S.%f")[:-3]
    value = brief(item.value)
    shown = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return f"{when}  {item.key}  {shown if len(shown) <= _TEXT_WIDTH else shown[:_TEXT_WIDTH] + '…'}"


def brief(value: Any) -> Any:
    """A value fit for one line of JSON: batches, arrays and bytes by their size."""
    import numpy as np

    from coordinator.views import value as as_json
    from due import RecordBatch

    if isinstance(value, RecordBatch):
        return f"{len(value)} records of {', '.join(value.columns)}"
    if isinstance(value, np.ndarray):
        return f"{value.size} of {value.dtype}"
    if isinstance(value, bytes | memoryview):
        return f"{len(value)} bytes"
    if isinstance(value, Mapping):
        return {str(name): brief(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [brief(part) for part in value]
    return as_json(value)
