"""`sdnator blocks …` and `sdnator allow …`: what the firewall decided, why, and how people overrule it.

Reading needs Data Archives only.  Instructions go to the running firewall through Data Updates; `panic`
without it writes into Data Archives that everything is lifted, and clears the switch itself.
"""

import json
import os
import queue
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Annotated, Final, Literal
from uuid import uuid4

import typer

from apps.firewall.history import INSTRUCTIONS, allowed_by, in_force, instructions_in
from apps.messages import Answer, Instruction
from due import CONSUMER, PRODUCER, Capability, DueError, Engine, Item
from due.config import Options
from sdnator import running
from sdnator.blocks_archive import INSTRUCTION, all_decisions, archive_url, find, lift_in_archive
from sdnator.blocks_direct import lift_in_switch
from sdnator.blocks_nft import nft_sets
from sdnator.blocks_why import as_text, decision_line, life_of
from sdnator.errors import BadInput, PipelineError

blocks = typer.Typer(help="Blocks and guards: list, add, remove, explain, lift all.", no_args_is_help=True)
allow = typer.Typer(help="Addresses, prefixes and MACs that are never blocked.", no_args_is_help=True)

_ANSWER: Final = "network.answer.firewall.operator"
_LOOK_SECONDS: Final = 0.5
_CLOCKS_DIFFER_NS: Final = 60 * 10**9
_ANSWER_SECONDS: Final = 10.0
_PANIC_SECONDS: Final = 3.0

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
    decisions = all_decisions(archive)
    shown = decisions if every else in_force(decisions)
    if nft:
        typer.echo(nft_sets(shown))
    elif as_json:
        typer.echo(json.dumps([decision.to_value() for decision in shown]))
    elif not shown:
        typer.echo("nothing is blocked or guarded")
    else:
        for decision in shown:
            typer.echo(decision_line(decision))


@blocks.command("why")
def why(
    decision: Annotated[str, typer.Argument(metavar="ID", help="As `blocks list` shows it.")],
    *,
    archive: ArchiveOption = "",
    as_json: JsonOption = False,
) -> None:
    """A decision's life: reasons, evidence, earlier offences, what the switches said and stopped.

    Example: sdnator blocks why 1f0c2a9be771
    """
    life = life_of(decision, archive)
    typer.echo(json.dumps(life) if as_json else "\n".join(as_text(life)))


@blocks.command("add")
def add_block(
    address: Annotated[str, typer.Argument(metavar="ADDRESS|PREFIX|MAC|MAC@PORT")],
    *,
    reason: ReasonOption = "",
    seconds: Annotated[int, typer.Option(help="Length of the block.", min=1)] = 600,
    updates: UpdatesOption = "",
    archive: ArchiveOption = "",
) -> None:
    """Block an address, a prefix or a MAC (on one port) on all switches; the allow-list wins.

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
    """Lift a block by its id, or all of an address; guards that a flood led to likewise.

    Example: sdnator blocks remove 192.0.2.66
    """
    _instruct("unblock", subject, reason, updates, archive)


@blocks.command("panic")
def panic(
    *,
    updates: UpdatesOption = "",
    archive: ArchiveOption = "",
    direct: Annotated[
        bool, typer.Option("--direct", help="Do not ask the firewall: archive and switch at once.")
    ] = False,
    switch: Annotated[
        str,
        typer.Option(help="P4Runtime switch to clear; default: the running pipeline's.", metavar="HOST:PORT"),
    ] = "",
    device_id: Annotated[int, typer.Option(help="P4Runtime device id of --switch.", min=1)] = 1,
) -> None:
    """Lift everything at once, except the guards that the settings name.

    Where the firewall does not answer, Data Archives are told, and the switch is cleared over P4Runtime:
    its controller, if there is one, loses its place for a moment and takes it again.

    Example: sdnator blocks panic
    """
    if not direct:
        try:
            _instruct("panic", "", "panic", updates, archive, patience=_PANIC_SECONDS)
        except (DueError, PipelineError) as error:
            typer.echo(f"the firewall does not answer ({error})", err=True)
        else:
            return
    guards = _lift_in_archive(archive)
    place = (switch, device_id) if switch else _running_switch()
    address, number = place
    count = lift_in_switch(address, number, guards)
    typer.echo(f"{count} entries deleted in the switch at {address}")


def _running_switch() -> tuple[str, int]:
    found = running.find()
    if found is None:
        raise PipelineError(
            "no switch is known: give --switch HOST:PORT; controllers carry it out when they are started again"
        )
    return str(found.switch["address"]), int(found.switch["device_id"])


def _lift_in_archive(archive: str) -> list[tuple[str, int]]:
    """The guards that were lifted; an archive that is away keeps nobody from clearing the switch."""
    try:
        lifted = lift_in_archive(archive)
    except BadInput as error:
        typer.echo(f"{error}; guards stay, and a controller may bring blocks back", err=True)
        return []
    typer.echo(f"{len(lifted)} decisions are lifted in Data Archives")
    targets = (each.target for each in lifted if each.action == "protect")
    return [(target.address, target.port or 0) for target in targets]


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
    instructions = instructions_in(find(archive, INSTRUCTIONS))
    typer.echo("\n".join(allowed_by(instructions)) or "nothing was allowed by hand")


Verb = Literal["block", "unblock", "allow", "disallow", "panic"]


def _instruct(
    verb: Verb,
    subject: str,
    reason: str,
    updates: str,
    archive: str,
    *,
    seconds: int = 600,
    patience: float = _ANSWER_SECONDS,
) -> None:
    """Tell the firewall and wait for its answer; raises `BadInput` where it refuses."""
    instruction = Instruction(id=uuid4().hex[:12], verb=verb, subject=subject, reason=reason, seconds=seconds)
    engine = Engine(Options(connect_timeout=2.0))
    found = None if updates or os.environ.get("DUE_UPDATES") else running.find()
    url = updates or (found.updates if found is not None else "")
    if url:
        engine.set_pubsub(url)
    engine.set_db(archive_url(archive))
    answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()

    def on_answer(item: Item) -> None:
        answer = Answer.from_value(item.value)
        if answer.id == instruction.id:
            answers.put(answer)

    told = Capability(INSTRUCTION, delivery="reliable", archive="always")
    engine.init("operator", PRODUCER | CONSUMER, capabilities=[told], instances="shared")
    try:
        engine.observe(_ANSWER).subscribe(on_answer)
        engine.write(INSTRUCTION, instruction.to_value())
        engine.flush(patience)
        answer = _answer(engine, answers, on_answer, patience)
    finally:
        engine.close()
    if not answer.done:
        raise BadInput(answer.text)
    typer.echo(answer.text)


def _answer(
    engine: Engine, answers: "queue.SimpleQueue[Answer]", look: Callable[[Item], None], patience: float
) -> Answer:
    """What comes in `answers`; raises PipelineError after `patience` seconds.

    The firewall may answer before it has heard that somebody wants that: then only the archive has it.
    """
    begun, deadline = time.time_ns() - _CLOCKS_DIFFER_NS, time.monotonic() + patience
    while time.monotonic() < deadline:
        try:
            return answers.get(timeout=_LOOK_SECONDS)
        except queue.Empty:
            with suppress(DueError):
                for item in engine.get({"dataKey": _ANSWER, "timestamp": {"$gte": begun}}):
                    look(item)
    raise PipelineError(f"the firewall did not answer within {patience:.0f} s; is it running?")
