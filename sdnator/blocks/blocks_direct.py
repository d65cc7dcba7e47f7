"""`sdnator blocks panic` directly on a switch, over P4Runtime, without a running pipeline.

Only the primary controller may write.  This learns the primary's election id from the switch, becomes primary
with the next higher one, deletes, and disconnects.  A running controller becomes primary again at once, and
restores its state from Data Archives, where everything has been lifted before.
"""

import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final

from sdnator.errors import PipelineError

if TYPE_CHECKING:
    from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
    from p4rt import ChannelSecurity

BLOCK_TABLES: Final = ("ingress.block_src", "ingress.block_mac", "ingress.block")
LIMIT_TABLES: Final = ("ingress.limit", "ingress.limit_spared", "ingress.limit_over")
_PROTECT: Final = "ingress.protect"
_SECONDS: Final = 10.0
_BATCH: Final = 500
_ROUNDS: Final = 3
_LOW: Final = (1 << 64) - 1

Service = tuple[str, int]
"""Address and port of a guarded service."""


def lift_in_switch(
    address: str,
    device_id: int,
    guards: Sequence[Service] = (),
    security: "ChannelSecurity | None" = None,
) -> int:
    """Delete every entry that drops traffic, and these guards; returns the number of deleted entries.

    Raises `PipelineError` if the switch does not answer or refuses.
    """
    import grpc

    from apps.p4runtime_ctrl.errors import ControllerError
    from p4rt import P4RuntimeStub, open_channel

    options = [("grpc.max_receive_message_length", -1)]
    with open_channel(address, security, options) as channel:
        stub = P4RuntimeStub(channel)
        try:
            program = _program(stub, device_id)
            with _Primary(stub, device_id) as election_id:
                return _clear(
                    stub, device_id, election_id, lambda: _entries(stub, device_id, program, guards)
                )
        except grpc.RpcError as error:
            raise PipelineError(f"switch at {address}: {error.code().name}: {error.details()}") from None
        except ControllerError as error:
            raise PipelineError(f"switch at {address}: {error}") from None


def _clear(stub: Any, device_id: int, election_id: Any, entries: Callable[[], Iterator[Any]]) -> int:
    """Delete until nothing is left: an entry that another controller deletes meanwhile fails its batch."""
    found = doomed = list(entries())
    for _ in range(_ROUNDS):
        for start in range(0, len(doomed), _BATCH):
            _delete(stub, device_id, election_id, doomed[start : start + _BATCH])
        doomed = list(entries()) if doomed else []
    if doomed:
        raise PipelineError(
            f"the switch still has {len(doomed)} of {len(found)} entries; see `sdnator tables`"
        )
    return len(found)


class _Primary:
    """Be the primary controller while the context lasts."""

    def __init__(self, stub: Any, device_id: int) -> None:
        self._device_id = device_id
        self._requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._call = stub.StreamChannel(iter(self._requests.get, None))
        self._reader = threading.Thread(target=self._read, daemon=True)

    def __enter__(self) -> Any:
        self._reader.start()
        claimed = 1
        try:
            for _ in range(5):
                primary, highest = self._claim(claimed)
                if primary:
                    return _election_id(claimed)
                claimed = max(highest, claimed) + 1
        except BaseException:
            self._leave()
            raise
        self._leave()
        raise PipelineError("the switch has another primary controller that stays primary; stop it first")

    def __exit__(self, *_: object) -> None:
        self._leave()

    def _claim(self, number: int) -> tuple[bool, int]:
        """Whether this client is primary, and the highest election id that the switch has seen."""
        from p4rt import p4runtime

        request = p4runtime.StreamMessageRequest()
        request.arbitration.device_id = self._device_id
        request.arbitration.election_id.CopyFrom(_election_id(number))
        self._requests.put(request)
        while True:
            try:
                said = self._answers.get(timeout=_SECONDS)
            except queue.Empty:
                raise PipelineError("the switch does not say which controller is primary") from None
            if isinstance(said, Exception):
                raise said
            if said.WhichOneof("update") == "arbitration":
                answer = said.arbitration
                return answer.status.code == 0, answer.election_id.high << 64 | answer.election_id.low

    def _read(self) -> None:
        import grpc

        try:
            for message in self._call:
                self._answers.put(message)
        except grpc.RpcError as error:
            self._answers.put(error)

    def _leave(self) -> None:
        self._requests.put(None)
        self._call.cancel()
        self._reader.join(_SECONDS)


def _election_id(number: int) -> Any:
    from p4rt import p4runtime

    return p4runtime.Uint128(high=number >> 64, low=number & _LOW)


def _program(stub: Any, device_id: int) -> "ProgramInfo":
    from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
    from p4rt import p4runtime

    request = p4runtime.GetForwardingPipelineConfigRequest(
        device_id=device_id,
        response_type=p4runtime.GetForwardingPipelineConfigRequest.P4INFO_AND_COOKIE,
    )
    return ProgramInfo(stub.GetForwardingPipelineConfig(request, timeout=_SECONDS).config.p4info)


def _entries(stub: Any, device_id: int, program: "ProgramInfo", guards: Sequence[Service]) -> Iterator[Any]:
    """Entries to delete."""
    from apps.p4runtime_ctrl.state.guard import release
    from p4rt import p4runtime

    for name in (*BLOCK_TABLES, *LIMIT_TABLES):
        if name not in program.names:  # a program of an earlier version
            continue
        request = p4runtime.ReadRequest(device_id=device_id)
        request.entities.add().table_entry.table_id = program.table(name).id
        for reply in stub.Read(request, timeout=_SECONDS):
            yield from (_bare(entity.table_entry) for entity in reply.entities)
    held = set()
    request = p4runtime.ReadRequest(device_id=device_id)
    request.entities.add().table_entry.table_id = program.table(_PROTECT).id
    for reply in stub.Read(request, timeout=_SECONDS):
        held |= {_match_of(entity.table_entry) for entity in reply.entities}
    for guard in guards:
        entry = release(program, guard, last_of_host=False)[0].entry
        if _match_of(entry) in held:
            yield _bare(entry)


def _bare(entry: Any) -> Any:
    """What names an entry: table, match and priority."""
    from p4rt import p4runtime

    return p4runtime.TableEntry(table_id=entry.table_id, match=entry.match, priority=entry.priority)


def _match_of(entry: Any) -> tuple[tuple[int, bytes], ...]:
    return tuple(sorted((field.field_id, field.exact.value) for field in entry.match))


def _delete(stub: Any, device_id: int, election_id: Any, entries: Sequence[Any]) -> None:
    import grpc

    from p4rt import p4runtime

    request = p4runtime.WriteRequest(device_id=device_id, election_id=election_id)
    for entry in entries:
        request.updates.add(type=p4runtime.Update.DELETE).entity.table_entry.CopyFrom(entry)
    try:
        stub.Write(request, timeout=_SECONDS)
    except grpc.RpcError as error:
        if (
            error.code() != grpc.StatusCode.UNKNOWN
        ):  # otherwise some of the batch failed: the next round reads again
            raise
