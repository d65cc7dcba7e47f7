"""`sdnator model …`: what Kitsune has learnt, and how to retrain it."""

import json
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Final
from uuid import uuid4

import typer

from apps.kitsune.kept_model import models_aside, set_aside
from apps.kitsune.model_file import ModelFileError, load_model
from apps.kitsune.model_instructions import ANSWER, INSTRUCTIONS, ModelInstruction
from sdnator.app_requests import AppRequest, ask
from sdnator.errors import BadInput, PipelineError
from sdnator.model_words import model_lines, model_of
from sdnator.up import running

model = typer.Typer(help="Kitsune's model: show it, retrain it.", no_args_is_help=True)

_ANSWER_SECONDS: Final = 10.0
JsonOption = Annotated[bool, typer.Option("--json", help="JSON on standard output.")]


@model.command("show")
def show(*, as_json: JsonOption = False) -> None:
    """Show what the model of the running pipeline has learnt; without one, what the kept file holds.

    Example: sdnator model show
    """
    found = running.find()
    live = _live(found) if found is not None else None
    path = running.model_file(running.state_folder())
    kept = _kept(path)
    aside = [str(each) for each in models_aside(path)]
    if as_json:
        typer.echo(json.dumps({"running": live, "kept": kept, "aside": aside}))
        return
    if live is not None:
        typer.echo("\n".join(model_lines(live)))
        if live.get("file"):
            typer.echo(f"  kept in {live['file']}")
    elif kept is None:
        typer.echo(f"no model is kept in {path}: `sdnator up` trains one, and keeps it")
    else:
        typer.echo("\n".join(model_lines(kept)))
        switches = kept["trained_for"].get("switches", {})
        typer.echo(
            "".join(f"  for switch {name}: {', '.join(ports)}\n" for name, ports in switches.items()),
            nl=False,
        )
        typer.echo(
            f"  kept in {path}; `sdnator up` uses it again if switches, ports and settings are the same"
        )
    for old in aside:
        typer.echo(f"  older: {old}")


@model.command("retrain")
def retrain(
    *,
    beside: Annotated[
        bool,
        typer.Option("--beside", help="Train a second model beside it, which takes over if it is no worse."),
    ] = False,
) -> None:
    """Discard the model and train on the next packets; the old file is kept under another name.

    A running Kitsune does so at once; until it has trained, nobody else is blocked. With --beside the model in use
    stays until the other is trained and both have scored the same packets. Without a pipeline the next `sdnator up`
    trains.

    Example: sdnator model retrain --beside
    """
    if running.find() is None and beside:
        raise BadInput(
            "no pipeline is running, so there is no model to train beside; start `sdnator up` first"
        )
    if running.find() is None:
        path = running.model_file(running.state_folder())
        try:
            aside = set_aside(path)
        except OSError as error:
            raise BadInput(f"{path}: {error.strerror}; the model was not changed") from None
        typer.echo(
            f"the next `sdnator up` trains again; the old model is kept as {aside}"
            if aside is not None
            else f"no model is kept in {path}; the next `sdnator up` trains"
        )
        return
    instruction = ModelInstruction(
        id=uuid4().hex[:12],
        verb="renew" if beside else "retrain",
        expires=time.time_ns() + round(_ANSWER_SECONDS * 1e9),
    )
    question = AppRequest("detector", INSTRUCTIONS, ANSWER, instruction.id, instruction.to_value())
    typer.echo(ask(question, "", running.archive_url(""), _ANSWER_SECONDS))


def _live(found: running.Running) -> dict[str, Any] | None:
    from sdnator.northbound import ask as asked

    with suppress(PipelineError):
        said = model_of(asked(found.coordinator, "/health"))
        return dict(said) if said is not None else None
    return None


def _kept(path: Path) -> dict[str, Any] | None:
    """What a file holds; None if there is none.  Raises BadInput for one that cannot be read."""
    if not path.exists():
        return None
    try:
        notes = load_model(path).notes
    except ModelFileError as error:
        raise BadInput(f"{error}; `sdnator model retrain` sets it aside") from None
    behaviour = notes.get("behaviour") or {}
    drift = notes.get("drift") or {}
    return {
        "done": True,
        "trained_at_us": int(notes.get("trained_at_us", 0)),
        "trained_s": float(behaviour.get("seconds", 0.0)),
        "senders": len(behaviour.get("senders", ())),
        "drifted": bool(drift.get("drifted")),
        "trained_for": notes.get("trained_for") or {},
    }
