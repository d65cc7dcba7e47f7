"""Requests, signatures and answers of the webhook.  Pure.

POST URL    {"id", "action": "block"|"unblock", "target": {"kind", "address", "port"}, "expires", "reason", …}
            200 {"state": "installed"|"exists"|"removed"|"failed", "cause": "…"}
            An unblock of something that the server lists and SDNator does not know (any more) has the id alone.
GET URL     200 {"blocks": [{"id": "…", "packets": 0, "bytes": 0}, …]}

SDNator-Timestamp: 1700000000
SDNator-Signature: sha256=HEX     HMAC-SHA256 over "METHOD\\nPATH\\nTIMESTAMP\\n" and the body
Idempotency-Key: HEX              the same for every attempt of one request
"""

import hashlib
import hmac
import json
from typing import Annotated, Final, Literal, TypeVar

import msgspec
from msgspec import Meta

from apps.enforcement import MOST_HELD
from apps.enforcers.desired_blocks import DesiredBlock
from apps.enforcers.enforcer import HeldCount
from apps.messages import MessageError, Name, Number, Text

FAILED_FOR_NOW: Final = frozenset({408, 425, 429})
"""Status codes below 500 after which the same request may succeed."""
_T = TypeVar("_T")
Verb = Literal["block", "unblock"]


class WebhookAnswer(msgspec.Struct, frozen=True):
    """The answer to a POST."""

    state: Literal["installed", "exists", "removed", "failed"]
    cause: Text = ""


class ListedBlock(msgspec.Struct, frozen=True):
    """A block in the answer to a GET."""

    id: Name
    packets: Number = 0
    bytes: Number = 0


class WebhookListing(msgspec.Struct, frozen=True):
    """The answer to a GET."""

    blocks: Annotated[tuple[ListedBlock, ...], Meta(max_length=MOST_HELD)] = ()

    def counts(self) -> dict[str, HeldCount]:
        """By decision id."""
        return {each.id: HeldCount(each.packets, each.bytes) for each in self.blocks}


def body_of(desired_block: DesiredBlock, verb: Verb, round_: int = 0) -> bytes:
    """A block, or its end, as JSON.

    Args:
        desired_block: the block.
        verb: what is asked.
        round_: how often it was lost there, so that asking again is another request.
    """
    decision, target = desired_block.decision, desired_block.target
    said = {
        "id": decision.id,
        "action": verb,
        "target": {"kind": target.kind, "address": target.address, "port": target.port},
        "expires": desired_block.until,
        "reason": decision.reason,
        "switch": decision.switch,
        "round": round_,
    }
    return json.dumps(said, separators=(",", ":"), sort_keys=True).encode()


def unblock_body(decision_id: str, round_: int) -> bytes:
    """The end of a block that is none of ours any more."""
    said = {"id": decision_id, "action": "unblock", "round": round_}
    return json.dumps(said, separators=(",", ":"), sort_keys=True).encode()


def idempotency_key(body: bytes) -> str:
    """The same for the same request, at every attempt and after a restart."""
    return hashlib.sha256(body).hexdigest()


def signature(secret: bytes, method: str, path: str, timestamp: int, body: bytes) -> str:
    """What stands in `SDNator-Signature`.

    Args:
        secret: shared with the server.
        method: GET or POST.
        path: of the URL, with its query.
        timestamp: of `SDNator-Timestamp`, seconds since the epoch.
        body: of the request; empty for GET.
    """
    signed = f"{method}\n{path}\n{timestamp}\n".encode() + body
    return "sha256=" + hmac.new(secret, signed, hashlib.sha256).hexdigest()


def answer_in(body: bytes) -> WebhookAnswer:
    """Decode the answer to a POST; raises MessageError."""
    return _decoded(body, WebhookAnswer)


def listing_in(body: bytes) -> WebhookListing:
    """Decode the answer to a GET; raises MessageError."""
    return _decoded(body, WebhookListing)


def _decoded(body: bytes, kind: type[_T]) -> _T:
    try:
        return msgspec.json.decode(body, type=kind)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise MessageError("fields", f"{kind.__name__}: {error}") from None
