"""The `sdnator` command: options and exit codes; the work is in modules imported on demand.

Exit codes: 0 done, 1 a part of the pipeline failed, 2 bad input or misuse, 130 interrupted,
143 terminated.
"""

import os
import shutil
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, ClassVar, NoReturn

import typer

from sdnator import __version__
from sdnator.cli.lazy_group import LazyGroup, register
from sdnator.errors import SdnatorError
from sdnator.redaction import redacted

COMMANDS = {
    "allow": ("sdnator.cli.blocks_commands:allow", "Addresses, prefixes and MACs that are never blocked."),
    "app": ("sdnator.cli.app_commands:app", "Apps that the pipeline does not start: their credentials."),
    "apps": (
        "sdnator.cli.coordinator_commands:apps",
        "List apps and their instances: state, process, items written and received.",
    ),
    "archive": ("sdnator.cli.archive_commands:archive_app", "Data Archives: export to Parquet."),
    "audit": (
        "sdnator.cli.audit_command:audit",
        "Show the audit trail: sign-ins, refusals, changes of users and apps, instructions to firewall and detector.",
    ),
    "backup": (
        "sdnator.cli.backup_commands:backup",
        "Write archive, configuration and trained models into one file.",
    ),
    "blocks": (
        "sdnator.cli.blocks_commands:blocks",
        "Blocks, guards, rate limits: list, add, remove, explain, false alarms, lift all.",
    ),
    "bridge": (
        "sdnator.cli.bridge_command:bridge",
        "Join this site with another one, until Ctrl-C or SIGTERM.",
    ),
    "cert": ("sdnator.cli.cert_commands:app", "Certificates for P4Runtime over TCP."),
    "config": (
        "sdnator.cli.config_commands:config",
        "Configuration: check it, show effective values, print an example.",
    ),
    "counters": (
        "sdnator.cli.switch_commands:counters",
        "Show the counters of a switch's entries, such as the drops of each block.",
    ),
    "dataset": (
        "sdnator.cli.dataset_commands:dataset",
        "Captures to replay: public data sets by name, or generated.",
    ),
    "demo": (
        "sdnator.cli.demo_commands:demos",
        "Generate a capture of an infected home network, replay it, and block the attack.",
    ),
    "detect": (
        "sdnator.cli.detect_command:detect_command",
        "Score every packet of a capture or an interface with Kitsune, without a switch and without blocking.",
    ),
    "doctor": (
        "sdnator.cli.doctor:doctor",
        "Check what is installed, reachable and permitted here, and say how to fix the rest.",
    ),
    "down": (
        "sdnator.cli.status_command:down",
        "Stop the pipeline of `sdnator up` and wait until it has ended.",
    ),
    "explain": (
        "sdnator.cli.explain_command:explain",
        "Explain a key: who wants it, who produces it and at what rate, its plan and cost, its results and their archive.",
    ),
    "flow": ("sdnator.cli.coordinator_commands:flow", "Draw the data flow: producers, keys, consumers."),
    "get": (
        "sdnator.cli.due_commands:get",
        "Show archived items, oldest first; works without a running pipeline.",
    ),
    "incidents": ("sdnator.cli.incidents_commands:incidents", "Incidents: list them, show one."),
    "keys": (
        "sdnator.cli.coordinator_commands:keys",
        "List all keys with producers, consumers and delivery.",
    ),
    "logs": ("sdnator.cli.logs_command:logs", "Show the logs of the pipeline's parts."),
    "model": ("sdnator.cli.model_commands:model", "Kitsune's model: show it, retrain it."),
    "observe": ("sdnator.cli.due_commands:observe", "Show items as they arrive."),
    "plan": (
        "sdnator.cli.plan_command:plan_command",
        "Calculate what a pipeline needs: processes, cores, memory, archive, and what limits it.",
    ),
    "program": (
        "sdnator.cli.program_commands:program",
        "Manage the programs that embedded switches may load.",
    ),
    "queries": (
        "sdnator.cli.queries_commands:queries",
        "Telemetry queries: list, explain, add your own, run over captures or the archive.",
    ),
    "restore": (
        "sdnator.cli.backup_commands:restore",
        "Restore archive, configuration and models from a backup.",
    ),
    "shell": (
        "sdnator.cli.shell_command:shell",
        "Open p4runtime-shell on a running switch; its controller stays primary.",
    ),
    "status": (
        "sdnator.cli.status_command:status",
        "Show what runs: parts, addresses, app states.",
    ),
    "switch": (
        "sdnator.cli.switch_run_command:switch",
        "Run one embedded switch until Ctrl-C; a controller loads its program.",
    ),
    "tables": (
        "sdnator.cli.switch_commands:tables",
        "Show tables of a switch: size, entries, default actions; with --table every entry.",
    ),
    "user": ("sdnator.cli.user_commands:app", "Who may sign in to the dashboard, and as what."),
    "up": ("sdnator.cli.up_command:up", "Run the whole pipeline until Ctrl-C, SIGTERM or `sdnator down`."),
}
"""Name to module and first line of help."""


GROUPS = {
    "Run": ("up", "down", "demo", "detect", "switch", "bridge"),
    "Look": (
        "status", "incidents", "explain", "observe", "get", "queries", "apps", "keys", "flow", "logs",
        "tables", "counters",
    ),
    "Decide": ("blocks", "allow", "model"),
    "Data": ("dataset", "archive", "backup", "restore"),
    "Maintain": ("config", "doctor", "plan", "program", "shell"),
}  # fmt: skip
"""In which order `sdnator --help` shows commands; what stands nowhere is maintenance."""
_MOST_COLUMNS = 100


class _Commands(LazyGroup):
    PLACES: ClassVar[Mapping[str, str]] = {name: place for name, (place, _) in COMMANDS.items()}


app = typer.Typer(
    name="sdnator",
    cls=_Commands,
    help="A network security pipeline: P4 switches, Kitsune, Sonata queries and a firewall.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_GROUP_OF = {name: group for group, names in GROUPS.items() for name in names}
for _name in sorted(COMMANDS, key=lambda name: [*_GROUP_OF, name].index(name)):
    register(app, _name, COMMANDS[_name][1], _GROUP_OF.get(_name, "Maintain"))


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


@app.command(rich_help_panel="Run")
def replay(
    capture: Annotated[
        Path, typer.Argument(help="pcap or pcapng, plain or gzipped; or the name of a fetched data set.")
    ],
    *,
    labels: Annotated[
        Path | None, typer.Option(help="Labels: index,label,attacker; or lines of 0/1.")
    ] = None,
    switch: Annotated[
        str, typer.Option(help="embedded, bmv2 (where simple_switch_grpc is installed), or HOST:PORT.")
    ] = "embedded",
    inject: Annotated[
        str | None,
        typer.Option(
            help="Interface through which frames enter the switch, for --switch HOST:PORT.", metavar="IFACE"
        ),
    ] = None,
    no_mitigate: Annotated[bool, typer.Option("--no-mitigate", help="Decide, but block nothing.")] = False,
    no_queries: Annotated[
        bool,
        typer.Option(
            "--no-queries", help="Kitsune alone: no Sonata adapter, and no defence against SYN floods."
        ),
    ] = False,
    train: Annotated[
        int | None,
        typer.Option(
            help="Packets to train on; the first eleventh of them trains the feature map.",
            min=11,
            show_default="55000, or as published with the data set",
        ),
    ] = None,
    fm_grace: Annotated[int | None, typer.Option(help="Packets that train the feature map.", min=1)] = None,
    ad_grace: Annotated[int | None, typer.Option(help="Packets that train the autoencoders.", min=1)] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            help="Trained model to score with; default: train on the first packets.", metavar="FILE"
        ),
    ] = None,
    pace: Annotated[
        str, typer.Option(help="Speed: max, or a multiple of real time such as 1x or 10x.")
    ] = "max",
    window: Annotated[
        int | None,
        typer.Option(
            help="Maximum number of packets in flight.",
            min=1,
            max=65_536,
            show_default="65536 while nothing can be blocked, otherwise 128",
        ),
    ] = None,
    reaction: Annotated[
        float,
        typer.Option(
            help="Capture time that may pass from the packet that makes a block due to the first that it drops.",
            min=0.001,
            max=60.0,
            metavar="SECONDS",
        ),
    ] = 0.5,
    reproducible: Annotated[
        bool,
        typer.Option(
            "--reproducible",
            help="Drop the same packets in every replay, on any machine and with any --window; slower.",
        ),
    ] = False,
    telemetry: Annotated[
        str | None,
        typer.Option(
            help="How packet headers reach the controller: packet-in or digest.",
            show_default="digest on the embedded switch, otherwise packet-in",
        ),
    ] = None,
    report: Annotated[Path | None, typer.Option(help="Folder for the report.", metavar="DIR")] = None,
    keep: Annotated[
        Path | None, typer.Option(help="Folder to keep logs and archive in.", metavar="DIR")
    ] = None,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="The switch at --switch HOST:PORT has no TLS (for a lab).")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Replay a capture through switch, controller, Kitsune, Sonata adapter and firewall.

    With labels or a report there are two passes: a dry run, then with blocking.
    Without, a dry run of a long capture goes first if that saves time.
    Exit codes: 0 replayed, 1 a part of the pipeline failed, 2 bad input or misuse.

    Example: sdnator replay mirai.pcap --labels mirai.labels.csv --report report
    """
    from sdnator.cli.replay_command import ReplayRequest, run_replay

    run_replay(
        ReplayRequest(
            capture=capture,
            labels=labels,
            switch=switch,
            inject=inject,
            mitigate=not no_mitigate,
            queries=not no_queries,
            train=train,
            fm_grace=fm_grace,
            ad_grace=ad_grace,
            model=model,
            pace=pace,
            window=window,
            reaction=reaction,
            reproducible=reproducible,
            telemetry=telemetry,
            report=report,
            keep=keep,
            as_json=as_json,
            insecure=insecure,
        )
    )


class _Interrupted(BaseException):
    """Ctrl-C. Not KeyboardInterrupt: the command line library would end the program without a message."""

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
    # Typer's help is as wide as the terminal, however wide that is
    os.environ.setdefault("TERMINAL_WIDTH", str(min(_MOST_COLUMNS, shutil.get_terminal_size().columns)))
    try:
        app()
    except SdnatorError as error:
        print(f"sdnator: {redacted(str(error))}", file=sys.stderr)
        sys.exit(error.exit_code)
    except _Interrupted as interrupted:
        print("sdnator: interrupted; all processes are stopped", file=sys.stderr)
        sys.exit(interrupted.exit_code)
    except BrokenPipeError:
        # The reader of our output has closed the pipe; avoid a traceback at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


if __name__ == "__main__":
    main()
