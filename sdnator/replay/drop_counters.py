"""How many packets a switch's blocks and rate limits have dropped, read through P4Runtime beside its controller.

A switch behind an interface gives no verdicts on frames, but its counters show drops; reading needs no arbitration.
"""

from typing import Any, Self

import grpc

from p4rt import ChannelSecurity, P4RuntimeStub, open_channel, p4runtime
from sdnator.errors import PipelineError

BLOCK_TABLES = ("ingress.block", "ingress.block_src", "ingress.block_mac", "ingress.limit_over")
_SECONDS = 10.0


class DropCounters:
    """The drops of one switch since this object was made; close it, or use it as a context manager.

    Args:
        address: HOST:PORT of the switch's P4Runtime server.
        device_id: its P4Runtime device id.
        security: how the channel to it is secured; None: by a Unix socket only.

    Raises:
        PipelineError: from all methods, if the switch does not answer.
    """

    def __init__(self, address: str, device_id: int, security: ChannelSecurity | None = None) -> None:
        self._address = address
        self._device_id = device_id
        self._channel = open_channel(address, security)
        self._stub = P4RuntimeStub(self._channel)
        self._request: Any = None
        self._seen: dict[bytes, int] = {}
        self._dropped = 0
        self.dropped()
        self._dropped = 0

    def dropped(self) -> int:
        """Packets dropped so far; those of an entry that was removed stay counted as last read."""
        found = self._read()
        for entry, packets in found.items():
            before = self._seen.get(entry, 0)
            # fewer than before: the entry was deleted and inserted again
            self._dropped += packets - before if packets >= before else packets
        self._seen = found
        return self._dropped

    def _read(self) -> dict[bytes, int]:
        try:
            if self._request is None:
                self._request = self._block_entries()
            replies = list(self._stub.Read(self._request, timeout=_SECONDS))
        except grpc.RpcError as error:
            raise PipelineError(
                f"drop counters of the switch at {self._address}: {error.code().name}: {error.details()}"
            ) from None
        found = {}
        for reply in replies:
            for entity in reply.entities:
                entry = entity.table_entry
                packets = int(entry.counter_data.packet_count)
                entry.ClearField("counter_data")
                entry.ClearField("time_since_last_hit")
                found[entry.SerializeToString(deterministic=True)] = packets
        return found

    def _block_entries(self) -> Any:
        wanted = p4runtime.GetForwardingPipelineConfigRequest(
            device_id=self._device_id,
            response_type=p4runtime.GetForwardingPipelineConfigRequest.P4INFO_AND_COOKIE,
        )
        tables = self._stub.GetForwardingPipelineConfig(wanted, timeout=_SECONDS).config.p4info.tables
        request = p4runtime.ReadRequest(device_id=self._device_id)
        for table in tables:
            if table.preamble.name in BLOCK_TABLES:
                entry = request.entities.add().table_entry
                entry.table_id = table.preamble.id
                entry.counter_data.SetInParent()
        return request

    def close(self) -> None:
        self._channel.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
