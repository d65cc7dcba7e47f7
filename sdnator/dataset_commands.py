"""`sdnator dataset …`: make, splice, rebuild and fetch captures.  Options here, the work in `datasets`."""

import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

from sdnator.errors import BadInput

dataset = typer.Typer(help="Captures to replay: generate, splice, rebuild, fetch.", no_args_is_help=True)
make = typer.Typer(help="Generate a capture with labels.", no_args_is_help=True)
dataset.add_typer(make, name="make")
console = Console(stderr=True)

URL_VARIABLE = "SDNATOR_MIRAI_URL"
"""Environment variable with the URL(s) of the published set, separated by spaces."""
_GAP_UNITS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000, "min": 60_000_000_000}

Out = Annotated[
    Path, typer.Argument(metavar="OUT.pcap", help="Capture to write; gzipped when it ends in .gz.")
]


@make.command("mirai-like")
def make_mirai_like(
    out: Out,
    *,
    seed: Annotated[int, typer.Option(help="Same seed, same bytes.", min=0)] = 1,
    benign_seconds: Annotated[
        float, typer.Option(help="Harmless traffic before the infection.", min=0)
    ] = 3_000,
    attack_seconds: Annotated[
        float, typer.Option(help="From the infection to the end; 0 = no attack.", min=0)
    ] = 720,
    background: Annotated[
        bool, typer.Option(help="Harmless traffic; without it the attack alone, to be spliced.")
    ] = True,
    floods: Annotated[str, typer.Option(help="Floods in turn, from udp, syn, ack; or none.")] = "udp,syn,ack",
    scan: Annotated[bool, typer.Option(help="ARP sweeps and telnet scanning.")] = True,
    answer_all: Annotated[
        bool,
        typer.Option(
            "--answer-all", help="The victim answers every SYN with a SYN-ACK, every ACK with a RST."
        ),
    ] = False,
    max_packets: Annotated[
        int, typer.Option(help="The capture ends here at the latest.", min=1, max=250_000)
    ] = 250_000,
) -> None:
    """A house full of devices, then an infected camera: like the Kitsune Mirai capture.

    Example: sdnator dataset make mirai-like mirai.pcap --seed 7
    """
    from sdnator.datasets.attack import FLOODS, Plan
    from sdnator.datasets.mirai_like import Options
    from sdnator.datasets.mirai_like import make as make_capture

    chosen = () if floods == "none" else tuple(floods.split(","))
    if unknown := set(chosen) - set(FLOODS):
        raise BadInput(
            f"--floods {floods}: {', '.join(sorted(unknown))} is not known; choose from {', '.join(FLOODS)}"
        )
    options = Options(
        seed=seed,
        benign_seconds=benign_seconds,
        attack_seconds=attack_seconds,
        background=background,
        plan=Plan(floods=chosen, scan=scan, answer_all=answer_all),
        max_packets=max_packets,
    )
    with _writing(out), _packets("generating") as progress:
        made = make_capture(options, out, progress)
    typer.echo(
        f"{made.capture}: {made.packets:,} packets, {made.seconds:,.0f} s; "
        f"{made.attack_packets:,} of the attack, the first is number {made.first_attack}"
    )
    typer.echo(f"{made.labels}: labels")


@dataset.command("splice")
def splice(
    benign: Annotated[Path, typer.Argument(metavar="BENIGN", help="The first part.")],
    attack: Annotated[Path, typer.Argument(metavar="ATTACK", help="The part behind it.")],
    out: Out,
    *,
    gap: Annotated[str, typer.Option(help="Time between the parts: 1s, 500ms, 2min.")] = "1s",
) -> None:
    """Put one capture behind another: times shifted, labels written.

    Labels beside the parts (X.labels.csv) are used; without them all of BENIGN is harmless and all of
    ATTACK is attack.

    Example: sdnator dataset splice monday.pcap attack.pcap both.pcap --gap 2s
    """
    from sdnator.datasets.splice import splice as splice_captures

    with _writing(out), _packets("splicing") as progress:
        made = splice_captures(benign, attack, out, gap_ns=gap_ns(gap), progress=progress)
    for cut in made.cuts:
        console.print(f"note: {cut}", highlight=False)
    total = made.benign_packets + made.attack_packets
    typer.echo(f"{made.capture}: {total:,} packets, the second part begins at number {made.benign_packets}")
    typer.echo(f"{made.labels}: labels")


@dataset.command("rebuild")
def rebuild(
    table: Annotated[Path, typer.Argument(metavar="MIRAI.tsv[.gz]", help="tshark's 19 columns.")],
    out: Out,
) -> None:
    """Frames from tshark's table: every column of the table is found in them again.

    Example: sdnator dataset rebuild mirai.tsv.gz mirai.pcap
    """
    from sdnator.datasets.rebuild import rebuild as rebuild_capture

    with _writing(out), _packets("rebuilding") as progress:
        made = rebuild_capture(table, out, progress)
    unit = "ns" if made.nanoseconds else "µs"
    typer.echo(f"{out}: {made.packets:,} packets, times in {unit}")


@dataset.command("fetch")
def fetch(
    name: Annotated[str, typer.Argument(metavar="NAME", help="mirai")],
    *,
    url: Annotated[list[str] | None, typer.Option(help=f"May be repeated; else from {URL_VARIABLE}.")] = None,
    sha256: Annotated[list[str] | None, typer.Option(help="Checksum of each URL, in the same order.")] = None,
    folder: Annotated[Path, typer.Option(help="Where the files go.")] = Path(),
) -> None:
    """Download a published data set; an interrupted download goes on where it ended.

    Example: sdnator dataset fetch mirai --url https://example.org/mirai.zip --folder data
    """
    from urllib.parse import unquote, urlsplit

    from sdnator.datasets.fetch import fetch as fetch_file

    if name != "mirai":
        raise BadInput(f"dataset {name!r} is not known; the only one is mirai")
    urls = url or os.environ.get(URL_VARIABLE, "").split()
    if not urls:
        raise BadInput(f"no URL to fetch {name} from; give --url URL or set {URL_VARIABLE}")
    sums = sha256 or [""] * len(urls)
    if len(sums) != len(urls):
        raise BadInput(
            f"{len(sums)} checksums for {len(urls)} URLs; give --sha256 once for each --url, or not at all"
        )
    for each, digest in zip(urls, sums, strict=True):
        target = folder / (Path(unquote(urlsplit(each).path)).name or f"{name}.download")
        with _writing(target), _bytes(target.name) as progress:
            made = fetch_file(each, target, sha256=digest, progress=progress)
        checked = "as expected" if digest else "not checked"
        typer.echo(f"{made.path}: {made.bytes:,} bytes, SHA-256 {made.sha256} ({checked})")


def gap_ns(text: str) -> int:
    """Nanoseconds of a time such as 1s, 500ms or 2min; raises BadInput."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(ns|us|ms|s|min)", text)
    if found is None:
        raise BadInput(f"--gap {text}: not a time; give a number and a unit, such as 1s, 500ms or 2min")
    return round(float(found[1]) * _GAP_UNITS[found[2]])


@contextmanager
def _writing(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise BadInput(
            f"{out}: cannot be written ({error.strerror or error}); choose a folder that exists and is yours"
        ) from None


@contextmanager
def _packets(what: str) -> Iterator[Callable[[int], None]]:
    columns = (TextColumn(what), BarColumn(), TextColumn("{task.completed:,} packets"))
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done: bar.update(task, completed=done)


@contextmanager
def _bytes(what: str) -> Iterator[Callable[[int, int | None], None]]:
    columns = (TextColumn(what), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
