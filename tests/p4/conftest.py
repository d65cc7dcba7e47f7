"""The product's program on both back ends."""

from collections.abc import Iterator

import pytest

from dataplane.v1model.externs import CounterValue
from dataplane.v1model.switch import Switch
from tests.dataplane.loading import MAKERS, sdnator
from tests.p4.sdnator_switch import made


@pytest.fixture(scope="session", params=MAKERS)
def standing_switch(request) -> Iterator[Switch]:
    made_switch = made(sdnator(), request.param)
    yield made_switch
    made_switch.close()


@pytest.fixture
def switch(standing_switch) -> Iterator[Switch]:
    """Without entries, with the program's default actions; registers keep what is in them.

    The test made no access out of range.
    """
    for table in standing_switch.tables.values():
        table.clear()
        if not table.spec.default_is_const:
            table.reset_default()
    unparsed = standing_switch.counters["ingress.unparsed_frames"]
    for cause in range(unparsed.spec.size):
        unparsed.write(cause, CounterValue())
    before = standing_switch.out_of_range()
    yield standing_switch
    assert standing_switch.out_of_range() == before
