"""SDNator: the command line, the launcher, data sets, replay and reports; and a small interface for notebooks.

>>> import sdnator
>>> query = sdnator.Query("every_packet", window_ms=1000)
>>> query.window_us
1000000

    sdnator.replay_capture   replay a capture through the whole pipeline, with scores as numpy arrays
    sdnator.CaptureReplay    what it returns
    sdnator.Kitsune          the anomaly detector alone, to learn from and score packets
    sdnator.Query            a telemetry query, written in Python
    sdnator.run_query        run a query over captures
    sdnator.QueryResults     what it returns: for Arrow and pandas

`__all__` is the whole public interface; every other name in this package may change.

The names are imported when they are first used, not by `import sdnator`: together they need numpy, scipy, gRPC
and Redis, which takes a second or more. Every command imports this package first, so each
`sdnator --help` and each shell completion would wait for them.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from apps.kitsune.online import Kitsune
    from apps.sonata_adapter.query.language import Query
    from sdnator.query_results import QueryResults, run_query
    from sdnator.replay.replay_capture import CaptureReplay, replay_capture

__version__ = "0.2.0"

__all__ = ["CaptureReplay", "Kitsune", "Query", "QueryResults", "replay_capture", "run_query"]

_MODULES = {
    "CaptureReplay": "sdnator.replay.replay_capture",
    "Kitsune": "apps.kitsune.online",
    "Query": "apps.sonata_adapter.query.language",
    "QueryResults": "sdnator.query_results",
    "replay_capture": "sdnator.replay.replay_capture",
    "run_query": "sdnator.query_results",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'sdnator' has no attribute {name!r}; it offers {', '.join(__all__)}")
    found = getattr(import_module(_MODULES[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
