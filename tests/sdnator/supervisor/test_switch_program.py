"""A switch comes back as the same one: where it was, with its clock going on."""

import stat
import time
from contextlib import ExitStack
from pathlib import Path

from sdnator.supervisor.switch_program import SwitchProgram, socket_address


def test_the_embedded_switch_keeps_address_and_clock(tmp_path):
    switch = SwitchProgram(
        "embedded", name="switch", logs=tmp_path, ports={1: "null"}, address=f"unix:{tmp_path}/s.sock"
    )
    said = []
    for _ in range(2):
        child = switch.start()
        try:
            child.wait_ready()
            said.append((switch.address, switch.base_us, child.ready()["base_us"]))
        finally:
            child.stop()
    assert said[0] == said[1]
    assert said[0][0] == f"unix:{tmp_path}/s.sock"


def test_a_spare_takes_the_place_of_a_switch_that_died(tmp_path):
    switch = SwitchProgram(
        "embedded", name="switch", logs=tmp_path, ports={1: "null"}, address=f"unix:{tmp_path}/s.sock"
    )
    first = switch.start()
    try:
        first.wait_ready()
        base_us = switch.base_us
        switch.prepare()
        switch.prepare()
        first.kill()
        first.close()
        second = switch.start()
        try:
            said = second.wait_ready()
            assert second.waits
            assert (said["grpc"], switch.base_us) == (f"unix:{tmp_path}/s.sock", base_us)
        finally:
            second.stop()
    finally:
        first.close()


def test_a_spare_that_died_is_no_hindrance(tmp_path):
    switch = SwitchProgram(
        "embedded", name="switch", logs=tmp_path, ports={1: "null"}, options=("--queue", "x")
    )
    switch.prepare()
    while switch._spare.ended() is None:
        time.sleep(0.01)
    switch.prepare()
    switch.prepare()
    assert switch._spare is None, "it is not started again and again"
    child = switch.start()
    assert not child.waits
    child.close()
    switch.discard()


def test_a_long_path_has_its_socket_in_a_short_folder_of_its_own(tmp_path):
    with ExitStack() as stack:
        assert socket_address(tmp_path, "s1", stack) == f"unix:{tmp_path}/switch-s1.sock"
        short = Path(socket_address(tmp_path / ("x" * 90), "s1", stack).removeprefix("unix:"))
        assert len(str(short)) < 100
        assert stat.S_IMODE(short.parent.stat().st_mode) == 0o700
    assert not short.parent.exists()
