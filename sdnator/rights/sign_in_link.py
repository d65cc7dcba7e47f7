"""A link that signs its holder in once, as the owner: for who started the pipeline, and reads its output."""

import hmac
import secrets
from pathlib import Path

FILE = "dashboard.link"
PATH = "/link/"
_LONGEST = 256


def new_link(state: Path, page: str) -> str:
    """Make one; those before it end.  Raises OSError.

    Args:
        state: the state folder, in which the page looks it up.
        page: URL of the page, with a slash at its end.
    """
    secret = secrets.token_urlsafe(24)
    from due.private_files import write_private  # the commands load nothing heavy

    write_private(state / FILE, secret + "\n")
    return f"{page.rstrip('/')}{PATH}{secret}"


def used_up(file: Path, given: str) -> bool:
    """Whether this is the secret of the link, which then ends."""
    try:
        secret = file.read_text("ascii").strip()
    except (OSError, ValueError):
        return False
    if not secret or not hmac.compare_digest(given[:_LONGEST].encode("utf-8", "replace"), secret.encode()):
        return False
    try:
        file.unlink()
    except OSError:  # somebody else was faster, or it would stay good
        return False
    return True
