"""A real redis-server behind TLS on loopback, which wants a certificate of its clients.

The embedded server's wheel has no TLS; Debian's redis-server has.
"""

import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self
from urllib.parse import urlencode

from due.drivers.embedded_redis import SUBSCRIBER_LIMIT
from due.drivers.redis_wire import Wire, as_user
from due.errors import UpdatesUnavailable
from due.private_files import write_private
from sdnator.rights.certificates import CA, CertificateFolder
from sdnator.testing.ports import free_port

_START_SECONDS = 30
_SERVER, _CLIENT = "server", "client"


class RedisMissing(RuntimeError):
    """No redis-server with TLS on this machine; the text says why."""


class TlsRedis:
    """A server for as long as the context lasts.

    Args:
        folder: for certificates, users and the log.
        users: the text of its ACL file; None: any client with a certificate may do everything.
        admin: user and password of an administrator in it.
    """

    def __init__(
        self, folder: Path, users: Callable[[], str] | None = None, admin: tuple[str, str] | None = None
    ) -> None:
        self._folder = folder
        self._users = users
        self._admin = admin
        self._certificates = CertificateFolder(folder / "certificates")
        self._port, self._plain_port = free_port(), free_port()
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def url(self) -> str:
        """rediss:// with the client's certificate, without a user."""
        certificate = {"ssl_certfile": self._file(_CLIENT, "pem"), "ssl_keyfile": self._file(_CLIENT, "key")}
        return f"{self.url_without_certificate}&{urlencode(certificate)}"

    @property
    def url_without_certificate(self) -> str:
        """rediss:// of a client that checks the server and shows nothing itself."""
        return f"rediss://localhost:{self._port}/0?{urlencode({'ssl_ca_certs': self._file(CA, 'pem')})}"

    @property
    def plain_url(self) -> str:
        """The same server without TLS, to compare."""
        return f"redis://localhost:{self._plain_port}/0"

    @property
    def admin_url(self) -> str:
        """With the right to make users; `url` where there are none."""
        return as_user(self.url, *self._admin) if self._admin is not None else self.url

    def __enter__(self) -> Self:
        program = shutil.which("redis-server")
        if program is None:
            raise RedisMissing("program redis-server is not installed (on Debian: redis-server)")
        self._certificates.make_ca()
        self._certificates.issue(_SERVER, hosts=["localhost"])
        self._certificates.issue(_CLIENT)
        with (self._folder / "server.log").open("wb") as log:
            self._process = subprocess.Popen(
                [program, *self._arguments()], stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
            )
        self._wait()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def _arguments(self) -> list[str]:
        arguments = {
            "bind": "127.0.0.1",
            "port": self._plain_port,
            "tls-port": self._port,
            "tls-cert-file": self._file(_SERVER, "pem"),
            "tls-key-file": self._file(_SERVER, "key"),
            "tls-ca-cert-file": self._file(CA, "pem"),
            "tls-auth-clients": "yes",
            "save": "",
            "dir": self._folder,
        }
        if self._users is not None:
            write_private(self._folder / "users.acl", self._users())
            arguments["aclfile"] = self._folder / "users.acl"
        # as the embedded server: a reader that gets no core for seconds is not cut off
        limit = ["--client-output-buffer-limit", "pubsub", *SUBSCRIBER_LIMIT]
        return [*(part for name, value in arguments.items() for part in (f"--{name}", str(value))), *limit]

    def _wait(self) -> None:
        deadline = time.monotonic() + _START_SECONDS
        while time.monotonic() < deadline:
            try:
                Wire(self.url).close()
            except UpdatesUnavailable:
                time.sleep(0.01)
            else:
                return
        said = (self._folder / "server.log").read_text(errors="replace")[-500:]
        raise RedisMissing(f"redis-server with TLS did not start: {said}")

    def _file(self, name: str, kind: str) -> Path:
        return self._folder / "certificates" / f"{name}.{kind}"
