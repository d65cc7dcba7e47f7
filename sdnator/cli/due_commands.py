"""`sdnator observe` and `sdnator get`: live items, and archived items."""

import json
import math
import queue
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from sdnator.cli.item_rates import SECONDS, Rates, headline
from sdnator.cli.live_items import live_items
from sdnator.cli.plan_question import is_asked_of_adapter
from sdnator.errors import BadInput, PipelineError
from sdnator.northbound import latest, open_existing
from sdnator.notation import brief, duration_ns, instant_ns, local_time, typed_key
from sdnator.plurals import counted
from sdnator.up import running

if TYPE_CHECKING:
    from due import Item

_LOOK_SECONDS = 0.1
_TEXT_WIDTH = 200
_PLOTTED = SECONDS

KeyArgument = Annotated[
    str, typer.Argument(help="A key; * matches one segment, ** at the end any number.", metavar="KEY")
]
Updates = Annotated[
    str,
    typer.Option(
        help="Data Updates; default: those of the running pipeline.", metavar="URL", envvar="DUE_UPDATES"
    ),
]
Archive = Annotated[
    str,
    typer.Option(
        help="Data Archives; default: those of the running or last pipeline.",
        metavar="URL",
        envvar="DUE_ARCHIVE",
    ),
]


def observe(
    key: KeyArgument,
    *,
    duration: Annotated[
        str, typer.Option("--for", help="How long: 30s, 5m, 1h; default: until Ctrl-C.")
    ] = "",
    count: Annotated[int, typer.Option(help="Stop after this many items; 0: never.", min=0)] = 0,
    updates: Updates = "",
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object per item and line.")] = False,
    plot: Annotated[
        bool, typer.Option("--plot", help="Show rates with a sparkline, every second, instead of items.")
    ] = False,
) -> None:
    """Show items as they arrive.  While it runs, producers make the data on demand.

    Items that arrive faster than they can be shown are skipped, and counted on standard error.  With
    --plot and --json it prints one JSON object per second with the rates.

    Example: sdnator observe 'network.anomaly.kitsune.*' --for 30s --json
    """
    wanted = typed_key(key)
    seconds = duration_ns(duration, "--for") / 1e9 if duration else math.inf
    url = updates or running.need().updates
    question = _Question(wanted)
    with _stopping() as stopped, live_items([wanted, *question.keys], url) as (waiting, lost):
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
            if question.is_answered_by(item):
                continue
            rates.add(item.value)
            shown.item(item, last=waiting.empty())
        shown.end()
        missed, mean = lost(), rates.mean(time.monotonic())
    more = f", {missed:,} missed: they arrived faster than they could be shown" if missed else ""
    hint = "" if rates.items else "; `sdnator keys` shows what is produced"
    rows = f", {rates.records:,} records" if rates.records != rates.items else ""
    print(f"sdnator: {counted(rates.items, 'item')}{rows}, {mean:,.1f} a second{more}{hint}", file=sys.stderr)


class _Question:
    """Asks the Sonata adapter beside the observation whether it serves the key."""

    def __init__(self, key: str) -> None:
        from due import Key

        self.keys: list[str] = []
        if is_asked_of_adapter(key) and Key.parse(key).concrete:
            from apps.sonata_adapter.plan_answer import plan_key

            self.keys = [plan_key(key)]

    def is_answered_by(self, item: "Item") -> bool:
        """Whether the item is the answer; raises BadInput with what would do if the key is refused."""
        if item.key not in self.keys:
            return False
        if item.value.get("state") == "refused":
            raise BadInput(f"refused: {item.value['reason']}")
        return True


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
def _stopping() -> Iterator[Callable[[], bool]]:
    """Ctrl-C and SIGTERM end the command normally."""
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
    since: Annotated[
        str, typer.Option(help="Start: 1h or 7d ago, or a local time such as 2024-05-01T12:00.")
    ] = "",
    until: Annotated[str, typer.Option(help="End, like --since.")] = "",
    limit: Annotated[int, typer.Option(help="Maximum number of items to show, the newest.", min=1)] = 1_000,
    archive: Archive = "",
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object per item and line.")] = False,
) -> None:
    """Show archived items, oldest first; works without a running pipeline.

    Example: sdnator get 'network.block.firewall.*' --since 1h
    """
    from due.errors import DueError, InvalidOption, InvalidQuery

    wanted = {"dataKey": typed_key(key)}
    now = time.time_ns()
    start = instant_ns(since, now, "--since") if since else 0
    end = instant_ns(until, now, "--until") if until else now + 1
    try:
        with closing(open_existing(running.archive_url(archive))) as driver:
            items, more = latest(driver.find, wanted, start, end, limit)
    except (InvalidOption, InvalidQuery) as error:
        raise BadInput(str(error)) from None
    except DueError as error:
        raise PipelineError(str(error)) from None
    for item in items:
        print(_json_line(item) if as_json else text_line(item))
    if more:
        print(f"sdnator: there are older items; raise --limit {limit} to see them", file=sys.stderr)
    elif not items:
        print(f"sdnator: no items under {wanted['dataKey']} in that time", file=sys.stderr)


def _json_line(item: "Item") -> str:
    from coordinator.views import item as as_json

    return json.dumps(as_json(item), ensure_ascii=False)


def text_line(item: "Item") -> str:
    """Time, key and value on one line; of a long value only its size."""
    when = local_time(item.event_time, fraction=True)
    value = brief(item.value)
    shown = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return f"{when}  {item.key}  {shown if len(shown) <= _TEXT_WIDTH else shown[:_TEXT_WIDTH] + '…'}"
