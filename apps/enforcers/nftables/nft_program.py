"""The program `nft`: transactions in and listings out, as JSON.  I/O."""

import json
import shutil
import subprocess
from collections.abc import Sequence
from typing import Any, Final

from apps.enforcers.enforcer import EnforcerAway
from apps.enforcers.nftables.ruleset import FAMILY, Command
from apps.messages import one_line

_SECONDS: Final = 10.0
_NO_RIGHT: Final = ("Operation not permitted", "must be root", "Permission denied")
_NOT_THERE: Final = ("No such file or directory", "does not exist")
NEEDS_RIGHT: Final = (
    "nftables may not be changed: this process lacks CAP_NET_ADMIN; give it that one capability (systemd: "
    "AmbientCapabilities=CAP_NET_ADMIN, docker: --cap-add NET_ADMIN), no other root privilege is needed"
)


class TransactionRefused(Exception):
    """nftables has refused a transaction, and changed nothing."""


class NftProgram:
    """Runs `nft`; raises `EnforcerAway` where it is missing, lacks the right, or does not end."""

    def __init__(self, program: str = "nft") -> None:
        self._program = program

    def apply(self, commands: Sequence[Command]) -> None:
        """One transaction: all of it, or nothing.

        Raises:
            TransactionRefused: nftables takes it not.
            EnforcerAway: as above.
        """
        if commands:
            self._run(["-j", "-f", "-"], json.dumps({"nftables": list(commands)}))

    def table(self, name: str) -> dict[str, Any] | None:
        """The listing of a table; None if there is none.

        Raises:
            EnforcerAway: as above, and for a listing that is not JSON.
        """
        try:
            text = self._run(["-j", "list", "table", FAMILY, name], "")
        except TransactionRefused as error:
            if any(word in str(error) for word in _NOT_THERE):
                return None
            raise EnforcerAway(f"nft does not list {FAMILY} {name}: {error}") from None
        try:
            found: dict[str, Any] = json.loads(text)
        except ValueError as error:
            raise EnforcerAway(f"nft's listing of {FAMILY} {name} is not JSON: {error}") from None
        return found

    def _run(self, arguments: Sequence[str], text: str) -> str:
        program = shutil.which(self._program) or shutil.which(self._program, path="/usr/sbin:/sbin")
        if program is None:
            raise EnforcerAway(f"program {self._program} is not installed: install nftables")
        try:
            done = subprocess.run(
                [program, *arguments],
                input=text,
                capture_output=True,
                text=True,
                timeout=_SECONDS,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise EnforcerAway(f"{program}: {error}") from None
        if done.returncode == 0:
            return done.stdout
        if any(word in done.stderr for word in _NO_RIGHT):
            raise EnforcerAway(NEEDS_RIGHT)
        raise TransactionRefused(one_line(done.stderr.strip() or f"nft ended with {done.returncode}"))
