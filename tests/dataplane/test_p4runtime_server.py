"""Short writes of table entries are done as they come in, and nothing is done twice or dropped for it."""

import grpc
import pytest

from dataplane.p4runtime_server import Servicer
from dataplane.status import Denied
from p4rt import p4runtime


class Written:
    """A device that notes how it was asked to write."""

    def __init__(self, now=()):
        self.asked = []
        self._now = now

    def write_now(self, request):
        self.asked.append(("now", len(request.updates)))
        if isinstance(self._now, Exception):
            raise self._now
        return None if self._now is None else list(self._now)

    def write(self, request):
        self.asked.append(("later", len(request.updates)))
        return []


class Ended(Exception):
    pass


class Call:
    """What a servicer uses of a call's context."""

    def abort(self, code, text):
        raise Ended(code, text)


def request(updates=1, kind="table_entry"):
    message = p4runtime.WriteRequest()
    for _ in range(updates):
        getattr(message.updates.add().entity, kind).SetInParent()
    return message.SerializeToString()


@pytest.mark.parametrize(
    ("data", "now", "asked"),
    [
        (request(), [], [("now", 1)]),
        (request(), None, [("now", 1), ("later", 1)]),
        (request(5000), [], [("later", 5000)]),
        (request(kind="register_entry"), [], [("later", 1)]),
    ],
    ids=["short", "busy switch", "long", "cells"],
)
def test_every_write_is_done_once(data, now, asked):
    device = Written(now)
    servicer = Servicer(device)
    assert servicer.answer(servicer.take(data), Call()) == p4runtime.WriteResponse()
    assert device.asked == asked


def test_a_refusal_at_once_is_told_and_not_tried_again():
    device = Written(Denied("only a primary may write"))
    servicer = Servicer(device)
    taken = servicer.take(request())
    with pytest.raises(Ended) as caught:
        servicer.answer(taken, Call())
    assert caught.value.args == (grpc.StatusCode.PERMISSION_DENIED, "only a primary may write")
    assert device.asked == [("now", 1)]
