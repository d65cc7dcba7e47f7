"""The user's folders for configuration, state, data and caches, as the XDG standard names them."""

import os
from pathlib import Path


def user_folder(variable: str, default: str) -> Path:
    """Our folder below the one that a variable names, or below this one of the home folder."""
    named = Path(os.environ.get(variable, ""))
    # the standard says to ignore relative paths
    return (named if named.is_absolute() else Path.home() / default) / "sdnator"
