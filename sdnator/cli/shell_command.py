"""`sdnator shell`: p4runtime-shell on a running switch.

p4runtime-shell pins protobuf 3.20, which is slow with today's Python and conflicts with ours.  Therefore it
has its own environment in the cache folder, created on first use.
"""

import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from sdnator.cli.switch_place import DeviceId, Insecure, SwitchAddress, SwitchArgument, place_of
from sdnator.errors import BadInput, PipelineError
from sdnator.user_folders import user_folder

PACKAGE = "p4runtime-shell==0.0.6"
_MADE = "made"
_LOOK_SECONDS = 5.0


def shell(
    switch: SwitchArgument = "",
    *,
    device_id: DeviceId = 1,
    insecure: Insecure = False,
    again: Annotated[
        bool, typer.Option("--again", help="Recreate the shell's environment, if it is broken.")
    ] = False,
) -> None:
    """Open p4runtime-shell on a running switch; its controller stays primary.

    The first call creates an environment for the shell, which takes a minute and needs a package index.
    If the switch has no primary controller, the shell may write, too.

    Example: sdnator shell s1
    """
    place = place_of(switch, device_id, insecure=insecure)
    _look(place)
    python = environment(again=again)
    print(
        f"switch {place.name} at {place.address}; for example\n"
        '  for e in table_entry["ingress.block_src"].read(): print(e)\n'
        "  tables    direct_counters    Ctrl-D exits",
        flush=True,
    )
    raise typer.Exit(subprocess.run(_command(python, place), check=False).returncode)


def _command(python: Path, place: SwitchAddress) -> list[str]:
    # the lowest election id leaves the controller primary; the time tells shells apart
    rank = f"0,{time.time_ns() // 1_000_000}"
    return [
        str(python), "-m", "p4runtime_sh",
        "--grpc-addr", place.address, "--device-id", str(place.device_id), "--election-id", rank,
    ]  # fmt: skip


def folder() -> Path:
    """Folder of the shell's environment."""
    name = f"p4runtime-shell-{sys.version_info.major}.{sys.version_info.minor}"
    return user_folder("XDG_CACHE_HOME", ".cache") / name


def environment(*, again: bool = False) -> Path:
    """The Python of the shell's environment, which is created if it is missing.

    Raises PipelineError with the installer's last lines if it cannot be created.
    """
    place = folder()
    python = place / "bin" / "python"
    if (place / _MADE).is_file() and not again:
        return python
    print(f"creating an environment for {PACKAGE} in {place} (once; about a minute)", flush=True)
    shutil.rmtree(place, ignore_errors=True)
    try:
        place.mkdir(parents=True, mode=0o700)
    except OSError as error:
        raise BadInput(
            f"{place}: {error.strerror}; set XDG_CACHE_HOME to a folder that you can write to"
        ) from None
    _step([sys.executable, "-m", "venv", str(place)])
    _step([str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", PACKAGE])
    (place / _MADE).write_text(PACKAGE + "\n", encoding="utf-8")
    return python


def _step(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        words = (done.stdout + done.stderr).strip().splitlines()[-3:]
        raise PipelineError(
            f"cannot create the shell's environment: {' '.join(command[1:4])} failed:\n  "
            + "\n  ".join(words)
            + "\ncheck the network and pip's settings (PIP_INDEX_URL), or use `sdnator tables`"
        )


def _look(place: SwitchAddress) -> None:
    """One line for an unreachable switch; the shell itself prints a page of traceback."""
    import grpc

    from p4rt import P4RuntimeStub, open_channel, p4runtime

    with open_channel(place.address, place.security) as channel:
        try:
            P4RuntimeStub(channel).Capabilities(p4runtime.CapabilitiesRequest(), timeout=_LOOK_SECONDS)
        except grpc.RpcError as error:
            raise PipelineError(
                f"switch at {place.address}: {error.code().name}: {error.details()}; see `sdnator status`"
            ) from None
