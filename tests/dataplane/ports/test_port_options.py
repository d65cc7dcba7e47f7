"""Ports on the command line: what is meant is opened, what is wrong is said."""

import pytest

from dataplane.ports.capture_port import CapturePort
from dataplane.ports.pcap_port import PcapPort
from dataplane.ports.port import NullPort, PortError
from dataplane.ports.port_options import captures, open_ports, parse


def test_each_kind_is_opened(tmp_path):
    wanted = ["1=null", f"2=capture:{tmp_path}/s", f"3=pcap:,{tmp_path}/out.pcap"]
    ports = open_ports(wanted, 510, lambda: 0)
    assert [type(ports[n]) for n in (1, 2, 3)] == [NullPort, CapturePort, PcapPort]
    for port in ports.values():
        port.close()


@pytest.mark.parametrize(
    "option",
    [
        "",
        "1",
        "x=null",
        "=null",
        "511=null",
        "510=null",
        "1=",
        "1=null:x",
        "1=capture",
        "1=pcap:",
        "1=tap:x",
        "²=null",
    ],
)
def test_what_is_no_port_is_refused(option):
    with pytest.raises(PortError, match="port"):
        open_ports([option], 510, lambda: 0)


def test_a_number_given_twice_is_refused():
    with pytest.raises(PortError, match="twice"):
        open_ports(["1=null", "1=null"], 510, lambda: 0)


def test_ports_opened_before_one_that_fails_are_closed(tmp_path):
    with pytest.raises(PortError, match="cannot read"):
        open_ports([f"1=capture:{tmp_path}/s", f"2=pcap:{tmp_path}/none"], 510, lambda: 0)
    assert not (tmp_path / "s").exists()


def test_captures_drive_the_clock():
    assert captures(["1=null", "2=pcap:x"])
    assert captures(["1=capture:/x"])
    assert not captures(["1=null", "2=veth:capture0"])
    assert parse("7=veth:eth0", 510) == (7, "veth", "eth0")
