"""Queries over captures for Python programs and notebooks, with results as Arrow tables and pandas data frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np

from apps.sonata_adapter.errors import SonataError
from apps.sonata_adapter.keys import QueryRequest, request_of
from apps.sonata_adapter.query.language import Query
from apps.sonata_adapter.query.templates import QueryFolder, own_queries
from apps.sonata_adapter.results import Captured, QueryResult
from due import RecordBatch
from due.errors import DueError
from sdnator.cli.queries_run import PastPackets, captured
from sdnator.errors import BadInput

MOST_RESULTS: Final = 1_000_000
_TIMES: Final = ("window_start", "window_end", "at")


@dataclass(frozen=True, eq=False, kw_only=True)
class QueryResults:
    """The results of `run_query`, in the order in which windows end."""

    query: Query
    """With all parameters bound."""
    results: tuple[QueryResult, ...]
    """Empty for a query that ends with packets or with tuples of packets."""
    packets: tuple[RecordBatch, ...]
    """The columns of such packets or tuples."""
    left_out: int
    """Results beyond the most that were asked for."""
    notes: str
    """What to know about the results, for people; empty: nothing."""

    def __len__(self) -> int:
        return len(self.results) + sum(map(len, self.packets))

    def to_arrow(self) -> Any:
        """The results as a table.

        Addresses, MACs and names are text, numbers int64, times UTC timestamps. Packets have the columns of
        `apps.packets.PACKET_COLUMNS`; their addresses are two halves.

        Returns:
            A `pyarrow.Table`.

        Raises:
            BadInput: pyarrow is not installed; the text says how to install it.
        """
        arrow = _library("pyarrow")
        return _packet_table(arrow, self.packets) if self.packets else self._table(arrow)

    def to_pandas(self) -> Any:
        """The results as a data frame, with the columns of `to_arrow`.

        Returns:
            A `pandas.DataFrame`.

        Raises:
            BadInput: pyarrow or pandas is not installed; the text says how to install them.
        """
        table = self.to_arrow()
        _library("pandas")
        return table.to_pandas()

    def _table(self, arrow: Any) -> Any:
        made = {
            name: arrow.array(
                [result.fields[name] for result in self.results],
                arrow.int64() if kind == "number" else arrow.string(),
            )
            for name, kind in self.query.fields.items()
        }
        values = [result.to_value() for result in self.results]
        moment = arrow.timestamp("ns", "UTC")
        made |= {name: arrow.array([value[name] for value in values], moment) for name in _TIMES}
        made |= {
            name: arrow.array([value[name] for value in values], arrow.bool_())
            for name in ("exact", "partial")
        }
        made["error"] = arrow.array([result.error for result in self.results], arrow.string())
        return arrow.table(made)


def run_query(
    query: "Query | str", capture: str | Path | Sequence[str | Path], *, most: int = MOST_RESULTS
) -> QueryResults:
    """Run a query over captures; results are those of a live run.

    Args:
        query: a query written in Python; or the key of one of the catalogue or your own, such as
            "new_tcp:threshold=20".
        capture: pcap or pcapng, plain or gzipped; several are read one after the other.
        most: results to keep; more are counted in `left_out`.

    Returns:
        The results, with `to_arrow` and `to_pandas`.

    Raises:
        BadInput: the query or a capture cannot be used; the text says why and what to do.
    """
    paths = [Path(capture)] if isinstance(capture, str | Path) else [Path(one) for one in capture]
    if not paths or most < 1:
        raise BadInput(f"run_query: give at least one capture, and most={most} of at least 1")
    results: list[QueryResult] = []
    packets: list[RecordBatch] = []
    kept = found = 0
    try:
        request = _request(query)
        past = PastPackets(request)
        for output in past.run(captured(paths)):
            size = len(output.batch) if isinstance(output, Captured) else 1
            found += size
            room = min(size, most - kept)
            kept += room
            if isinstance(output, Captured):
                packets += [output.batch.take(np.arange(room))] if room else []
            elif room:
                results.append(output)
    except (SonataError, DueError) as error:
        raise BadInput(str(error)) from None
    return QueryResults(
        query=request.query,
        results=tuple(results),
        packets=tuple(packets),
        left_out=found - kept,
        notes=past.notes,
    )


def _request(query: "Query | str") -> QueryRequest:
    if isinstance(query, Query):
        return QueryRequest(query.name, "query", query.name, query.name, query.name, query)
    key = query if "." in query.partition(":")[0] else f"network.traffic_query.sonata.{query}"
    request = request_of(key, QueryFolder(own_queries()).templates())
    if request is None or request.kind == "handshake":
        raise BadInput(
            f"{query}: name one query or raw stream; handshakes and wildcards are followed live only"
        )
    return request


def _packet_table(arrow: Any, batches: Sequence[RecordBatch]) -> Any:
    made = {}
    for name in batches[0]:
        column = np.ascontiguousarray(np.concatenate([batch[name] for batch in batches]))
        if column.dtype.kind == "V":
            kind = arrow.binary(column.dtype.itemsize)
            made[name] = arrow.Array.from_buffers(
                kind, len(column), [None, arrow.py_buffer(column.tobytes())]
            )
        elif name == "time_us":
            made[name] = arrow.array(column.astype("datetime64[us]"), arrow.timestamp("us", "UTC"))
        else:
            made[name] = arrow.array(column)
    return arrow.table(made)


def _library(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise BadInput(f"{name} is not installed: pip install 'sdnator[arrow]'") from None
