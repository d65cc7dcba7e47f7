"""The webhook as an enforcer: blocks posted, answers read, listings compared.  I/O through the HTTP client."""

from collections import Counter
from collections.abc import Mapping, Sequence

from apps.enforcers.desired_blocks import DesiredBlock
from apps.enforcers.enforcer import EnforcerAway, HeldCount
from apps.enforcers.webhook_enforcer.exchange import (
    FAILED_FOR_NOW,
    answer_in,
    body_of,
    listing_in,
    unblock_body,
)
from apps.enforcers.webhook_enforcer.http_client import SignedHttpClient
from apps.messages import MessageError, one_line


class Webhook:
    """An `Enforcer`: whatever answers at one URL."""

    def __init__(self, client: SignedHttpClient) -> None:
        self._client = client
        self._lost: Counter[str] = Counter()
        """How often a listing lacked a block that was confirmed."""
        self._listings = 0

    def change(self, add: Sequence[DesiredBlock], remove: Sequence[DesiredBlock]) -> Mapping[str, str]:
        """One POST for each; where one cannot be sent all come again, which is why each has an idempotency key."""
        for desired_block in remove:
            self._post(body_of(desired_block, "unblock", self._lost.pop(desired_block.id, 0)))
        answers = {
            desired_block.id: self._post(body_of(desired_block, "block", self._lost[desired_block.id]))
            for desired_block in add
        }
        return {name: cause for name, cause in answers.items() if cause}

    def allow(self, entries: Sequence[str]) -> None:
        """The enforcement worker blocks nobody of the list; the server need not know it."""

    def held(self, desired: Sequence[DesiredBlock]) -> Mapping[str, HeldCount]:
        """Ask for the listing; what stands there and should not is lifted."""
        status, body = self._client.ask("GET")
        if status != 200:
            raise EnforcerAway(f"the webhook does not list its blocks: it answers {status}")
        try:
            counts = listing_in(body).counts()
        except MessageError as error:
            raise EnforcerAway(f"the webhook's listing: {error}") from None
        self._listings += 1
        wanted = {desired_block.id for desired_block in desired}
        for name in counts:
            if name not in wanted:
                self._post(unblock_body(name, self._listings))
        self._lost.update(wanted - counts.keys())
        return {name: count for name, count in counts.items() if name in wanted}

    def end(self, desired: Sequence[DesiredBlock]) -> None:  # noqa: ARG002 - part of the interface
        """What stands there stays until its end, which the server was told."""
        self._client.close()

    def _post(self, body: bytes) -> str:
        """Why it was refused for good; empty: it was done."""
        status, answered = self._client.ask("POST", body)
        if status >= 500 or status in FAILED_FOR_NOW:
            raise EnforcerAway(f"the webhook answers {status}: {_words(answered)}")
        if not 200 <= status < 300:
            return f"the webhook answers {status}: {_words(answered)}"
        try:
            answer = answer_in(answered)
        except MessageError as error:
            return f"the webhook's answer: {error}"
        if answer.state == "failed":
            return one_line(answer.cause or "refused without a cause")
        return ""


def _words(body: bytes) -> str:
    return one_line(body[:200].decode("utf-8", "replace")) or "no words"
