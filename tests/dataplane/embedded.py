"""An embedded switch within the test process: device, ports in memory, a gRPC server on a free port."""

from collections.abc import Mapping
from typing import Self

from dataplane.device import Device
from dataplane.p4runtime_server import P4RuntimeServer
from dataplane.packet_loop import PacketClock, PacketLoop
from dataplane.ports import MemoryPort, Port
from dataplane.switch import Backend


class Embedded:
    """Ports 1, 2 and 3 are MemoryPorts unless others are given.

    driven: time comes with the frames, as in a replay
    """

    def __init__(
        self,
        *,
        ports: Mapping[int, Port] | None = None,
        driven: bool = False,
        backend: Backend = "python",
        queue: int = 4096,
    ) -> None:
        self.memory = {number: MemoryPort() for number in (1, 2, 3)}
        self.ports: Mapping[int, Port] = self.memory if ports is None else ports
        self.clock = PacketClock(driven=driven)
        self.device = Device(1, backend=backend, queue=queue, ports=self.ports, clock=self.clock.now)
        self.server = P4RuntimeServer(self.device, "127.0.0.1:0")
        self.loop = PacketLoop(self.device, self.ports, self.clock)
        self.loop.start()
        self.server.start()
        self.address = self.server.address

    def close(self) -> None:
        self.server.stop()
        self.loop.stop()
        self.device.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
