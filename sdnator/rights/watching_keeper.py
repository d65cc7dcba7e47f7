"""What the keepers of rights share: a thread that makes a server's users as the identities say, whenever these change."""

import logging
import threading
from abc import ABC, abstractmethod
from collections import Counter
from typing import ClassVar

from sdnator.errors import BadInput, SdnatorError
from sdnator.rights.identities import Identities

_LOOK_SECONDS = 1.0

log = logging.getLogger(__name__)


class RightsRefused(SdnatorError):
    """The server lets this credential make no users."""


class WatchingKeeper(ABC):
    """Watches the identities of one installation for one server.

    Args:
        url: of the server, with a credential that may make users there.
        identities: who may do what.
    """

    _away: ClassVar[tuple[type[Exception], ...]]
    """What is raised while the server cannot be reached."""

    def __init__(self, url: str, identities: Identities) -> None:
        self._url = url
        self._identities = identities
        self._changed = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="rights", daemon=True)
        self.refusals: Counter[str] = Counter()
        """Refused commands by user; empty where the server tells nobody."""

    @abstractmethod
    def apply(self) -> None:
        """Make every user now.

        Raises:
            RightsRefused: the credential may not.
            PipelineError: the server does not answer.
        """

    def start(self) -> None:
        """Watch from now on."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread; the users stay."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join(20)

    def told(self) -> list[str]:
        """What was refused since the last call, in words; nothing where the server tells nobody."""
        return []

    def close(self) -> None:  # noqa: B027 - most hold none
        """Close connections; nothing where none is held."""

    def look(self) -> bool:
        """One look; whether the identities had changed, so that the users were made."""
        if self._stamp() == self._changed:
            return False
        self._identities.reread()
        self._take_up()
        return True

    def _take_up(self) -> None:
        stamp = self._stamp()
        self._make()
        self._changed = stamp

    @abstractmethod
    def _make(self) -> None:
        """Every identity is a user with its rights, and no other of this installation is."""

    def _stamp(self) -> int:
        try:
            return self._identities.path.stat().st_mtime_ns
        except OSError:
            return self._changed

    def _run(self) -> None:
        told = ""
        while not self._ended.wait(_LOOK_SECONDS):
            try:
                self.look()
                told = ""
            except BadInput as error:  # the file of identities; the users stay as they are
                if str(error) != told:
                    told = str(error)
                    log.warning("changes of rights are not taken up: %s", told)
            except self._away as error:
                log.debug("rights cannot be looked after now: %s", error)
                self.close()
        self.close()
