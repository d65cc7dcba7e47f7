"""BMv2 as a part: `python -m sdnator.supervisor.bmv2_program --grpc 127.0.0.1:0 --port 1=veth0`.

Starts simple_switch_grpc, prints the ready line with its address, and checks at intervals that BMv2 answers over P4Runtime.
Ends with exit code 1 when BMv2 has ended or no longer answers.
"""

import argparse
import json
import os
import signal
import sys
import time
from collections.abc import Sequence

import grpc

from dataplane.bmv2 import Bmv2, Bmv2Error
from due.drivers.embedded_redis import die_with_parent
from p4rt import INSECURE, P4RuntimeStub, open_channel, p4runtime

_ASK_SECONDS = 1.0
_HUNG_SECONDS = 10.0


def main(argv: Sequence[str] | None = None) -> int:
    """Run until a signal comes or BMv2 ends; returns the exit code."""
    arguments = _options().parse_args(argv)
    parent = int(os.environ.pop("DUE_PARENT", "0")) or os.getppid()
    die_with_parent(signal.SIGTERM)
    came: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda got, _frame: came.append(got))
    if os.getppid() != parent:
        return 1
    interfaces = {int(number): name for number, _, name in (one.partition("=") for one in arguments.port)}
    try:
        with Bmv2(interfaces, device_id=arguments.device_id, grpc=arguments.grpc) as switch:
            print(json.dumps({"ready": True, "grpc": switch.address, "pid": os.getpid()}), flush=True)
            return _watch(switch, came, arguments.heartbeat_fd)
    except Bmv2Error as error:
        print(f"bmv2: {error}", file=sys.stderr)
        return 1


def _options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m sdnator.supervisor.bmv2_program", description=__doc__)
    parser.add_argument("--grpc", default="127.0.0.1:0", metavar="HOST:PORT")
    parser.add_argument("--device-id", type=int, default=1)
    parser.add_argument("--port", action="append", default=[], metavar="N=INTERFACE")
    parser.add_argument("--heartbeat-fd", type=int, default=-1, metavar="N")
    return parser


def _watch(switch: Bmv2, came: list[int], beats: int) -> int:
    answered = time.monotonic()
    with open_channel(switch.address, INSECURE) as channel:  # it has no TLS
        stub = P4RuntimeStub(channel)
        while not came:
            switch.check()
            if beats >= 0:
                os.write(beats, b".")
            if _answers(stub):
                answered = time.monotonic()
            elif time.monotonic() - answered > _HUNG_SECONDS:
                # if we died it would get SIGTERM only, which does not end a stopped process
                os.kill(switch.pid, signal.SIGKILL)
                raise Bmv2Error(f"it has not answered for {_HUNG_SECONDS:g} s, so it was killed")
            _sleep(came)
    return 0


def _answers(stub: P4RuntimeStub) -> bool:
    """Any answer counts, even an error."""
    try:
        stub.Capabilities(p4runtime.CapabilitiesRequest(), timeout=_ASK_SECONDS)
    except grpc.RpcError as error:
        return bool(error.code() == grpc.StatusCode.UNIMPLEMENTED)
    return True


def _sleep(came: list[int]) -> None:
    until = time.monotonic() + _ASK_SECONDS
    while not came and time.monotonic() < until:
        time.sleep(0.05)


if __name__ == "__main__":
    sys.exit(main())
