"""`sdnator blocks …` and `sdnator allow …`: the firewall's decisions, their reasons, and manual changes.

Reading needs Data Archives only.  Instructions go to the running firewall through Data Updates.  Without a
firewall, `panic` lifts all decisions in Data Archives and clears the switch itself.
"""

import json
import time
from collections.abc import Collection
from typing import Annotated, Any, Final, Literal
from uuid import uuid4

import typer

from apps.firewall.evidence.history import (
    ANSWERS,
    INSTRUCTIONS,
    allowed_by,
    carried_out,
    instructions_in,
)
from apps.firewall.policy.instructions import target_in
from apps.firewall.policy.rules import AllowList
from apps.messages import Decision, Instruction
from apps.standing_decisions import in_force
from due import DueError
from sdnator.app_requests import AppRequest, ask
from sdnator.blocks.blocks_archive import INSTRUCTION, all_decisions, find, lift_in_archive
from sdnator.blocks.blocks_direct import lift_in_switch
from sdnator.blocks.blocks_nft import nft_sets
from sdnator.blocks.blocks_places import PlaceAnswer, answers_of
from sdnator.blocks.blocks_why import as_text, decision_line, life_of
from sdnator.blocks.lessons import lesson_lines, lessons_in_force
from sdnator.cli.due_commands import Archive, Updates
from sdnator.cli.plain_table import fitted
from sdnator.cli.switch_place import Insecure, SwitchAddress, place_of
from sdnator.errors import BadInput, PipelineError
from sdnator.plurals import counted
from sdnator.rights.audit_trail import note
from sdnator.up import running

blocks = typer.Typer(
    help="Blocks, guards, rate limits: list, add, remove, explain, false alarms, lift all.",
    no_args_is_help=True,
)
allow = typer.Typer(help="Addresses, prefixes and MACs that are never blocked.", no_args_is_help=True)

_ANSWER: Final = "network.answer.firewall.operator"
_ANSWER_SECONDS: Final = 10.0
_PANIC_SECONDS: Final = 3.0

ReasonOption = Annotated[str, typer.Option(help="Reason; it is stored with the decision.")]
JsonOption = Annotated[bool, typer.Option("--json", help="JSON on standard output.")]


@blocks.command("list")
def list_blocks(
    *,
    archive: Archive = "",
    every: Annotated[bool, typer.Option("--all", help="Include lifted decisions.")] = False,
    nft: Annotated[
        bool, typer.Option("--nft", help="Print sets for `nft -f`, for hosts without a switch.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """List the decisions in force, from Data Archives.

    Example: sdnator blocks list
    """
    decisions = all_decisions(archive)
    shown = decisions if every else in_force(decisions)
    answers = answers_of({decision.id for decision in shown}, archive) if shown and not nft else {}
    if nft:
        typer.echo(nft_sets(shown))
    elif as_json:
        typer.echo(json.dumps([_as_value(decision, answers.get(decision.id, ())) for decision in shown]))
    elif not shown:
        typer.echo("nothing is blocked, guarded or limited")
    else:
        for decision in shown:
            typer.echo(fitted(decision_line(decision, answers.get(decision.id, ()))))


def _as_value(decision: Decision, answers: Collection[PlaceAnswer]) -> dict[str, Any]:
    return decision.to_value() | {"enforcers": [answer.to_value() for answer in answers]}


@blocks.command("why")
def why(
    decision: Annotated[
        str, typer.Argument(metavar="ID", help="ID of a decision, as shown by `blocks list`.")
    ],
    *,
    archive: Archive = "",
    as_json: JsonOption = False,
) -> None:
    """Explain a decision in five lines; then show its history, earlier offences, confirmations, drops.

    Example: sdnator blocks why 1f0c2a9be771
    """
    life = life_of(decision, archive)
    typer.echo(json.dumps(life) if as_json else "\n".join(map(fitted, as_text(life))))


@blocks.command("add")
def add_block(
    address: Annotated[
        str,
        typer.Argument(
            metavar="ADDRESS|PREFIX|MAC|MAC@PORT", help="What to block; @PORT: on that port only."
        ),
    ],
    *,
    reason: ReasonOption = "",
    seconds: Annotated[int, typer.Option(help="Length of the block in seconds.", min=1)] = 600,
    updates: Updates = "",
    archive: Archive = "",
) -> None:
    """Block an address, a prefix or a MAC (on one port) on all switches; the allow-list wins.

    Example: sdnator blocks add 192.0.2.66 --reason "ticket 4711" --seconds 3600
    """
    _instruct("block", address, reason, updates, archive, seconds=seconds)


@blocks.command("remove")
def remove_block(
    subject: Annotated[
        str,
        typer.Argument(metavar="ID|ADDRESS", help="ID of a decision, or what it blocks, guards or limits."),
    ],
    *,
    reason: ReasonOption = "",
    updates: Updates = "",
    archive: Archive = "",
) -> None:
    """Lift blocks, or guards and rate limits set because of a flood, by decision id or address.

    Example: sdnator blocks remove 192.0.2.66
    """
    _instruct("unblock", subject, reason, updates, archive)


@blocks.command("false-alarm")
def false_alarm(
    subject: Annotated[
        str, typer.Argument(metavar="ID", help="ID of a decision, as shown by `blocks list --all`.")
    ],
    *,
    revoke: Annotated[
        bool, typer.Option("--revoke", help="Revoke a false alarm: its evidence counts in full again.")
    ] = False,
    reason: ReasonOption = "",
    updates: Updates = "",
    archive: Archive = "",
) -> None:
    """Undo a block or guard, and let evidence of this kind about this sender count a tenth from now on.

    The lesson is narrow: this sender, this source of evidence, this service. Everything else that the sender does
    counts in full. The lesson holds for `rules.false_alarm_days`.

    Example: sdnator blocks false-alarm 1f0c2a9be771 --reason "the new backup"
    """
    _instruct("revoke" if revoke else "false_alarm", subject, reason, updates, archive)


@blocks.command("false-alarms")
def false_alarms(*, archive: Archive = "", as_json: JsonOption = False) -> None:
    """List the decisions called false alarms, whose evidence still counts less.

    Example: sdnator blocks false-alarms
    """
    lessons = lessons_in_force(archive)
    if as_json:
        typer.echo(json.dumps([each.to_value() for each in lessons]))
    else:
        lines = [line for each in lessons for line in lesson_lines(each)]
        typer.echo("\n".join(lines) or "no decision was called a false alarm")


@blocks.command("panic")
def panic(
    *,
    updates: Updates = "",
    archive: Archive = "",
    direct: Annotated[
        bool, typer.Option("--direct", help="Do not ask the firewall; change archive and switch directly.")
    ] = False,
    switch: Annotated[
        str,
        typer.Option(help="P4Runtime switch to clear; default: the running pipeline's.", metavar="HOST:PORT"),
    ] = "",
    device_id: Annotated[int, typer.Option(help="P4Runtime device id of --switch.", min=1)] = 1,
    insecure: Insecure = False,
) -> None:
    """Lift everything at once, except the guards that the settings name.

    If the firewall does not answer, the decisions are lifted in Data Archives and the switch is cleared
    over P4Runtime. Its controller, if there is one, loses the primary role for a moment.

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
    place = place_of(switch, device_id, insecure=insecure) if switch else _running_switch()
    count = lift_in_switch(place.address, place.device_id, guards, place.security)
    note(f"lifted all decisions and cleared the switch at {place.address}", archive=archive)
    typer.echo(f"{counted(count, 'entry')} deleted in the switch at {place.address}")


def _running_switch() -> SwitchAddress:
    found = running.find()
    if found is None:
        raise PipelineError(
            "no switch is known: give --switch HOST:PORT; controllers remove the entries when they are restarted"
        )
    return place_of("", 1)


def _lift_in_archive(archive: str) -> list[tuple[str, int]]:
    """The decisions that were lifted; the switch is cleared even if the archive is unreachable."""
    try:
        lifted = lift_in_archive(archive)
    except BadInput as error:
        typer.echo(f"{error}; guards stay, and a controller may bring blocks back", err=True)
        return []
    typer.echo(f"{counted(len(lifted), 'decision')} lifted in Data Archives")
    targets = (each.target for each in lifted if each.action == "protect")
    return [(target.address, target.port or 0) for target in targets]


@allow.command("add")
def allow_add(
    entry: Annotated[str, typer.Argument(metavar="ADDRESS|PREFIX|MAC", help="Entry of the allow-list.")],
    *,
    reason: ReasonOption = "",
    updates: Updates = "",
    archive: Archive = "",
) -> None:
    """Never block this entry; blocks that overlap it are lifted.

    Example: sdnator allow add 10.0.0.0/24
    """
    _instruct("allow", entry, reason, updates, archive)


@allow.command("remove")
def allow_remove(
    entry: Annotated[str, typer.Argument(metavar="ADDRESS|PREFIX|MAC", help="Entry of the allow-list.")],
    *,
    reason: ReasonOption = "",
    updates: Updates = "",
    archive: Archive = "",
) -> None:
    """Take an entry off the allow-list.

    Example: sdnator allow remove 10.0.0.0/24
    """
    _instruct("disallow", entry, reason, updates, archive)


@allow.command("list")
def allow_list(*, archive: Archive = "") -> None:
    """List the entries that operators have added; those of the firewall's settings are not listed.

    Example: sdnator allow list
    """
    done = {str(item.value["id"]) for item in find(archive, f"{ANSWERS}.*") if item.value["done"]}
    instructions = carried_out(instructions_in(find(archive, INSTRUCTIONS)), done)
    typer.echo("\n".join(allowed_by(instructions)) or "the allow-list has no entries added by operators")


Verb = Literal["block", "unblock", "allow", "disallow", "panic", "false_alarm", "revoke"]


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
    """Tell the firewall and wait for its answer.

    Raises:
        BadInput: the subject is nothing that can be blocked or allowed, or the firewall refuses.
    PipelineError: no pipeline runs, or its firewall does not answer; the instruction is then withdrawn.
    """
    _check_subject(verb, subject)
    instruction = Instruction(
        id=uuid4().hex[:12],
        verb=verb,
        subject=subject,
        reason=reason,
        seconds=seconds,
        expires=time.time_ns() + round(patience * 1e9),
    )
    question = AppRequest("firewall", INSTRUCTION, _ANSWER, instruction.id, instruction.to_value())
    typer.echo(ask(question, updates, running.archive_url(archive), patience))


def _check_subject(verb: Verb, subject: str) -> None:
    """Refuse at once what no firewall would accept; raises BadInput."""
    try:
        if verb == "block":
            target_in(subject)
        elif verb == "allow":
            AllowList.parse((subject,))
    except ValueError as error:
        raise BadInput(str(error)) from None
