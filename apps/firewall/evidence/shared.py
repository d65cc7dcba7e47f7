"""One object for equal names: what is kept of a sender in many places names it once.

Every message brings its own copies of the names in it, and of a sender there are many: a kilobyte for each.
"""

from functools import lru_cache
from typing import Final

from apps.messages import Sender

MOST_SHARED: Final = 2_048
"""Senders, and texts, of which the first object is known: those of the last half hour, where each second brings another
one.  What was pushed out is shared by what came before, and is forgotten with it."""


@lru_cache(maxsize=MOST_SHARED)
def shared_sender(sender: Sender) -> Sender:
    """The sender as it came first.

    Args:
        sender: of a message.

    Returns:
        An equal one, the same for all messages that name it as long as others have not pushed it out.
    """
    return sender


@lru_cache(maxsize=MOST_SHARED)
def shared_text(text: str) -> str:
    """A short text as it came first, such as an address or a key.

    Args:
        text: from a message.

    Returns:
        An equal text, the same each time as long as others have not pushed it out.
    """
    return text
