"""The `sdnator` command: options and exit codes here, the work elsewhere, imported on demand.

Exit codes: 0 done, 1 a part of the pipeline failed, 2 bad input or misuse, 130 interrupted,
143 terminated.
"""

import os
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, ClassVar, NoReturn

import typer

from sdnator import __version__
from sdnator.errors import SdnatorError
from sdnator.late_commands import LateGroup, register

COMMANDS = {
    "allow": ("sdnator.blocks_commands:allow", "Addresses, prefixes and MACs that are never blocked."),
    "apps": (
        "sdnator.coordinator_commands:apps",
        "Apps and their instances: state, process, items written and received.",
    ),
    "backup": (
        "sdnator.backup_commands:backup",
        "Write archive, configuration and trained models into one file.",
    ),
    "blocks": ("sdnator.blocks_commands:blocks", "Blocks and guards: list, add, remove, explain, lift all."),
    "config": (
        "sdnator.config_commands:config",
        "The configuration: check it, show what holds, print an example.",
    ),
    "counters": (
        "sdnator.switch_commands:counters",
        "What the entries of a switch have counted: blocked packets above all.",
    ),
    "dataset": ("sdnator.dataset_commands:dataset", "Captures to replay: generate, splice, rebuild, fetch."),
    "demo": (
        "sdnator.demo_commands:demos",
        "Make a capture of an infected home network, replay it, and see the attack blocked.",
    ),
    "detect": (
        "sdnator.detect_command:detect_command",
        "Score every packet of a capture or an interface with Kitsune, without switch or blocking.",
    ),
    "doctor": (
        "sdnator.doctor:doctor",
        "Look at what is installed, reachable and allowed here, and say what to do about the rest.",
    ),
    "down": ("sdnator.status_command:down", "Stop the pipeline of `sdnator up` and wait until it has ended."),
    "flow": ("sdnator.coordinator_commands:flow", "Draw who gets what from whom."),
    "get": ("sdnator.due_commands:get", "Show items of the past, oldest first; no pipeline needs to run."),
    "keys": (
        "sdnator.coordinator_commands:keys",
        "All keys: who can make them, who wants them, and how they travel.",
    ),
    "logs": ("sdnator.logs_command:logs", "Show what the parts of the pipeline have logged."),
    "observe": ("sdnator.due_commands:observe", "Show items as they come."),
    "queries": (
        "sdnator.queries_commands:queries",
        "Telemetry queries: list, explain, add your own, run over the past.",
    ),
    "restore": ("sdnator.backup_commands:restore", "Put back what `sdnator backup` has written."),
    "shell": (
        "sdnator.shell_command:shell",
        "Look into a running switch with p4runtime-shell; its controller stays in charge.",
    ),
    "status": (
        "sdnator.status_command:status",
        "What runs: parts, addresses, and what the Coordinator says of the apps.",
    ),
    "switch": (
        "sdnator.switch_run_command:switch",
        "Run one embedded switch until Ctrl-C; a controller gives it its program.",
    ),
    "tables": (
        "sdnator.switch_commands:tables",
        "Tables of a switch: size, entries, default actions; with --table every entry with its counter.",
    ),
    "up": ("sdnator.up_command:up", "Run the whole pipeline until Ctrl-C, SIGTERM or `sdnator down`."),
}
"""Name to place and first line of help."""


class _Commands(LateGroup):
    PLACES: ClassVar[Mapping[str, str]] = {name: place for name, (place, _) in COMMANDS.items()}


app = typer.Typer(
    name="sdnator",
    cls=_Commands,
    help="A network security pipeline: P4 switches, Kitsune, Sonata queries and a firewall.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for _name, (_, _text) in COMMANDS.items():
    register(app, _name, _text)


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
    telemetry: Annotated[
        str, typer.Option(help="How headers come from the switch: packet-in or digest.")
    ] = "packet-in",
    report: Annotated[Path | None, typer.Option(help="Folder for the report.", metavar="DIR")] = None,
    keep: Annotated[
        Path | None, typer.Option(help="Folder to keep logs and archive in.", metavar="DIR")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Replay a capture through switch, controller, Kitsune and firewall.

    With labels or a report there are two passes: Kitsune alone, then with blocking.
    Exit codes: 0 replayed, 1 a part of the pipeline failed, 2 bad input or misuse.

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
            telemetry=telemetry,
            report=report,
            keep=keep,
            as_json=as_json,
        )
    )


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
