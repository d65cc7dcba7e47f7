"""Reads from a running pipeline: the Coordinator's HTTP API, and the latest items of the archive."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

from sdnator.errors import BadInput, PipelineError

if TYPE_CHECKING:
    from due import Item
    from due.drivers.base import ArchiveDriver

_SECONDS = 5.0
_WINDOWS_NS = (60 * 10**9, 3_600 * 10**9, 86_400 * 10**9)


def ask(url: str, path: str) -> Any:
    """The JSON answer of the API.

    Args:
        url: http://HOST:PORT, with `viewer:TOKEN@` before the host where the Coordinator wants a token.
        path: of the API.

    Raises:
        BadInput: the URL is malformed.
        PipelineError: there is no answer.
    """
    import http.client
    from urllib.error import URLError
    from urllib.request import ProxyHandler, Request, build_opener

    if not url.startswith(("http://", "https://")):
        raise BadInput(f"--url {without_user(url)}: give http://HOST:PORT of a Coordinator")
    scheme, _, rest = url.rstrip("/").partition("://")
    user, _, place = rest.rpartition("@")
    url = f"{scheme}://{place}"
    headers = {"Authorization": f"Bearer {user.partition(':')[2]}"} if user else {}
    opener = build_opener(ProxyHandler({}))  # it is on loopback: a proxy would connect to the wrong machine
    try:
        with opener.open(Request(url + path, headers=headers), timeout=_SECONDS) as answer:  # noqa: S310 - checked
            return json.load(answer)
    except (URLError, OSError, ValueError, RecursionError, http.client.HTTPException) as error:
        cause = getattr(error, "reason", None) or error
        raise PipelineError(
            f"no Coordinator answers at {url}{path} ({cause}); see `sdnator status`"
        ) from None


def with_token(url: str, token: str) -> str:
    """A URL of the API that brings a token, unless it has one; with an empty token as it is."""
    scheme, _, place = url.partition("://")
    return f"{scheme}://viewer:{token}@{place}" if token and "@" not in place else url


def without_user(url: str) -> str:
    """A URL without user and password, for people."""
    scheme, _, rest = url.partition("://")
    return f"{scheme}://{rest.rpartition('@')[2]}"


def is_file(path: Path) -> bool:
    """Whether a file is there; False for a path that cannot be one, such as a name that is too long."""
    try:
        return path.is_file()
    except OSError:
        return False


def open_existing(url: str) -> "ArchiveDriver":
    """An archive to read from.

    Raises:
        BadInput: its file is not there; opening would make an empty one.
    """
    from due.backends import open_archive

    if url.startswith("sqlite:") and not is_file(Path(unquote(urlsplit(url).path))):
        raise BadInput(
            f"there is no archive at {url} yet: start a pipeline with `sdnator up`, or give --archive"
        )
    return open_archive(url)


def latest(
    find: "Callable[..., list[Item]]",
    query: Mapping[str, Any],
    start: int,
    end: int,
    limit: int,
) -> "tuple[list[Item], bool]":
    """The newest items, oldest first, and whether there are older ones; times in ns, `end` not included.

    Looks at the last minute first, then farther back until there are enough, and asks for no more than that: the
    archive may be large.  `find` is called as `ArchiveDriver.find`.
    """
    items: list[Item] = []
    for window in (*_WINDOWS_NS, end - start):
        left = max(start, end - window)
        items = find({"$and": [query, {"timestamp": {"$gte": left, "$lt": end}}]}, limit=limit + 1)
        if len(items) > limit or left == start:
            break
    return items[-limit:], len(items) > limit
