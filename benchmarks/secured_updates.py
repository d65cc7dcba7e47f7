"""What rights cost: DUE over a server where everybody may do everything, and over one with a user for each app."""

import secrets
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from benchmarks.measure import interleaved, table
from benchmarks.pairs import KEY, run_due
from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.redis_rights import Rights
from sdnator.rights.identities import ADMIN, Identities, made

SIZES = (100, 1000, 10_000)
COUNTS = {100: 300_000, 1000: 150_000, 10_000: 30_000}
_OTHERS = 12
"""Keys that each app is granted beside the measured one, as a real app has several."""


def secured_figures(rounds: int, scale: float) -> dict[str, object]:
    """Messages a second without and with rights, in turns, and the ratios."""
    figures: dict[str, dict[str, float]] = {"open": {}, "secured": {}}
    with (
        tempfile.TemporaryDirectory() as folder,
        EmbeddedServer(Path(folder) / "open") as free,
        _guarded(Path(folder)) as (server, identities),
    ):
        producer, consumer = (identities.url(server.url, name) for name in ("producer", "consumer"))
        for size in SIZES:
            count = max(1000, int(COUNTS[size] * scale))
            peers = {
                "open": partial(run_due, free.url, size, count),
                "secured": partial(run_due, producer, size, count, consumer),
            }
            for name, rate in interleaved(peers, rounds).items():
                figures[name][str(size)] = rate
    ratio = {size: figures["secured"][size] / figures["open"][size] for size in figures["open"]}
    rows = [[size, figures["open"][size], figures["secured"][size], ratio[size]] for size in ratio]
    table(["bytes", "without rights", "with rights", "ratio"], rows)
    return {
        "open_msgs_per_s": figures["open"],
        "secured_msgs_per_s": figures["secured"],
        "secured_vs_open": ratio,
    }


@contextmanager
def _guarded(folder: Path) -> Iterator[tuple[EmbeddedServer, Identities]]:
    """A server with a user for the producer and one for the consumer."""
    others = tuple(f"bench.family{number}.app.*" for number in range(_OTHERS))
    identities = made(
        folder,
        {
            "producer": Rights(app="producer", publish=(*others, KEY), observe=others),
            "consumer": Rights(app="consumer", publish=others, observe=(*others, KEY)),
        },
    )
    password = secrets.token_urlsafe(24)
    with EmbeddedServer(
        folder / "secured",
        users=partial(identities.users_file, password),
        admin=(identities.prefix + ADMIN, password),
    ) as server:
        yield server, identities
