"""The switch with what the product writes: entries of all eleven queries as adapter and controller make them.

Real processes write them into a real switch, once; they are read back by P4Runtime, so that `switch_pipeline` can
run the program with them alone.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from apps.sonata_adapter.query.catalogue import PAPER
from dataplane.p4runtime.schema import bind
from dataplane.p4runtime.table_codec import TableCodec
from dataplane.v1model.switch import Replica, Switch
from dataplane.v1model.tree import Program
from p4rt import p4runtime
from sdnator.testing.controller_run import BASE_US, ControllerRun, Heard
from sdnator.testing.p4runtime_client import P4RuntimeClient
from sdnator.testing.product_program import program as product
from sdnator.testing.waiting import wait_for

_PATIENCE_S = 60.0


def product_switch(program: Program) -> Switch:
    """The program with the product's entries for eleven queries, and wires."""
    switch = Switch(program)
    switch.set_clone_session(1, [Replica(510, 1)])
    codecs = {number: TableCodec(table) for number, table in bind(product().message, program).tables.items()}
    with tempfile.TemporaryDirectory(prefix="sdnator-bench-") as folder:
        for message in _written(Path(folder)):
            codec = codecs[message.table_id]
            table = switch.tables[codec.name]
            if not message.is_default_action:
                table.insert(codec.entry(message))
            elif not table.spec.default_is_const:
                table.set_default(*codec.action(message.action, default=True))
    return switch


def _written(folder: Path) -> Iterator[Any]:
    """TableEntry messages, default actions too, of a switch that serves all eleven queries."""
    with ControllerRun(folder, target="embedded") as stage:
        stage.run("apps.sonata_adapter.service", {"base_us": {"s1": BASE_US}})
        observer = stage.engine("observer")
        states = Heard(observer, "network.switch.p4runtime_ctrl.s1")
        health = Heard(observer, "due.health.sonata_adapter")
        stage.controller()
        for name in PAPER:
            observer.observe(f"network.traffic_query.sonata.{name}").subscribe(lambda _item: None)

        def settled() -> bool:
            told = states.values("network.switch")
            bits = health.values("health")[-1]["app"]["bits"] if health.values("health") else 0
            return bits >= len(PAPER) and bool(told) and len(told[-1]["telemetry"]) == bits

        wait_for(settled, _PATIENCE_S, stage.log)
        entries, defaults = p4runtime.Entity(), p4runtime.Entity()
        entries.table_entry.SetInParent()
        defaults.table_entry.is_default_action = True
        with P4RuntimeClient(stage.target.address, election_id=None) as client:
            for entity in client.read(entries, defaults):
                yield entity.table_entry
