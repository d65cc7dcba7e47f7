"""What `sdnator --install-completion` installs works in the shells themselves, not only as a script asks for it."""

import os
import pty
import select
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sdnator import __version__
from tests.requirements import require_program

SECONDS = 60
PROMPT = "ready> "
SHELLS = {
    "bash": (".bashrc", f"PS1='{PROMPT}'\n"),
    "zsh": (".zshrc", f"PS1='{PROMPT}'\n"),
    "fish": (".config/fish/config.fish", f"function fish_prompt; echo -n '{PROMPT}'; end\n"),
}
"""Where each has its settings, and what they say before ours are added."""
TABS = {"bash": 1, "zsh": 2, "fish": 1}
"""zsh loads Typer's function at the first Tab and calls it from the second on."""


class Terminal:
    """A shell, and somebody who types."""

    def __init__(self, command: list[str], environment: dict[str, str]) -> None:
        self._near, far = pty.openpty()
        words = [require_program("setsid"), "--ctty", *command]  # fish wants to control its terminal
        self._shell = subprocess.Popen(words, stdin=far, stdout=far, stderr=far, env=environment)
        os.close(far)
        self._said = ""

    def __enter__(self) -> "Terminal":
        return self

    def __exit__(self, *_: object) -> None:
        self._shell.kill()
        self._shell.wait()
        os.close(self._near)

    def wait_for(self, text: str) -> None:
        """Until the terminal shows it, behind what it was waited for before."""
        deadline = time.monotonic() + SECONDS
        while text not in self._said:
            assert time.monotonic() < deadline, f"no {text!r} in {self._said!r}"
            if select.select([self._near], [], [], 0.2)[0]:
                self._said += os.read(self._near, 65_536).decode(errors="replace")
        self._said = self._said.partition(text)[2]

    def type(self, keys: str) -> None:
        os.write(self._near, keys.encode())


@pytest.mark.parametrize("shell", SHELLS)
def test_a_shell_completes_what_a_person_has_begun(shell, tmp_path):
    """`--vers` is no option: that the version is shown says that Tab has made one of it."""
    program = require_program(shell)
    home = {
        "HOME": str(tmp_path),
        "XDG_CONFIG_HOME": str(tmp_path / ".config"),
        "XDG_DATA_HOME": str(tmp_path),
    }
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**home, "PATH": path, "TERM": "xterm", "LANG": "C.UTF-8"}
    file, text = SHELLS[shell]
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).write_text(text, encoding="utf-8")
    done = subprocess.run(
        [program, "-c", "sdnator --install-completion; true"],
        env=environment, capture_output=True, text=True, check=False, timeout=SECONDS,
    )  # fmt: skip
    assert f"{shell} completion installed" in done.stdout, done.stderr
    with Terminal([program, "-i"], environment) as terminal:
        terminal.wait_for(PROMPT)
        terminal.type("sdnator --vers" + "\t" * TABS[shell] + "\r")
        terminal.wait_for(f"sdnator {__version__}")
