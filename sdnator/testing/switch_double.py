"""The real embedded switch in this process: its gRPC server, its packet loop, ports in memory."""

import itertools
import os
from collections.abc import Iterable, Mapping
from typing import Self

from dataplane.compiler.c_machine import CMachine
from dataplane.compiler.machine import MachineMaker
from dataplane.p4runtime.device import Device
from dataplane.p4runtime.listening import default_address
from dataplane.p4runtime.server import P4RuntimeServer
from dataplane.p4runtime.trust import TrustedPrograms
from dataplane.packet_loop import PacketClock, PacketLoop
from dataplane.ports.port import MemoryPort, Port
from sdnator.testing.waiting import wait_for

DEVICE_ID = 1
_NUMBERS = itertools.count()


class SwitchDouble:
    """A running switch, P4Runtime device 1; a context manager that stops it.

        with SwitchDouble() as switch, P4RuntimeClient(switch.address) as client:
            client.arbitrate()
            client.set_pipeline(program_config(find().bmv2_json.with_suffix("")))
            switch.memory[1].inject(frame)
            (forwarded,) = switch.sent(2, 1)

    Args:
        ports: port number to port; None: MemoryPorts 1, 2 and 3.
        driven: time comes with the frames, as in a replay, instead of from this machine's clock.
        maker: what turns programs into something that runs.
        queue: packet-ins that wait for a slow controller before more are dropped and counted.
        roles: that controllers may claim beside the default one.
        programs: which may be loaded; None: the product's own only.

    The server listens on a Unix socket that only its user can reach.
    """

    def __init__(
        self,
        *,
        ports: Mapping[int, Port] | None = None,
        driven: bool = False,
        maker: MachineMaker = CMachine,
        queue: int = 4096,
        roles: Iterable[str] = ("guard",),
        programs: TrustedPrograms | None = None,
    ) -> None:
        self.memory = {number: MemoryPort() for number in (1, 2, 3)}
        """The ports, where none were given: `inject` frames, take what was sent from `outgoing`."""
        self.ports: Mapping[int, Port] = self.memory if ports is None else ports
        self.clock = PacketClock(driven=driven)
        self.device = Device(
            DEVICE_ID,
            maker=maker,
            queue=queue,
            ports=self.ports,
            clock=self.clock.now,
            programs=programs or TrustedPrograms(),
            roles=roles,
        )
        self.server = P4RuntimeServer(
            self.device, default_address(f"double-{os.getpid()}-{next(_NUMBERS)}.sock")
        )
        self.loop = PacketLoop(self.device, self.ports, self.clock)
        self.loop.start()
        self.server.start()
        self.address = self.server.address
        """Of its P4Runtime server, unix:/PATH."""

    def sent(self, port: int, count: int, *, seconds: float = 30.0) -> list[bytes]:
        """Take the next frames that the switch sent through a port in memory.

        Args:
            port: 1, 2 or 3.
            count: how many.
            seconds: how long to wait for them.

        Returns:
            The frames, in the order in which they left.

        Raises:
            TookTooLong: fewer came.
        """
        outgoing = self.memory[port].outgoing
        wait_for(
            lambda: len(outgoing) >= count,
            seconds,
            lambda: f"port {port} sent {len(outgoing)} of {count} frames",
        )
        return [outgoing.popleft() for _ in range(count)]

    def close(self) -> None:
        """Stop serving and forwarding."""
        self.server.stop()
        self.loop.stop()
        self.device.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
