"""`sdnator dataset …`: public data sets by name, and generated captures.  The work is in `sdnator.datasets`."""

import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, DownloadColumn, TaskID, TextColumn, TimeRemainingColumn

from sdnator.cli.late_progress import LateProgress
from sdnator.errors import BadInput
from sdnator.plurals import counted

if TYPE_CHECKING:
    from sdnator.datasets.catalogue import PublicDataSet

dataset = typer.Typer(
    help="Captures to replay: public data sets by name, or generated.", no_args_is_help=True
)
make = typer.Typer(help="Generate a capture with labels.", no_args_is_help=True)
dataset.add_typer(make, name="make")
console = Console(stderr=True)

_GAP_UNITS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000, "min": 60_000_000_000}

Out = Annotated[
    Path, typer.Argument(metavar="OUT.pcap", help="Capture to write; gzipped when it ends in .gz.")
]


def _names(begun: str) -> list[str]:
    """For the shell's completion."""
    from sdnator.datasets.catalogue import CATALOGUE

    return [name for name in CATALOGUE if name.startswith(begun)]


NameArgument = Annotated[
    str,
    typer.Argument(metavar="NAME", help="Name, as shown by `sdnator dataset list`.", autocompletion=_names),
]
JsonOption = Annotated[bool, typer.Option("--json", help="JSON on standard output.")]


@make.command("mirai-like")
def make_mirai_like(
    out: Out,
    *,
    seed: Annotated[int, typer.Option(help="The same seed gives the same bytes.", min=0)] = 1,
    benign_seconds: Annotated[
        float, typer.Option(help="Seconds of benign traffic before the infection.", min=0)
    ] = 3_000,
    attack_seconds: Annotated[
        float, typer.Option(help="Seconds from the infection to the end; 0: no attack.", min=0)
    ] = 720,
    background: Annotated[
        bool, typer.Option(help="Include benign traffic; without it the attack alone, for `splice`.")
    ] = True,
    floods: Annotated[
        str, typer.Option(help="Floods in this order, from udp, syn, ack; or none.")
    ] = "udp,syn,ack",
    scan: Annotated[bool, typer.Option(help="Include ARP sweeps and telnet scans.")] = True,
    answer_all: Annotated[
        bool,
        typer.Option(
            "--answer-all", help="The victim answers every SYN with a SYN-ACK, every ACK with a RST."
        ),
    ] = False,
    max_packets: Annotated[
        int, typer.Option(help="Maximum number of packets in the capture.", min=1, max=250_000)
    ] = 250_000,
) -> None:
    """Generate a home network with an infected camera, like Kitsune's Mirai capture.

    Example: sdnator dataset make mirai-like mirai.pcap --seed 7
    """
    from sdnator.datasets.attack import FLOODS, AttackPlan
    from sdnator.datasets.mirai_like import MiraiLikeOptions
    from sdnator.datasets.mirai_like import make as make_capture

    chosen = () if floods == "none" else tuple(floods.split(","))
    if unknown := set(chosen) - set(FLOODS):
        raise BadInput(
            f"--floods {floods}: {', '.join(sorted(unknown))} is not known; choose from {', '.join(FLOODS)}"
        )
    options = MiraiLikeOptions(
        seed=seed,
        benign_seconds=benign_seconds,
        attack_seconds=attack_seconds,
        background=background,
        plan=AttackPlan(floods=chosen, scan=scan, answer_all=answer_all),
        max_packets=max_packets,
    )
    with _writing(out), _packets("generating") as progress:
        made = make_capture(options, out, progress)
    first = "" if made.first_attack is None else f", the first at number {made.first_attack}"
    typer.echo(
        f"{made.capture}: {counted(made.packets, 'packet')}, {made.seconds:,.0f} s; "
        f"{made.attack_packets:,} of the attack{first}"
    )
    typer.echo(f"{made.labels}: labels")


@dataset.command("splice")
def splice(
    benign: Annotated[Path, typer.Argument(metavar="BENIGN", help="First part.")],
    attack: Annotated[Path, typer.Argument(metavar="ATTACK", help="Second part.")],
    out: Out,
    *,
    gap: Annotated[str, typer.Option(help="Time between the parts: 1s, 500ms, 2min.")] = "1s",
) -> None:
    """Append one capture to another: times are shifted, labels written.

    Labels beside the parts (X.labels.csv) are used; without them all packets of BENIGN are benign and all
    packets of ATTACK belong to an attack.

    Example: sdnator dataset splice monday.pcap attack.pcap both.pcap --gap 2s
    """
    from sdnator.datasets.splice import splice as splice_captures

    with _writing(out), _packets("splicing") as progress:
        made = splice_captures(benign, attack, out, gap_ns=gap_ns(gap), progress=progress)
    for cut in made.cuts:
        console.print(f"note: {cut}", highlight=False)
    total = made.benign_packets + made.attack_packets
    typer.echo(
        f"{made.capture}: {counted(total, 'packet')}, the second part begins at number {made.benign_packets}"
    )
    typer.echo(f"{made.labels}: labels")


@dataset.command("rebuild")
def rebuild(
    table: Annotated[Path, typer.Argument(metavar="MIRAI.tsv[.gz]", help="tshark's 19 columns.")],
    out: Out,
) -> None:
    """Rebuild frames from a tshark table: they have the values of all of its columns.

    Example: sdnator dataset rebuild mirai.tsv.gz mirai.pcap
    """
    from sdnator.datasets.rebuild import rebuild as rebuild_capture

    with _writing(out), _packets("rebuilding") as progress:
        made = rebuild_capture(table, out, progress)
    unit = "ns" if made.nanoseconds else "µs"
    typer.echo(f"{out}: {counted(made.packets, 'packet')}, times in {unit}")


@dataset.command("list")
def list_sets(*, as_json: JsonOption = False) -> None:
    """List public data sets that can be fetched and replayed by name.

    Example: sdnator dataset list
    """
    from sdnator.cli.plain_table import plain_table
    from sdnator.datasets.catalogue import CATALOGUE

    if as_json:
        typer.echo(json.dumps([_about(each) for each in CATALOGUE.values()]))
        return
    rows = [
        (
            each.name,
            f"{each.packets:,}" if each.packets else "-",
            "yes" if _is_here(each.name) else "-",
            each.title,
        )
        for each in CATALOGUE.values()
    ]
    typer.echo(plain_table(("name", "packets", "fetched", "what"), rows))


@dataset.command("show")
def show_set(name: NameArgument, *, as_json: JsonOption = False) -> None:
    """Show a data set: licence, sources, size, citation, and what of that is verified.

    Example: sdnator dataset show mirai
    """
    from sdnator.datasets.catalogue import public_data_set

    about = _about(public_data_set(name))
    if as_json:
        typer.echo(json.dumps(about))
        return
    for label, value in about.items():
        lines = value if isinstance(value, list) else [value]
        for number, line in enumerate(lines):
            if line not in (None, ""):
                typer.echo(f"{label.replace('_', ' ') if number == 0 else '':<10}  {_shown(line)}")


@dataset.command("fetch")
def fetch(
    name: NameArgument,
    *,
    mirror: Annotated[
        str,
        typer.Option(help="Server to use instead of the publisher's, with the same paths.", metavar="URL"),
    ] = "",
    given: Annotated[
        list[Path] | None,
        typer.Option("--from", help="Local file to use: zip, gz, bz2, pcap or CSV.", metavar="FILE"),
    ] = None,
    into: Annotated[
        Path | None,
        typer.Option(help="Folder for the files; default: in the data folder.", metavar="DIR"),
    ] = None,
    whole: Annotated[
        bool, typer.Option("--whole", help="Extract it from the publication's single archive (large).")
    ] = False,
    repin: Annotated[
        bool, typer.Option("--repin", help="Accept checksums that differ from those of the first fetch.")
    ] = False,
) -> None:
    """Fetch a public data set; an interrupted download is resumed.

    The publishers give no checksums: the first fetch pins them, and later ones must match.

    Example: sdnator dataset fetch mirai
    """
    from sdnator.datasets import local_sets
    from sdnator.datasets.catalogue import public_data_set
    from sdnator.datasets.named_fetch import DataSetFetch, FetchRequest

    wanted = public_data_set(name)
    if mirror and not re.match("https?://", mirror):
        raise BadInput(f"--mirror {mirror}: not an http or https address; give the server's URL")
    place = (into or local_sets.folder() / name).resolve()
    if not wanted.verified and not given and not mirror:
        console.print("note: addresses as published, not verified", highlight=False)
    request = FetchRequest(into=place, mirror=mirror, given=given or (), whole=whole, repin=repin)
    with _writing(place), _kept_when_stopped(), _steps() as steps:
        found = DataSetFetch(wanted, request, typer.echo, steps).run()
    typer.echo(f"capture  {found.capture}")
    if found.labels is not None:
        typer.echo(f"labels   {found.labels}")
    typer.echo(f"licence  {wanted.publication.licence}")
    typer.echo(f"cite     {wanted.publication.citation}")
    typer.echo(f"next: sdnator replay {name}")


@dataset.command("label")
def label(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="pcap, pcapng or tshark table.")],
    flows: Annotated[list[Path], typer.Argument(metavar="FLOWS...", help="Labelled flows of this capture.")],
    *,
    out: Annotated[
        Path | None, typer.Option(help="Labels to write; default: CAPTURE.labels.csv.", metavar="LABELS.csv")
    ] = None,
    clock_offset: Annotated[
        float, typer.Option(help="Hours by which the flows' clock is ahead of UTC.", min=-14, max=14)
    ] = 0.0,
) -> None:
    """Label the packets of a capture from labelled flows: conn.log.labeled, binetflow or CICFlowMeter.

    Example: sdnator dataset label friday.pcap friday.csv --clock-offset=-3
    """
    from sdnator.capture.labels import labels_path, write_labels
    from sdnator.datasets.flow_labels import labels_of_flows
    from sdnator.datasets.flow_tables import read_flow_table

    target = out or labels_path(capture)
    tables = (read_flow_table(path, clock_offset_hours=clock_offset) for path in flows)
    made = labels_of_flows(capture, (flow for table in tables for flow in table))
    with _writing(target):
        write_labels(target, made.labels)
    typer.echo(
        f"{target}: {int(made.labels.attack.sum()):,} of {len(made.labels):,} packets belong to an attack; "
        f"{made.flows_found:,} of {made.flows:,} attacking flows are in the capture"
    )


def _about(wanted: "PublicDataSet") -> dict[str, Any]:
    """Facts about a data set, in the order in which they are shown."""
    published, training = wanted.publication, wanted.training
    return {
        "name": wanted.name,
        "title": wanted.title,
        "of": published.title,
        "homepage": published.homepage,
        "licence": published.licence,
        "citation": published.citation,
        "packets": wanted.packets,
        "size": wanted.size,
        "training": f"first {training.fm_grace + training.ad_grace:,} packets" if training else "",
        "labels": _LABEL_FORMS[wanted.label_form],
        "note": wanted.note,
        "verified": "yes" if wanted.verified else "addresses, sizes and counts as published, not verified",
        "fetched": _is_here(wanted.name),
        "sources": [*wanted.capture.urls, *wanted.labels.urls],
        "archive": f"{published.archive} ({published.archive_size})" if published.archive else "",
    }


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:,}" if isinstance(value, int) else str(value)


_LABEL_FORMS = {
    "packets": "one per packet",
    "zeek": "one per connection, in Zeek's conn.log",
    "binetflow": "one per flow, in Argus's binetflow",
    "cicflowmeter": "one per flow, in CICFlowMeter's CSV",
}


def _is_here(name: str) -> bool:
    from sdnator.datasets import local_sets

    try:
        return local_sets.find(name) is not None
    except BadInput:  # fetched, but its files were deleted
        return False


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
            f"{out}: cannot be written ({error.strerror or error}); choose an existing folder that you can write to"
        ) from None


@contextmanager
def _packets(what: str) -> Iterator[Callable[[int], None]]:
    columns = (TextColumn(what), BarColumn(), TextColumn("{task.completed:,} packets"))
    with LateProgress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done: bar.update(task, completed=done)


@contextmanager
def _kept_when_stopped() -> Iterator[None]:
    """Ctrl-C in a long download: whoever presses it should know that nothing has to come twice."""
    try:
        yield
    except BaseException as stopped:
        if not isinstance(stopped, Exception):
            console.print(
                "what has been downloaded is kept; run the command again to continue", highlight=False
            )
        raise


@contextmanager
def _steps() -> Iterator[Callable[[str, int, int | None], None]]:
    """One progress bar per file, by its name."""
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with LateProgress(*columns, console=console, transient=True, disable=not console.is_terminal) as bars:
        tasks: dict[str, TaskID] = {}

        def update(what: str, done: int, total: int | None) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(escape(what), total=total)
            bars.update(tasks[what], completed=done, total=total)

        yield update
