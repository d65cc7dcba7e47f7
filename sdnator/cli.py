"""The `sdnator` command: options and exit codes here, the work elsewhere, imported on demand.

Exit codes: 0 done, 1 a part of the pipeline failed, 2 bad input or misuse, 130 interrupted,
143 terminated.
"""

import os
import signal
import sys
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from sdnator import __version__
from sdnator.blocks_commands import allow, blocks
from sdnator.coordinator_commands import apps, flow, keys
from sdnator.dataset_commands import dataset
from sdnator.detect_command import detect_command
from sdnator.doctor import doctor
from sdnator.due_commands import get, observe
from sdnator.errors import SdnatorError
from sdnator.queries_commands import queries
from sdnator.switch_commands import counters, tables
from sdnator.syn_flood_command import syn_flood_command
from sdnator.up_command import down, status, up

app = typer.Typer(
    name="sdnator",
    help="A network security pipeline: P4 switches, Kitsune, Sonata queries and a firewall.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.add_typer(dataset, name="dataset")
app.add_typer(blocks, name="blocks")
app.add_typer(allow, name="allow")
app.add_typer(queries, name="queries")
demos = typer.Typer()
app.add_typer(demos, name="demo")
demos.command("syn-flood")(syn_flood_command)
app.command("detect")(detect_command)
for command in (up, status, down, observe, get, apps, keys, flow, tables, counters, doctor):
    app.command(command.__name__)(command)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"sdnator {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    *,
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    pass


@app.command()
def replay(
    capture: Annotated[Path, typer.Argument(help="pcap or pcapng, plain or gzipped.")],
    *,
    labels: Annotated[
        Path | None, typer.Option(help="Labels: index,label,attacker; or lines of 0/1.")
    ] = None,
    switch: Annotated[
        str, typer.Option(help="embedded, bmv2 (where simple_switch_grpc is installed), or HOST:PORT.")
    ] = "embedded",
    inject: Annotated[
        str | None,
        typer.Option(help="Interface to send frames into, for --switch HOST:PORT.", metavar="IFACE"),
    ] = None,
    no_mitigate: Annotated[bool, typer.Option("--no-mitigate", help="Decide, but block nothing.")] = False,
    train: Annotated[
        int, typer.Option(help="Packets to train on: one in eleven for the feature map.", min=11)
    ] = 55_000,
    fm_grace: Annotated[int | None, typer.Option(help="Packets for the feature map.", min=1)] = None,
    ad_grace: Annotated[int | None, typer.Option(help="Packets for the autoencoders.", min=1)] = None,
    pace: Annotated[str, typer.Option(help="max, or a multiple of real time: 1x, 10x.")] = "max",
    window: Annotated[int, typer.Option(help="Packets in flight, at most.", min=1, max=65_536)] = 128,
    report: Annotated[Path | None, typer.Option(help="Folder for the report.", metavar="DIR")] = None,
    keep: Annotated[
        Path | None, typer.Option(help="Folder to keep logs and archive in.", metavar="DIR")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Replay a capture through switch, controller, Kitsune and firewall.

    With labels or a report there are two passes: Kitsune alone, then with blocking.

    Example: sdnator replay mirai.pcap --labels mirai.labels.csv --report report
    """
    from sdnator.replay_command import ReplayRequest, run_replay

    run_replay(
        ReplayRequest(
            capture=capture,
            labels=labels,
            switch=switch,
            inject=inject,
            mitigate=not no_mitigate,
            train=train,
            fm_grace=fm_grace,
            ad_grace=ad_grace,
            pace=pace,
            window=window,
            report=report,
            keep=keep,
            as_json=as_json,
        )
    )


@demos.callback(invoke_without_command=True)
def demo(
    context: typer.Context,
    *,
    folder: Annotated[Path, typer.Option(help="Where capture and report go.")] = Path("demo"),
    seed: Annotated[int, typer.Option(help="Of the generated capture.")] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Make a capture of an infected home network, replay it, and see the attack blocked."""
    if context.invoked_subcommand is not None:
        return
    from sdnator.replay_command import run_demo

    run_demo(folder, seed, as_json=as_json)


class _Interrupted(BaseException):
    """Ctrl-C. Not KeyboardInterrupt: the command line library would end the program without a word."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.exit_code = 128 + number


def _interrupt(number: int, _: object) -> NoReturn:
    signal.signal(number, signal.SIG_DFL)  # a second one does not wait for a clean end
    raise _Interrupted(number)


def main() -> None:
    """Entry point: errors become one line and an exit code, Ctrl-C becomes 130."""
    signal.signal(signal.SIGINT, _interrupt)
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        app()
    except SdnatorError as error:
        print(f"sdnator: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except _Interrupted as interrupted:
        print("sdnator: interrupted; nothing was left running", file=sys.stderr)
        sys.exit(interrupted.exit_code)
    except BrokenPipeError:
        # The reader of our output went away; Python must not complain at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


if __name__ == "__main__":
    main()
