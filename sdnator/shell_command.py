"""`sdnator shell`: p4runtime-shell on a running switch.

p4runtime-shell pins protobuf 3.20, which is slow with today's Python and does not go together with ours:
it lives in an environment of its own, made on first use under the cache folder.
"""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from sdnator.errors import BadInput, PipelineError
from sdnator.switch_place import DeviceId, Place, SwitchArgument, place_of

PACKAGE = "p4runtime-shell==0.0.6"
_MADE = "made"
_LOOK_SECONDS = 5.0


def shell(
    switch: SwitchArgument = "",
    *,
    device_id: DeviceId = 1,
    again: Annotated[
        bool, typer.Option("--again", help="Make the shell's environment anew, if something broke it.")
    ] = False,
) -> None:
    """Look into a running switch with p4runtime-shell; its controller stays in charge.

    The first call makes an environment for the shell, which takes a minute and needs a package index.
    Where no controller is in charge, the shell may write as well.

    Example: sdnator shell s1
    """
    place = place_of(switch, device_id)
    _look(place)
    python = environment(again=again)
    print(
        f"switch {place.name} at {place.address}; for example\n"
        '  for e in table_entry["ingress.block_src"].read(): print(e)\n'
        "  tables    direct_counters    Ctrl-D ends",
        flush=True,
    )
    raise typer.Exit(subprocess.run(_command(python, place), check=False).returncode)


def _command(python: Path, place: Place) -> list[str]:
    # the lowest rank: whoever controls the switch goes on; the time tells shells apart
    rank = f"0,{time.time_ns() // 1_000_000}"
    return [
        str(python), "-m", "p4runtime_sh",
        "--grpc-addr", place.address, "--device-id", str(place.device_id), "--election-id", rank,
    ]  # fmt: skip


def folder() -> Path:
    """Where the shell's environment is, or will be."""
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    base = named if named.is_absolute() else Path.home() / ".cache"
    return base / "sdnator" / f"p4runtime-shell-{sys.version_info.major}.{sys.version_info.minor}"


def environment(*, again: bool = False) -> Path:
    """The Python of the shell's environment, which is made where it is missing.

    Raises PipelineError with the last words of the installer where it cannot be made.
    """
    place = folder()
    python = place / "bin" / "python"
    if (place / _MADE).is_file() and not again:
        return python
    print(f"making an environment for {PACKAGE} in {place} (once; about a minute)", flush=True)
    shutil.rmtree(place, ignore_errors=True)
    try:
        place.mkdir(parents=True, mode=0o700)
    except OSError as error:
        raise BadInput(f"{place}: {error.strerror}; set XDG_CACHE_HOME to a folder of yours") from None
    _step([sys.executable, "-m", "venv", str(place)])
    _step([str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", PACKAGE])
    (place / _MADE).write_text(PACKAGE + "\n", encoding="utf-8")
    return python


def _step(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        words = (done.stdout + done.stderr).strip().splitlines()[-3:]
        raise PipelineError(
            f"cannot make the shell's environment: {' '.join(command[1:4])} failed:\n  "
            + "\n  ".join(words)
            + "\ncheck the network and pip's settings (PIP_INDEX_URL), or use `sdnator tables`"
        )


def _look(place: Place) -> None:
    """The shell's own words for a switch that is not there are a page of traceback."""
    import grpc

    from p4rt import P4RuntimeStub, p4runtime

    with grpc.insecure_channel(place.address) as channel:
        try:
            P4RuntimeStub(channel).Capabilities(p4runtime.CapabilitiesRequest(), timeout=_LOOK_SECONDS)
        except grpc.RpcError as error:
            raise PipelineError(
                f"switch at {place.address}: {error.code().name}: {error.details()}; see `sdnator status`"
            ) from None
