"""`sdnator blocks …` and `sdnator allow …`: what the firewall decided, why, and how people overrule it.

Reading needs Data Archives only.  Instructions go to the running firewall through Data Updates; `panic`
without it writes into Data Archives that everything is lifted, which controllers and firewall take up when
they start.
"""

import json
import threading
import time
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Annotated, Any, Final, Literal
from uuid import uuid4

import typer

from apps.firewall.history import DECISIONS, INSTRUCTIONS, allowed_by, decisions_in, in_force
from apps.messages import Answer, Decision, Instruction
from due import CONSUMER, PRODUCER, Capability, DueError, Engine, Item
from due.backends import default_archive, open_archive
from due.config import Options
from sdnator.errors import BadInput, PipelineError

blocks = typer.Typer(help="Blocks and guards: list, add, remove, explain, lift all.", no_args_is_help=True)
allow = typer.Typer(help="Addresses, prefixes and MACs that are never blocked.", no_args_is_help=True)

_INSTRUCTION: Final = "network.instruction.operator.firewall"
_ANSWER: Final = "network.answer.firewall.operator"
_ANSWER_SECONDS: Final = 10.0
_LIFTS: Final = {"block": "unblock", "protect": "unprotect"}

UpdatesOption = Annotated[str, typer.Option("--updates", help="Data Updates URL; default: $DUE_UPDATES.")]
ArchiveOption = Annotated[str, typer.Option("--archive", help="Data Archives URL; default: $DUE_ARCHIVE.")]
ReasonOption = Annotated[str, typer.Option(help="Why; it is kept with the decision.")]
JsonOption = Annotated[bool, typer.Option("--json", help="JSON on standard output.")]


@blocks.command("list")
def list_blocks(
    *,
    archive: ArchiveOption = "",
    every: Annotated[bool, typer.Option("--all", help="Lifted ones, too.")] = False,
    nft: Annotated[
        bool, typer.Option("--nft", help="As sets for `nft -f`, for hosts without a switch.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Decisions in force, from Data Archives.

    Example: sdnator blocks list
    """
    decisions = decisions_in(item for key in DECISIONS for item in _find(archive, key))
    shown = decisions if every else in_force(decisions)
    if nft:
        typer.echo(nft_sets(shown))
    elif as_json:
        typer.echo(json.dumps([decision.to_value() for decision in shown]))
    elif not shown:
        typer.echo("nothing is blocked or guarded")
    else:
        for decision in shown:
            typer.echo(_line(decision))


@blocks.command("why")
def why(
    decision: Annotated[str, typer.Argument(metavar="ID", help="As `blocks list` shows it.")],
    *,
    archive: ArchiveOption = "",
) -> None:
    """A decision's life: reasons, evidence, and what the switches said.

    Example: sdnator blocks why 1f0c2a9be771
    """
    found = [each for key in DECISIONS for each in _find(archive, {"dataKey": key, "value.id": decision})]
    if not found:
        raise BadInput(f"no decision has the id {decision}; see `sdnator blocks list --all`")
    for made in (Decision.from_value(item.value) for item in found):
        typer.echo(_line(made))
        for evidence in made.evidence:
            typer.echo(f"    {_time(evidence.timestamp)} {evidence.key}: {evidence.summary}")
    query = {"dataKey": "network.confirmation.p4runtime_ctrl.*", "value.id": decision}
    for item in _find(archive, query):
        said = item.value
        typer.echo(
            f"  {_time(item.timestamp)} switch {said['switch']}: {said['state']} {said['handle']} {said['cause']}"
        )


@blocks.command("add")
def add_block(
    address: Annotated[str, typer.Argument(metavar="ADDRESS|MAC")],
    *,
    reason: ReasonOption = "",
    seconds: Annotated[int, typer.Option(help="Length of the block.", min=1)] = 600,
    updates: UpdatesOption = "",
    archive: ArchiveOption = "",
) -> None:
    """Block an address or a MAC on all switches; the allow-list wins.

    Example: sdnator blocks add 192.0.2.66 --reason "ticket 4711" --seconds 3600
    """
    _instruct("block", address, reason, updates, archive, seconds=seconds)


@blocks.command("remove")
def remove_block(
    subject: Annotated[str, typer.Argument(metavar="ID|ADDRESS")],
    *,
    reason: ReasonOption = "",
    updates: UpdatesOption = "",
    archive: ArchiveOption = "",
) -> None:
    """Lift a block by its id, or all of an address.

    Example: sdnator blocks remove 192.0.2.66
    """
    _instruct("unblock", subject, reason, updates, archive)


@blocks.command("panic")
def panic(*, updates: UpdatesOption = "", archive: ArchiveOption = "") -> None:
    """Lift everything at once, except the guards that the settings name.

    Example: sdnator blocks panic
    """
    try:
        _instruct("panic", "", "panic", updates, archive)
    except (DueError, PipelineError) as error:
        typer.echo(f"the firewall does not answer ({error})", err=True)
        count = lift_in_archive(archive)
        typer.echo(f"{count} decisions are lifted in Data Archives; restart the controllers to carry it out")


@allow.command("add")
def allow_add(
    entry: Annotated[str, typer.Argument(metavar="ADDRESS|PREFIX|MAC")],
    *,
    reason: ReasonOption = "",
    updates: UpdatesOption = "",
    archive: ArchiveOption = "",
) -> None:
    """Never block this; blocks that touch it are lifted.

    Example: sdnator allow add 10.0.0.0/24
    """
    _instruct("allow", entry, reason, updates, archive)


@allow.command("remove")
def allow_remove(
    entry: Annotated[str, typer.Argument(metavar="ADDRESS|PREFIX|MAC")],
    *,
    reason: ReasonOption = "",
    updates: UpdatesOption = "",
    archive: ArchiveOption = "",
) -> None:
    """Take an entry off the allow-list.

    Example: sdnator allow remove 10.0.0.0/24
    """
    _instruct("disallow", entry, reason, updates, archive)


@allow.command("list")
def allow_list(*, archive: ArchiveOption = "") -> None:
    """What people have allowed; entries of the firewall's settings file are not in here.

    Example: sdnator allow list
    """
    instructions = [Instruction.from_value(item.value) for item in _find(archive, INSTRUCTIONS)]
    typer.echo("\n".join(allowed_by(instructions)) or "nothing was allowed by hand")


def nft_sets(decisions: Iterable[Decision]) -> str:
    """Blocked addresses as an nftables table of their own, which replaces itself."""
    found = [each.target for each in decisions if each.action == "block"]
    families = {
        "blocked4": (
            "ipv4_addr",
            [each.address for each in found if each.kind == "ip" and ":" not in each.address],
        ),
        "blocked6": (
            "ipv6_addr",
            [each.address for each in found if each.kind == "ip" and ":" in each.address],
        ),
        "blocked_mac": ("ether_addr", [each.address for each in found if each.kind == "mac"]),
    }
    lines = ["table inet sdnator", "delete table inet sdnator", "table inet sdnator {"]
    for name, (kind, addresses) in families.items():
        elements = f" elements = {{ {', '.join(sorted(set(addresses)))} }};" if addresses else ""
        lines.append(f"  set {name} {{ type {kind};{elements} }}")
    lines += ["  chain input {", "    type filter hook input priority -10;"]
    lines += [
        "    ip saddr @blocked4 drop",
        "    ip6 saddr @blocked6 drop",
        "    ether saddr @blocked_mac drop",
    ]
    return "\n".join([*lines, "  }", "}"])


def lift_in_archive(archive: str) -> int:
    """Write for every decision in force that it is lifted; how many.  Raises `BadInput`."""
    standing = in_force(decisions_in(item for key in DECISIONS for item in _find(archive, key)))
    now, instance = time.time_ns(), uuid4().hex[:16]
    items = []
    for number, decision in enumerate(standing, start=1):
        value = decision.to_value() | {
            "action": _LIFTS[decision.action],
            "reason": "panic",
            "event_time": now,
        }
        family = "ipv6" if ":" in decision.target.address else "ipv4"
        kind = "mac" if decision.target.kind == "mac" else family
        key = f"network.{decision.action}.firewall.{kind}"
        items.append(Item(key, value, now + number, now, "firewall", instance, number))
    if items:
        open_archive(_archive_url(archive)).insert(items)
    return len(items)


def _archive_url(given: str) -> str:
    return given or default_archive(Options())


def _find(archive: str, query: str | dict[str, Any]) -> list[Item]:
    url = _archive_url(archive)
    try:
        driver = open_archive(url)
        try:
            return driver.find({"dataKey": query} if isinstance(query, str) else query)
        finally:
            driver.close()
    except DueError as error:
        raise BadInput(f"{url}: {error}") from error


Verb = Literal["block", "unblock", "allow", "disallow", "panic"]


def _instruct(
    verb: Verb, subject: str, reason: str, updates: str, archive: str, *, seconds: int = 600
) -> None:
    """Tell the firewall and wait for its answer; raises `BadInput` where it refuses."""
    instruction = Instruction(id=uuid4().hex[:12], verb=verb, subject=subject, reason=reason, seconds=seconds)
    engine = Engine(Options(connect_timeout=2.0))
    if updates:
        engine.set_pubsub(updates)
    engine.set_db(_archive_url(archive))
    answers: list[Answer] = []
    answered = threading.Event()

    def on_answer(item: Item) -> None:
        answer = Answer.from_value(item.value)
        if answer.id == instruction.id:
            answers.append(answer)
            answered.set()

    told = Capability(_INSTRUCTION, delivery="reliable", archive="always")
    engine.init("operator", PRODUCER | CONSUMER, capabilities=[told], instances="shared")
    try:
        engine.observe(_ANSWER).subscribe(on_answer)
        engine.write(_INSTRUCTION, instruction.to_value())
        engine.flush()
        if not answered.wait(_ANSWER_SECONDS):
            raise PipelineError(f"the firewall did not answer within {_ANSWER_SECONDS:.0f} s; is it running?")
    finally:
        engine.close()
    if not answers[0].done:
        raise BadInput(answers[0].text)
    typer.echo(answers[0].text)


def _line(decision: Decision) -> str:
    until = f"until {_time(decision.expires)}" if decision.expires else "without end"
    target = decision.target
    where = f"{target.address} port {target.port}" if target.port is not None else target.address
    return f"{decision.id} {decision.action} {where} on {decision.switch} {until}: {decision.reason}"


def _time(time_ns: int) -> str:
    return f"{datetime.fromtimestamp(time_ns / 1e9, UTC):%Y-%m-%d %H:%M:%S}Z"
