"""Fixtures of the contract suite: every target that this machine has, and controllers for it."""

import itertools
from collections.abc import Iterator
from pathlib import Path

import grpc
import pytest

from dataplane.bmv2 import PROGRAM
from dataplane.compiler.c_machine import CMachine
from p4rt import p4runtime
from sdnator.testing.p4runtime_client import EntryBuilder, P4RuntimeClient, program_config
from tests.contract.targets import Bmv2Target, EmbeddedTarget, Target
from tests.naive.p4.python_machine import PythonMachine
from tests.requirements import optional_program

PROGRAMS = Path(__file__).resolve().parents[1] / "dataplane" / "programs"
_ids = itertools.count(10, 10)


@pytest.fixture(scope="module", params=["embedded", "oracle", "bmv2"])
def target(request: pytest.FixtureRequest) -> Iterator[Target]:
    made: Target
    if request.param == "bmv2":
        optional_program(PROGRAM)
        made = Bmv2Target()
    else:
        made = EmbeddedTarget(CMachine if request.param == "embedded" else PythonMachine)
    yield made
    made.close()


@pytest.fixture(scope="session")
def config():
    return program_config(PROGRAMS / "features")


@pytest.fixture(scope="session")
def names(config):
    return EntryBuilder(config.p4info)


@pytest.fixture
def connect(target):
    """Opens controllers with ever higher election ids; all are closed afterwards."""
    opened = []

    def open_one(**options) -> P4RuntimeClient:
        options.setdefault("election_id", next(_ids))
        opened.append(P4RuntimeClient(target.address, **options))
        return opened[-1]

    yield open_one
    for controller in opened:
        controller.close()


@pytest.fixture
def bare(connect) -> P4RuntimeClient:
    """A primary on a switch whose pipeline may be any or none."""
    controller = connect()
    assert controller.arbitrate().status.code == 0
    return controller


@pytest.fixture
def controller(target, bare, config) -> P4RuntimeClient:
    """A primary on a switch with the feature program, freshly set and empty."""
    target.drain()
    for entity in _replications(bare):
        bare.write(entity)
    bare.set_pipeline(config)
    return bare


def _replications(controller: P4RuntimeClient) -> list:
    """BMv2 keeps clone sessions and groups when a pipeline is set: delete what other tests left."""
    sessions, groups = p4runtime.Entity(), p4runtime.Entity()
    sessions.packet_replication_engine_entry.clone_session_entry.SetInParent()
    groups.packet_replication_engine_entry.multicast_group_entry.SetInParent()
    found = []
    for asked in (sessions, groups):
        try:
            found += controller.read(asked)
        except grpc.RpcError:
            continue
    return [p4runtime.Update(type=p4runtime.Update.DELETE, entity=entity) for entity in found]
