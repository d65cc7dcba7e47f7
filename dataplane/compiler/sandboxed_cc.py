"""The C compiler as a process that can do little else: nothing of ours is in its reach but the text.

    us ── starter ── limits, no network, another user where we are root ── cc -x c - ──► folder/switch.so
     ◄── bytes of the library, checked ──────────────────────────────────────────────┘

The compiler reads generated text only, but it is large, and what it makes runs with our rights.  It gets an
environment with a PATH and nothing else, a folder of its own, and limits of time, memory and file size.
"""

import os
import secrets
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from dataplane.errors import CompilerError

TIMEOUT_S = 300
CPU_S = 300
MEMORY_BYTES = 4 << 30
LIBRARY_BYTES = 64 << 20
_ELF = b"\x7fELF"
_MACHO = (b"\xcf\xfa\xed\xfe", b"\xca\xfe\xba\xbe")
_SEARCHED = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
_FIRST_USER, _USERS = 61_184, 4_000
"""Numbers without a name, as systemd takes them for services: no other process can be one of them."""
_SAID = 2000

_NEW_NET, _NEW_USER = 0x40000000, 0x10000000
_NO_NEW_PRIVS, _PDEATHSIG = 38, 1

# A process of its own: between fork and exec of one with gRPC's threads no Python may run.
_STARTER = f"""
import ctypes, os, resource, sys
user, command = int(sys.argv[1]), sys.argv[2:]
for limit, most in (
    (resource.RLIMIT_CPU, {CPU_S}), (resource.RLIMIT_AS, {MEMORY_BYTES}),
    (resource.RLIMIT_FSIZE, {LIBRARY_BYTES}), (resource.RLIMIT_CORE, 0),
):
    hard = resource.getrlimit(limit)[1]
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(limit, (most, most))
libc = ctypes.CDLL(None)


def without_network():
    if os.geteuid() == 0:
        return libc.unshare({_NEW_NET}) == 0
    user, group = os.getuid(), os.getgid()
    same = (("setgroups", "deny"), ("uid_map", "%d %d 1" % (user, user)), ("gid_map", "%d %d 1" % (group, group)))
    if libc.unshare({_NEW_NET | _NEW_USER}) != 0:
        return False
    try:
        for name, said in same:
            with open("/proc/self/" + name, "w") as opened:
                opened.write(said)
    except OSError:
        return False
    return True


def allowed():
    # tried in another process: where a system takes it half, nothing could be written any more
    pid = os.fork()
    if pid == 0:
        os._exit(0 if without_network() else 1)
    return os.waitpid(pid, 0)[1] == 0


if sys.platform == "linux" and allowed():
    without_network()
if user:
    os.setgroups([])
    os.setgid(user)
    os.setuid(user)
if sys.platform == "linux":
    libc.prctl({_NO_NEW_PRIVS}, 1, 0, 0, 0)
    libc.prctl({_PDEATHSIG}, 9)
os.execv(command[0], command)
"""


def compile_confined(cc: str, flags: Sequence[str], text: str) -> bytes:
    """The library that the compiler makes of the text.

    cc: its path
    flags: fixed ones; input and output are given here

    Raises CompilerError.
    """
    with _folder() as (folder, user):
        made = folder / "switch.so"
        command = [sys.executable, "-I", "-S", "-c", _STARTER, str(user), cc, *flags]
        command += ["-x", "c", "-o", str(made), "-"]
        environment = {
            "PATH": _search_path(cc), "LC_ALL": "C", "TMPDIR": str(folder), "HOME": str(folder)
        }  # fmt: skip
        code, said = _run(command, text, folder, environment)
        if code != 0:
            raise CompilerError(f"{cc} refused the generated C: {said[:_SAID]}")
        return _library(made, user)


def _run(command: Sequence[str], text: str, folder: Path, environment: Mapping[str, str]) -> tuple[int, str]:
    """Exit code and what was said; with everything that the compiler started, it ends in time."""
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            cwd=folder,
            env=environment,
            start_new_session=True,
        )
    except OSError as error:
        raise CompilerError(f"{command[0]} cannot be started: {error.strerror}") from error
    with process:
        try:
            _, said = process.communicate(text, TIMEOUT_S)
        except subprocess.TimeoutExpired as error:
            raise CompilerError(
                f"the compiler did not finish within {TIMEOUT_S} s and was stopped"
            ) from error
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    return process.returncode, said


def _search_path(cc: str) -> str:
    """The compiler's helpers stand beside it, or where the system has its programs."""
    return f"{Path(cc).parent}:{_SEARCHED}"


@contextmanager
def _folder() -> Iterator[tuple[Path, int]]:
    """A fresh folder for one compilation, and the user who owns it: 0 = we ourselves."""
    folder = Path(tempfile.mkdtemp(prefix="sdnator-cc-"))
    user = 0
    try:
        if os.geteuid() == 0:
            another = _FIRST_USER + secrets.randbelow(_USERS)
            with suppress(OSError):  # a container may not know this user
                os.chown(folder, another, another)
                user = another
        yield folder, user
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _library(path: Path, user: int) -> bytes:
    """What was made, if it is a library and nothing else.  Raises CompilerError."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        with os.fdopen(descriptor, "rb") as opened:
            status = os.fstat(descriptor)
            plain = stat.S_ISREG(status.st_mode) and status.st_nlink == 1
            if not plain or status.st_uid != (user or os.geteuid()):
                raise CompilerError(f"the compiler left {path.name} that is not a plain file of its own")
            data = opened.read(LIBRARY_BYTES + 1)
    except OSError as error:
        raise CompilerError(f"the compiler left no {path.name}: {error.strerror}") from error
    if len(data) > LIBRARY_BYTES or not data.startswith((_ELF, *_MACHO)):
        raise CompilerError("the compiler produced something that is not a library")
    return data
