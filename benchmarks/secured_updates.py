"""What rights and TLS cost: DUE over servers of one kind without and with them, in turns.

Best-effort and reliable messages, and the latency of single ones.  Best-effort rates are of what arrived:
Debian's redis-server 7.0 cuts a subscriber off that falls behind over TLS (docs/security.md).

embedded server, Unix socket:  everybody may do everything │ a user for each app      ─► secured_vs_open
redis-server, loopback TCP:    users, in clear             │ users, TLS, certificates ─► tls_vs_tcp
"""

import secrets
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple

from benchmarks.latency import MESSAGES, Latencies, one_way, percentile
from benchmarks.measure import interleaved, table
from benchmarks.pairs import KEY, MeasuredRun, due_delivery
from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.redis_rights import Rights
from sdnator.rights.identities import ADMIN, Identities, made
from sdnator.testing.tls_redis import RedisMissing, TlsRedis

SIZES = (100, 1000, 10_000)
COUNTS = {100: 300_000, 1000: 150_000, 10_000: 30_000}
_LATENCY_SIZE = 1000
_OTHERS = 12
"""Keys that each app is granted beside the measured one, as a real app has several."""


class _Way(NamedTuple):
    """How a producer and a consumer reach their server."""

    producers_url: str
    consumers_url: str


def secured_figures(rounds: int, scale: float) -> dict[str, object]:
    """Messages a second and latency without and with rights, in clear and with TLS, and the ratios."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        ways, without_tls = _ways(stack, Path(folder))
        rates, lost = _rates(ways, rounds, scale)
        reliable, _ = _rates(ways, rounds, scale, reliable=True)
        latency = _latencies(ways, rounds, scale)
    for kind, found, gone in (("best effort", rates, lost), ("reliable", reliable, {})):
        rows = [
            [name, size, rate, gone.get(name, {}).get(size, 0.0)]
            for name, by_size in found.items()
            for size, rate in by_size.items()
        ]
        table([f"way, {kind}", "bytes", "messages/s", "share lost"], rows)
    table(["way", "p50, µs", "p99, µs"], [[name, *found.values()] for name, found in latency.items()])
    print(without_tls, end="")
    return {
        **{f"{name}_msgs_per_s": by_size for name, by_size in rates.items()},
        "best_effort_lost_share": lost,
        "secured_vs_open": _ratio(rates, "secured", "open"),
        "tls_vs_tcp": _ratio(rates, "tls", "tcp"),
        **{f"{name}_reliable_msgs_per_s": by_size for name, by_size in reliable.items()},
        "secured_vs_open_reliable": _ratio(reliable, "secured", "open"),
        "tls_vs_tcp_reliable": _ratio(reliable, "tls", "tcp"),
        "latency_us": latency,
    }


def _ways(stack: ExitStack, folder: Path) -> tuple[dict[str, _Way], str]:
    """What is compared, by name, and why there is no TLS, if there is none."""
    free = stack.enter_context(EmbeddedServer(folder / "open"))
    server, identities = stack.enter_context(_guarded(folder / "secured"))
    found = {"open": _Way(free.url, free.url), "secured": _of(identities, server.url)}
    try:
        encrypted, identities = stack.enter_context(_encrypted(folder / "tls"))
    except RedisMissing as reason:
        return found, f"nothing with TLS: {reason}\n"
    found["tcp"] = _of(identities, encrypted.plain_url)
    found["tls"] = _of(identities, encrypted.url)
    return found, ""


def _rates(
    ways: dict[str, _Way], rounds: int, scale: float, *, reliable: bool = False
) -> tuple[dict[str, dict[str, float]], dict[str, dict[str, float]]]:
    """By way and size: messages a second, the median of the rounds, and the share lost in all of them."""
    rates: dict[str, dict[str, float]] = {name: {} for name in ways}
    lost: dict[str, dict[str, float]] = {name: {} for name in ways}
    for size in SIZES:
        count, found = max(1000, int(COUNTS[size] * scale)), defaultdict[str, list[MeasuredRun]](list)

        def peer(
            name: str,
            size: int = size,
            count: int = count,
            found: defaultdict[str, list[MeasuredRun]] = found,
        ) -> float:
            one = due_delivery(
                ways[name].producers_url, size, count, ways[name].consumers_url, reliable=reliable
            )
            found[name].append(one)
            return one.rate

        for name, rate in interleaved({name: partial(peer, name) for name in ways}, rounds).items():
            rates[name][str(size)] = rate
            lost[name][str(size)] = sum(one.lost for one in found[name]) / (rounds * count)
    return rates, lost


def _latencies(ways: dict[str, _Way], rounds: int, scale: float) -> dict[str, dict[str, float]]:
    times: dict[str, list[Latencies]] = {name: [] for name in ways}
    count = max(200, int(MESSAGES * scale))
    for _ in range(rounds):
        for name, way in ways.items():
            times[name].append(
                one_way(way.producers_url, _LATENCY_SIZE, 1, count, consumers_url=way.consumers_url)
            )
    return {name: {"p50": percentile(of, 0.5), "p99": percentile(of, 0.99)} for name, of in times.items()}


def _ratio(rates: dict[str, dict[str, float]], of: str, to: str) -> dict[str, float] | None:
    return {size: rates[of][size] / rates[to][size] for size in rates[to]} if to in rates else None


def _identities(folder: Path) -> Identities:
    """A user for the producer and one for the consumer."""
    others = tuple(f"bench.family{number}.app.*" for number in range(_OTHERS))
    return made(
        folder,
        {
            "producer": Rights(app="producer", publish=(*others, KEY), observe=others),
            "consumer": Rights(app="consumer", publish=others, observe=(*others, KEY)),
        },
    )


def _of(identities: Identities, url: str) -> _Way:
    return _Way(identities.url(url, "producer"), identities.url(url, "consumer"))


@contextmanager
def _guarded(folder: Path) -> Iterator[tuple[EmbeddedServer, Identities]]:
    identities, password = _identities(folder), secrets.token_urlsafe(24)
    with EmbeddedServer(
        folder / "server",
        users=partial(identities.users_file, password),
        admin=(identities.prefix + ADMIN, password),
    ) as server:
        yield server, identities


@contextmanager
def _encrypted(folder: Path) -> Iterator[tuple[TlsRedis, Identities]]:
    identities, password = _identities(folder), secrets.token_urlsafe(24)
    with TlsRedis(
        folder / "server",
        users=partial(identities.users_file, password),
        admin=(identities.prefix + ADMIN, password),
    ) as server:
        yield server, identities
