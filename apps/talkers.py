"""Top talkers: the message to the dashboard from the app that sees all packets.

kitsune ──TopTalkers──► page      network.traffic.<app>.<switch>
"""

from typing import Annotated, Final

from msgspec import Meta

from apps.messages import Message, MessageError, Name, Number, Sender, Time

TALKERS: Final = "network.traffic"
"""`<TALKERS>.<app>.<switch>`"""
MOST_TALKERS: Final = 10


class Talker(Message, frozen=True, kw_only=True):
    """A sender and what it sent in the window."""

    sender: Sender
    packets: Number
    bytes: Number
    """On the wire."""


class TopTalkers(Message, frozen=True, kw_only=True):
    """The senders of most bytes in a window of capture time."""

    switch: Name
    since: Time
    """Capture time of the window's first packet, ns."""
    event_time: Time
    """Capture time of its last packet, ns."""
    packets: Number
    """Of all senders."""
    bytes: Number
    """Of all senders, on the wire."""
    talkers: Annotated[tuple[Talker, ...], Meta(max_length=MOST_TALKERS)]
    """The one with most bytes first."""

    def check(self) -> None:
        """Check the senders and the window.

        Raises:
            MessageError: a sender has no such address, or the window ends before it begins.
        """
        for one in self.talkers:
            one.sender.check()
        if self.since > self.event_time:
            raise MessageError("time", "top talkers: the window ends before it begins")
