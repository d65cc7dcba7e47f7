"""RECONCILE_AND_COMMIT carries everything over, or nothing at all."""

from pathlib import Path

import pytest

from dataplane.p4runtime.pipeline import ForwardingPipeline, verify
from dataplane.p4runtime.pipeline_config import plan
from dataplane.p4runtime.status import InvalidArgument
from dataplane.v1model.externs import CounterValue
from p4rt import p4runtime
from sdnator.testing.p4runtime_client import program_config
from tests.dataplane.loading import MAKERS

_FEATURES = Path(__file__).resolve().parents[1] / "programs" / "features"


def reconcile(config):
    request = p4runtime.SetForwardingPipelineConfigRequest(
        action=p4runtime.SetForwardingPipelineConfigRequest.RECONCILE_AND_COMMIT
    )
    request.config.CopyFrom(config)
    return request


@pytest.fixture(params=MAKERS)
def make(request):
    made = []

    def new(config):
        made.append(ForwardingPipeline(verify(config), cpu_port=510, maker=request.param, clock=lambda: 0))
        return made[-1]

    yield new
    for pipeline in made:
        pipeline.close()


@pytest.fixture
def config():
    return program_config(_FEATURES)


def test_registers_are_carried_over(make, config):
    old = make(config)
    name, array = next((n, a) for n, a in old.switch.registers.items() if a.size > 1)
    array.write(array.size - 1, 5)
    new = plan(reconcile(config), old, None, make).active
    assert new is not old
    assert {n: a.written() for n, a in new.switch.registers.items() if a.written()} == {
        name: [(array.size - 1, 5)]
    }


def test_counters_that_are_beyond_what_a_read_can_say_are_carried_over_as_its_largest(make, config):
    """A Write may set one to 2^63 - 1, and the next frame is counted."""
    old, most = make(config), 2**63 - 1
    old.switch.counters["I.seen"].write(3, CounterValue(most + 1, 2**64 - 1))
    new = plan(reconcile(config), old, None, make).active
    assert new.switch.counters["I.seen"].read(3) == CounterValue(most, most)


def test_a_register_that_the_new_program_lacks_is_refused(make, config):
    old = make(config)
    name, array = next(iter(old.switch.registers.items()))
    array.write(0, 1)
    other = type(config)()
    other.CopyFrom(config)
    register = next(r for r in other.p4info.registers if r.preamble.name == name)
    register.preamble.name = "x.y"
    other.p4_device_config = config.p4_device_config.replace(f'"{name}"'.encode(), b'"x.y"')
    with pytest.raises(InvalidArgument, match=f"no register {name}"):
        plan(reconcile(other), old, None, make)
