"""Jars and what they need, copied by Maven into a cache folder.  Does I/O."""

import fcntl
import os
import shutil
import subprocess
from pathlib import Path
from typing import Final

_COPY_SECONDS: Final = 600
_COMPLETE: Final = "complete"
_POM: Final = """<project xmlns="http://maven.apache.org/POM/4.0.0">
  <modelVersion>4.0.0</modelVersion>
  <groupId>org.sdnator</groupId><artifactId>{artifact}-with-dependencies</artifactId><version>1</version>
  <dependencies><dependency>
    <groupId>{group}</groupId><artifactId>{artifact}</artifactId><version>{version}</version>
  </dependency></dependencies>
</project>
"""


class MavenMissing(RuntimeError):
    """Maven is not installed, or does not get the jars; the text says which."""


def maven_jars(group: str, artifact: str, version: str, *, name: str = "") -> Path:
    """The folder with an artifact's jar and those that it needs; Maven copies them once.

    Args:
        group: of the artifact, in Maven's words.
        artifact: its name.
        version: its version.
        name: of the folder; empty: the artifact's.

    Returns:
        A folder under `$XDG_CACHE_HOME` (default: ~/.cache).

    Raises:
        MavenMissing: Maven is not installed, or does not get them.
    """
    folder = _cache(name or artifact, version)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # two processes copy once
        if not (folder / _COMPLETE).exists():
            _copy(folder, _POM.format(group=group, artifact=artifact, version=version), artifact)
            (folder / _COMPLETE).touch()
    return folder / "libs"


def have_jars(artifact: str, version: str) -> bool:
    """Whether they were copied before."""
    return (_cache(artifact, version) / _COMPLETE).exists()


def _cache(name: str, version: str) -> Path:
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "sdnator" / f"{name}-{version}"


def _copy(folder: Path, pom: str, artifact: str) -> None:
    maven = shutil.which("mvn")
    if maven is None:
        raise MavenMissing(
            f"Maven, which copies the jars of {artifact}, is not installed (on Debian: maven); install it, or give a "
            "folder of jars"
        )
    (folder / "pom.xml").write_text(pom, encoding="utf-8")
    copied = subprocess.run(
        [
            maven,
            "--quiet",
            "--batch-mode",
            "dependency:copy-dependencies",
            "-DincludeScope=runtime",
            f"-DoutputDirectory={folder / 'libs'}",
        ],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=_COPY_SECONDS,
        check=False,
    )
    if copied.returncode != 0:
        raise MavenMissing(
            f"Maven could not copy the jars of {artifact}: {(copied.stdout + copied.stderr)[-500:]}"
        )
