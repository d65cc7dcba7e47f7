"""State of the parts as Prometheus text.  Pure."""

from collections.abc import Iterable, Iterator, Mapping

from sdnator.supervisor.part import PartReport

STATES = ("waiting", "starting", "running", "restarting", "degraded")


def part_metrics(reports: Iterable[PartReport], logs: Mapping[str, tuple[int, int]]) -> str:
    """State, restarts and log size of every part.

    Args:
        reports: of all parts.
        logs: by part: bytes of its logs, and lines that were suppressed.
    """
    return "\n".join(_lines(list(reports), logs)) + "\n"


def _lines(reports: list[PartReport], logs: Mapping[str, tuple[int, int]]) -> Iterator[str]:
    yield from _family("sdnator_part_state", "gauge", "1 for the state that a part is in")
    for one in reports:
        for state in STATES:
            yield f'sdnator_part_state{{part="{one.name}",state="{state}"}} {int(one.state == state)}'
    yield from _family("sdnator_part_restarts_total", "counter", "Restarts of a part in this run")
    for one in reports:
        yield f'sdnator_part_restarts_total{{part="{one.name}"}} {one.restarts}'
    yield from _family("sdnator_part_log_bytes", "gauge", "Bytes of a part's logs")
    for name, (size, _) in logs.items():
        yield f'sdnator_part_log_bytes{{part="{name}"}} {size}'
    yield from _family(
        "sdnator_part_suppressed_lines_total", "counter", "Lines of a part that were suppressed"
    )
    for name, (_, lines) in logs.items():
        yield f'sdnator_part_suppressed_lines_total{{part="{name}"}} {lines}'

    yield from _family(
        "sdnator_part_out_of_range", "gauge", "Accesses beyond the end of an array by a switch's program"
    )
    for one in reports:
        yield f'sdnator_part_out_of_range{{part="{one.name}"}} {one.out_of_range}'


def _family(name: str, kind: str, text: str) -> Iterator[str]:
    yield f"# HELP {name} {text}"
    yield f"# TYPE {name} {kind}"
