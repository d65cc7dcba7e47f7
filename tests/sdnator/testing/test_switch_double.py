"""The switch double is the real switch: it takes programs that are trusted, and forwards what its entries say."""

from pathlib import Path

import grpc
import pytest

from dataplane.p4runtime.trust import TrustedPrograms, program_hash
from sdnator.testing import EntryBuilder, P4RuntimeClient, SwitchDouble, TookTooLong
from sdnator.testing.controller_run import frame
from sdnator.testing.p4runtime_client import insert, program_config
from sdnator.testing.product_program import PROGRAM

OTHER = Path(__file__).resolve().parents[2] / "dataplane" / "programs" / "features"


def test_it_forwards_as_its_entries_say():
    """A wire from port 1 to port 2, made over gRPC; port 3 gets nothing."""
    config = program_config(PROGRAM.with_suffix(""))
    names = EntryBuilder(config.p4info)
    with SwitchDouble() as switch, P4RuntimeClient(switch.address) as client:
        assert client.arbitrate().status.code == 0
        client.set_pipeline(config)
        client.write(insert(names.entry("ingress.forward_port", {"ingress_port": 1}, "ingress.to_port", [2])))
        switch.memory[1].inject(frame(1), frame(2))
        assert switch.sent(2, 2) == [frame(1), frame(2)]
        with pytest.raises(TookTooLong, match="port 3 sent 0 of 1 frames"):
            switch.sent(3, 1, seconds=0.01)


def test_only_trusted_programs_are_loaded():
    """Another program than the product's has to be named."""
    config = program_config(OTHER)
    with SwitchDouble() as switch, P4RuntimeClient(switch.address) as client:
        client.arbitrate()
        with pytest.raises(grpc.RpcError, match="not trusted"):
            client.set_pipeline(config)
    named = TrustedPrograms([program_hash(config)])
    with SwitchDouble(programs=named) as switch, P4RuntimeClient(switch.address) as client:
        client.arbitrate()
        client.set_pipeline(config)
        assert client.get_pipeline("P4INFO_AND_COOKIE").p4info == config.p4info
