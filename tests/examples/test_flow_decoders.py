"""Decoders of flow records: examples of the RFCs and of the sFlow specification, built byte by byte."""

import struct
from ipaddress import ip_address

import pytest
from flow_records.columns import FLOW_COLUMNS, MOST_SAMPLING, read_flows
from flow_records.decoding.errors import FlowDecodeError
from flow_records.decoding.exporter import MOST_DOMAINS, Exporter
from flow_records.decoding.templated import MOST_SETS
from flow_records.decoding.templates import MOST_FIELDS, MOST_TEMPLATES

from apps.messages import MessageError
from due import RecordBatch
from sdnator.testing.query_traffic import ethernet, tcp, udp
from tests.examples.flow_datagrams import (
    EXPORT_S,
    UPTIME_MS,
    address,
    expanded_sample,
    flow_sample,
    flow_set,
    ipfix,
    ipfix_options,
    netflow5,
    netflow9,
    raw_header,
    row,
    sflow5,
    structure,
    template,
    v5_record,
    v9_options,
)

EXPORT_US = EXPORT_S * 1_000_000
RECEIVED_US = EXPORT_US + 250_000
BASIC = ((8, 4), (12, 4), (15, 4), (2, 4), (1, 4))
"""Source, destination, next hop, packets, bytes: the template of both RFCs' examples."""


def decoded(exporter, datagram, *, port=2055, now=0.0):
    """The records of a datagram as one list; what any batch of ours must be is checked on the way."""
    found = exporter.decode(datagram, port, now, RECEIVED_US)
    for batch in found:
        assert read_flows(batch) == batch
        assert batch.columns == tuple(FLOW_COLUMNS)
    return [row(batch, place) for batch in found for place in range(len(batch))]


def basic(src, dst, packets, size):
    """A record of BASIC."""
    hosts = b"".join(ip_address(text).packed for text in (src, dst, "192.168.1.1"))
    return hosts + struct.pack("!II", packets, size)


def refused(exporter, datagram, cause, **how):
    with pytest.raises(FlowDecodeError) as found:
        decoded(exporter, datagram, **how)
    assert found.value.cause == cause
    assert exporter.health()["refused_by_cause"][cause] >= 1


def test_records_of_netflow_5_have_all_columns():
    first, second = decoded(
        Exporter(),
        netflow5(
            v5_record(),
            v5_record("203.0.113.7", protocol=1, sport=0, dport=0x0301, flags=0),
            seconds=EXPORT_S,
        ),
    )
    assert first == {
        "time_us": EXPORT_US,
        "first_us": EXPORT_US - 5_000_000,
        "last_us": EXPORT_US - 1_000_000,
        "ip_version": 4,
        "ip_src_hi": 0,
        "ip_src_lo": address("192.0.2.1")[1],
        "ip_dst_hi": 0,
        "ip_dst_lo": address("198.51.100.1")[1],
        "ip_proto": 6,
        "src_port": 40_000,
        "dst_port": 443,
        "tcp_flags": 0x12,
        "icmp_type": -1,
        "icmp_code": -1,
        "tos": 0x20,
        "packets": 3,
        "bytes": 180,
        "sampling": 1,
        "input": 3,
        "output": 4,
        "vlan": -1,
        "eth_src": 0,
        "eth_dst": 0,
    }
    assert (second["src_port"], second["dst_port"]) == (-1, -1)
    assert (second["icmp_type"], second["icmp_code"]) == (3, 1)


@pytest.mark.parametrize("told", [0, 100])
def test_sampling_of_netflow_5_multiplies_counts(told):
    """By the header's rate (its upper two bits are the mode), or by that of the settings where it has none."""
    (flow,) = decoded(Exporter(sampling=10), netflow5(v5_record(), sampling=0x4000 | told))
    rate = told or 10
    assert (flow["packets"], flow["bytes"], flow["sampling"]) == (3 * rate, 180 * rate, rate)


def test_the_clock_of_an_exporter_may_wrap():
    """Its uptime has 32 bits of milliseconds: a flow may begin before it starts again from zero."""
    (flow,) = decoded(Exporter(), netflow5(v5_record(first=2**32 - 2_000, last=500), uptime=1_000))
    assert flow["first_us"] == EXPORT_US - 3_000_000
    assert flow["last_us"] == EXPORT_US - 500_000


def test_the_example_of_rfc_3954():
    """A template, and the three flows that use it."""
    flows = (
        basic("198.168.1.12", "10.5.12.254", 5009, 5_344_385)
        + basic("192.168.1.27", "10.5.12.23", 748, 388_934)
        + basic("192.168.1.56", "10.5.12.65", 5, 6534)
    )
    sets = (flow_set(0, template(256, *BASIC)), flow_set(256, flows))
    assert (len(sets[0]), len(sets[1])) == (28, 64)
    found = decoded(Exporter(), netflow9(*sets))
    assert [(flow["ip_src_lo"], flow["packets"], flow["bytes"]) for flow in found] == [
        (address("198.168.1.12")[1], 5009, 5_344_385),
        (address("192.168.1.27")[1], 748, 388_934),
        (address("192.168.1.56")[1], 5, 6534),
    ]
    assert {(flow["time_us"], flow["first_us"], flow["last_us"]) for flow in found} == {(EXPORT_US,) * 3}


def test_the_options_of_rfc_3954_are_no_flows():
    """Line card 1 and 2 with their counters; a scope's number must not be taken for an element's."""
    exporter = Exporter()
    options = flow_set(1, v9_options(257, [(3, 2)], [(41, 2), (42, 2)]))
    data = flow_set(257, struct.pack("!HHHHHH", 1, 345, 10_201, 2, 690, 20_402))
    assert len(data) == 16
    assert decoded(exporter, netflow9(options, data)) == []
    health = exporter.health()
    assert (health["not_flows"], health["without_template"], health["templates"]) == (0, 0, 1)


def test_the_example_of_rfc_7011():
    """The template set, a template with an enterprise's element, the data set and the options of appendix A."""
    flows = (
        basic("192.0.2.12", "192.0.2.254", 5009, 5_344_385)
        + basic("192.0.2.27", "192.0.2.23", 748, 388_934)
        + basic("192.0.2.56", "192.0.2.65", 5, 6534)
    )
    enterprise = template(257, (8, 4), (12, 4), (15, 4), (2, 4), (6871, 4, 12_345))
    own = b"".join(ip_address(text).packed for text in ("192.0.2.9", "192.0.2.10", "192.0.2.1"))
    message = ipfix(
        flow_set(2, template(256, *BASIC)),
        flow_set(2, enterprise),
        flow_set(256, flows),
        flow_set(257, own + struct.pack("!II", 7, 99)),
        flow_set(3, ipfix_options(258, 1, (141, 4), (41, 2), (42, 2))),
        flow_set(258, struct.pack("!IHHIHH", 1, 345, 10_201, 2, 690, 20_402)),
    )
    found = decoded(Exporter(), message)
    assert [(flow["packets"], flow["bytes"]) for flow in found] == [
        (5009, 5_344_385),
        (748, 388_934),
        (5, 6534),
        (7, 0),
    ]
    assert found[3]["ip_dst_lo"] == address("192.0.2.10")[1]


@pytest.mark.parametrize("length", [0, 5, 254, 255, 1000])
def test_fields_of_variable_length_are_stepped_over(length):
    """RFC 7011, section 7: a length of one byte, or 255 and two more."""
    text = bytes([length]) if length < 255 else b"\xff" + struct.pack("!H", length)
    record = ip_address("192.0.2.1").packed + text + bytes(length) + ip_address("192.0.2.2").packed + b"\x2a"
    message = ipfix(
        flow_set(2, template(300, (8, 4), (82, 0xFFFF), (12, 4), (2, 1))), flow_set(300, record * 3)
    )
    found = decoded(Exporter(), message)
    assert [(flow["ip_src_lo"], flow["ip_dst_lo"], flow["packets"]) for flow in found] == [
        (address("192.0.2.1")[1], address("192.0.2.2")[1], 42)
    ] * 3


def test_a_field_of_variable_length_that_leaves_its_set_refuses_the_message():
    record = ip_address("192.0.2.1").packed + b"\xff\xff\xff" + bytes(40)
    message = ipfix(flow_set(2, template(300, (8, 4), (82, 0xFFFF))), flow_set(300, record))
    refused(Exporter(), message, "length")


def test_ipv6_and_records_of_both_versions():
    """A record may have fields for both, those of one all zero."""
    fields = ((8, 4), (12, 4), (27, 16), (28, 16), (4, 1))
    four = ip_address("192.0.2.1").packed + ip_address("192.0.2.2").packed + bytes(32) + b"\x06"
    six = bytes(8) + ip_address("2001:db8::1").packed + ip_address("2001:db8::2").packed + b"\x11"
    found = decoded(Exporter(), netflow9(flow_set(0, template(260, *fields)), flow_set(260, four + six)))
    assert [flow["ip_version"] for flow in found] == [4, 6]
    assert (found[0]["ip_src_hi"], found[0]["ip_src_lo"]) == address("192.0.2.1")
    assert (found[1]["ip_src_hi"], found[1]["ip_src_lo"]) == address("2001:db8::1")
    assert (found[1]["ip_dst_hi"], found[1]["ip_dst_lo"]) == address("2001:db8::2")


@pytest.mark.parametrize(
    ("elements", "width", "values"),
    [
        ((150, 151), 4, (EXPORT_S - 9, EXPORT_S - 4)),
        ((152, 153), 8, ((EXPORT_S - 9) * 1000, (EXPORT_S - 4) * 1000)),
        ((154, 155), 8, ((EXPORT_S - 9 + 2_208_988_800) << 32, (EXPORT_S - 4 + 2_208_988_800) << 32)),
        ((156, 157), 8, ((EXPORT_S - 9 + 2_208_988_800) << 32, (EXPORT_S - 4 + 2_208_988_800) << 32)),
        ((158, 159), 4, (9_000_000, 4_000_000)),
        ((22, 21), 4, (UPTIME_MS - 9_000, UPTIME_MS - 4_000)),
    ],
)
def test_times_in_every_notation(elements, width, values):
    """Seconds, milliseconds, NTP's fractions, microseconds before the export, milliseconds of uptime."""
    fields = ((8, 4), (elements[0], width), (elements[1], width))
    record = bytes([192, 0, 2, 1]) + b"".join(value.to_bytes(width, "big") for value in values)
    started = struct.pack("!IQ", 1, EXPORT_S * 1000 - UPTIME_MS)
    message = ipfix(
        flow_set(3, ipfix_options(400, 1, (143, 4), (160, 8))),
        flow_set(400, started),
        flow_set(2, template(300, *fields)),
        flow_set(300, record),
    )
    (flow,) = decoded(Exporter(), message)
    assert (flow["first_us"], flow["last_us"]) == (EXPORT_US - 9_000_000, EXPORT_US - 4_000_000)


def test_uptime_without_the_start_of_the_system_says_nothing():
    record = bytes([192, 0, 2, 1]) + struct.pack("!II", 5, 6)
    (flow,) = decoded(
        Exporter(), ipfix(flow_set(2, template(300, (8, 4), (22, 4), (21, 4))), flow_set(300, record))
    )
    assert (flow["first_us"], flow["last_us"]) == (EXPORT_US, EXPORT_US)


def test_numbers_may_be_shorter_and_longer_than_usual():
    """Reduced-size encoding (RFC 7011, 6.2); 16 bits of TCP flags; counters of 64 bits."""
    fields = ((8, 4), (2, 3), (1, 8), (6, 2), (7, 2), (4, 1))
    record = bytes([192, 0, 2, 1]) + b"\x01\x00\x00" + struct.pack("!QHHB", 2**63, 0x1012, 80, 6)
    (flow,) = decoded(Exporter(), netflow9(flow_set(0, template(256, *fields)), flow_set(256, record)))
    assert (flow["packets"], flow["bytes"], flow["tcp_flags"], flow["src_port"]) == (
        65_536,
        1 << 40,
        0x12,
        80,
    )


def test_icmp_types_in_their_own_fields():
    for fields, values in ((((176, 1), (177, 1)), b"\x08\x00"), (((32, 2),), b"\x08\x00")):
        record = bytes([192, 0, 2, 1, 1]) + values + bytes([192, 0, 2, 1, 6]) + values
        sets = flow_set(2, template(256, (8, 4), (4, 1), *fields)), flow_set(256, record)
        ping, other = decoded(Exporter(), ipfix(*sets))
        assert (ping["icmp_type"], ping["icmp_code"]) == (8, 0)
        assert (other["icmp_type"], other["icmp_code"]) == (-1, -1)


V9_SAMPLED = flow_set(0, template(256, (8, 4), (2, 4)))
ONE = flow_set(256, bytes([192, 0, 2, 1]) + struct.pack("!I", 7))


def test_the_sampling_rate_of_an_interface_is_applied():
    """As softflowd tells it: options with the interface as scope."""
    options = (
        flow_set(1, v9_options(257, [(2, 4)], [(34, 4), (35, 1)])),
        flow_set(257, struct.pack("!IIB", 3, 64, 1)),
    )
    exporter = Exporter()
    (before,) = decoded(exporter, netflow9(V9_SAMPLED, ONE))
    (after,) = decoded(exporter, netflow9(*options, ONE, sequence=1))
    assert (before["packets"], after["packets"], after["sampling"]) == (7, 7 * 64, 64)


def test_records_name_the_sampler_that_chose_them():
    """As Cisco's routers do (elements 48 and 50): each has its rate, unknown ones that of the settings."""
    options = flow_set(1, v9_options(257, [(1, 4)], [(48, 1), (49, 1), (50, 4)]))
    samplers = flow_set(257, struct.pack("!IBBIIBBI", 0, 1, 2, 100, 0, 2, 2, 1000))
    flows = flow_set(0, template(256, (8, 4), (2, 4), (48, 1)))
    records = b"".join(bytes([192, 0, 2, 1]) + struct.pack("!IB", 7, name) for name in (1, 2, 3))
    found = decoded(Exporter(sampling=5), netflow9(options, samplers, flows, flow_set(256, records)))
    assert [flow["packets"] for flow in found] == [700, 7000, 35]


@pytest.mark.parametrize(
    ("fields", "values", "rate"),
    [
        (((302, 4), (305, 4), (306, 4)), (9, 1, 99), 100),
        (((302, 4), (305, 4), (306, 4)), (9, 10, 990), 100),
        (((302, 4), (309, 4), (310, 4)), (9, 1, 512), 512),
        (((302, 4), (305, 4), (306, 4)), (9, 0, 0), 1),
        (((302, 4), (309, 4), (310, 4)), (9, 1, 2**32 - 1), MOST_SAMPLING),
    ],
)
def test_sampling_rates_of_ipfix(fields, values, rate):
    """Count-based and random selection (RFC 5477); a rate that makes no sense is none, a huge one is cut."""
    options = flow_set(3, ipfix_options(257, 1, *fields)), flow_set(257, struct.pack("!III", *values))
    (flow,) = decoded(Exporter(), ipfix(*options, flow_set(2, template(256, (8, 4), (2, 4))), ONE))
    assert (flow["sampling"], flow["packets"]) == (rate, 7 * rate)


def test_data_before_its_template_is_counted_and_left_out():
    exporter = Exporter()
    assert decoded(exporter, netflow9(ONE)) == []
    assert exporter.health()["without_template"] == 1
    assert len(decoded(exporter, netflow9(V9_SAMPLED, ONE, sequence=1))) == 1


def test_templates_expire_unless_they_are_repeated():
    exporter = Exporter(lifetime_s=60)
    assert len(decoded(exporter, netflow9(V9_SAMPLED, ONE), now=0.0)) == 1
    assert len(decoded(exporter, netflow9(V9_SAMPLED, ONE, sequence=1), now=50.0)) == 1
    assert len(decoded(exporter, netflow9(ONE, sequence=2), now=110.0)) == 1
    assert decoded(exporter, netflow9(ONE, sequence=3), now=110.1) == []
    assert exporter.health()["without_template"] == 1


def test_a_template_may_be_replaced():
    exporter = Exporter()
    decoded(exporter, netflow9(V9_SAMPLED))
    other = flow_set(0, template(256, (2, 4), (8, 4)))
    data = flow_set(256, struct.pack("!I", 7) + bytes([192, 0, 2, 1]))
    (flow,) = decoded(exporter, netflow9(other, data, sequence=1))
    assert (flow["packets"], flow["ip_src_lo"]) == (7, address("192.0.2.1")[1])


def test_templates_belong_to_a_source_id_and_to_a_session():
    """NetFlow v9: to the source id, whatever the port. IPFIX: to the domain and the port."""
    exporter = Exporter()
    decoded(exporter, netflow9(V9_SAMPLED, source=1), port=1)
    assert len(decoded(exporter, netflow9(ONE, sequence=1, source=1), port=2)) == 1
    assert decoded(exporter, netflow9(ONE, source=2), port=1) == []
    decoded(exporter, ipfix(flow_set(2, template(256, (8, 4), (2, 4)))), port=1)
    assert len(decoded(exporter, ipfix(ONE), port=1)) == 1
    assert decoded(exporter, ipfix(ONE), port=2) == []


def test_a_withdrawal_over_udp_is_void():
    """RFC 7011, 8.4."""
    exporter = Exporter()
    decoded(exporter, ipfix(flow_set(2, template(256, (8, 4), (2, 4)))))
    decoded(exporter, ipfix(flow_set(2, template(256)), flow_set(3, template(257))))
    assert len(decoded(exporter, ipfix(ONE))) == 1


def test_records_about_no_ip_are_counted():
    exporter = Exporter()
    sets = flow_set(2, template(256, (56, 6), (80, 6))), flow_set(256, bytes(24))
    assert decoded(exporter, ipfix(*sets)) == []
    assert exporter.health()["not_flows"] == 2


SYN = 2
FRAME = tcp("192.0.2.1", "198.51.100.1", 40_000, 443, SYN, bytes(60))


def test_samples_of_sflow_become_flows_of_one_packet():
    found = decoded(
        Exporter(),
        sflow5(
            structure(2, bytes(40)),  # counters
            flow_sample(structure(1001, bytes(16)), raw_header(FRAME[:64], len(FRAME))),
            expanded_sample(raw_header(udp("2001:db8::1", "2001:db8::2", 53, 5353)), rate=0),
            structure(4321 << 12 | 1, b"abcd"),  # an enterprise's
        ),
    )
    assert found[0] == {
        "time_us": RECEIVED_US,
        "first_us": RECEIVED_US,
        "last_us": RECEIVED_US,
        "ip_version": 4,
        "ip_src_hi": 0,
        "ip_src_lo": address("192.0.2.1")[1],
        "ip_dst_hi": 0,
        "ip_dst_lo": address("198.51.100.1")[1],
        "ip_proto": 6,
        "src_port": 40_000,
        "dst_port": 443,
        "tcp_flags": SYN,
        "icmp_type": -1,
        "icmp_code": -1,
        "tos": 0,
        "packets": 512,
        "bytes": 512 * len(FRAME),
        "sampling": 512,
        "input": 3,
        "output": 4,
        "vlan": -1,
        "eth_src": 0x0200C0000201,
        "eth_dst": 0x0200C6336401,
    }
    assert (found[1]["ip_src_hi"], found[1]["ip_src_lo"]) == address("2001:db8::1")
    assert (found[1]["input"], found[1]["output"], found[1]["packets"]) == (70_000, 4, 1)
    assert len(found) == 2


def test_headers_of_sflow_without_ethernet_and_packets_without_headers():
    """Header protocols 11 and 12 are bare IP; formats 3 and 4 are fields alone; a token ring is left out."""
    told4 = struct.pack("!II", 70, 6) + ip_address("192.0.2.1").packed + ip_address("192.0.2.2").packed
    told4 += struct.pack("!IIII", 40_000, 443, 0x12, 0x20)
    told6 = struct.pack("!II", 80, 17) + ip_address("2001:db8::1").packed + ip_address("2001:db8::2").packed
    told6 += struct.pack("!IIII", 53, 5353, 0, 0)
    exporter = Exporter()
    found = decoded(
        exporter,
        sflow5(
            flow_sample(raw_header(FRAME[14:], protocol=11), rate=1),
            flow_sample(raw_header(udp("2001:db8::1", "2001:db8::2", 53, 5353)[14:], protocol=12), rate=1),
            flow_sample(structure(3, told4), rate=1),
            flow_sample(structure(4, told6), rate=1),
            flow_sample(raw_header(FRAME, protocol=3), rate=1),
        ),
    )
    assert [(flow["ip_version"], flow["src_port"], flow["dst_port"]) for flow in found] == [
        (4, 40_000, 443),
        (6, 53, 5353),
        (4, 40_000, 443),
        (6, 53, 5353),
    ]
    assert [found[2][name] for name in ("bytes", "tcp_flags", "tos", "packets")] == [70, 0x12, 0x20, 1]
    assert exporter.health()["not_flows"] == 1


def test_ports_that_an_icmp_error_quotes_are_not_its_own():
    quoted = FRAME[14:42]
    frame = ethernet("192.0.2.9", "192.0.2.1", 1, b"\x03\x01" + bytes(6) + quoted)
    (flow,) = decoded(Exporter(), sflow5(flow_sample(raw_header(frame), rate=1)))
    assert [flow[name] for name in ("src_port", "dst_port", "icmp_type", "icmp_code")] == [-1, -1, 3, 1]


@pytest.mark.parametrize(
    ("datagram", "cause"),
    [
        (b"", "version"),
        (b"\x00\x01" + bytes(50), "version"),
        (b"\x00\x00\x00\x04" + bytes(50), "version"),
        (netflow5(v5_record())[:20], "short"),
        (netflow5(v5_record())[:-1], "count"),
        (netflow5(v5_record()) + b"x", "count"),
        (netflow5(), "count"),
        (netflow5(*[v5_record()] * 31), "count"),
        (netflow9()[:19], "short"),
        (netflow9() + b"\x00", "short"),
        (netflow9(struct.pack("!HH", 256, 3)), "length"),
        (netflow9(struct.pack("!HH", 256, 0)), "length"),
        (netflow9(struct.pack("!HH", 256, 9) + bytes(4)), "length"),
        (netflow9(flow_set(0, template(255, (8, 4)))), "template"),
        (netflow9(flow_set(0, template(256))), "template"),
        (netflow9(flow_set(0, template(256, (8, 0)))), "template"),
        (netflow9(flow_set(0, template(256, (8, 65_535)))), "template"),
        (netflow9(flow_set(0, struct.pack("!HHHH", 256, 2, 8, 4))), "short"),
        (netflow9(flow_set(0, template(256, *[(8, 4)] * (MOST_FIELDS + 1)))), "limit"),
        (netflow9(flow_set(1, struct.pack("!HHH", 257, 3, 4) + bytes(8))), "template"),
        (netflow9(*[struct.pack("!HH", 256, 4)] * (MOST_SETS + 1)), "limit"),
        (ipfix()[:15], "short"),
        (ipfix() + b"x", "length"),
        (ipfix(flow_set(2, struct.pack("!HHHH", 256, 1, 0x8008, 4), pad=False)), "short"),
        (ipfix(flow_set(3, struct.pack("!HH", 256, 1))), "short"),
        (ipfix(flow_set(3, ipfix_options(256, 0, (141, 4)))), "template"),
        (ipfix(flow_set(3, ipfix_options(256, 2, (141, 4)))), "template"),
        (struct.pack("!II", 5, 3) + bytes(40), "version"),
        (sflow5()[:20], "short"),
        (sflow5() + b"word", "length"),
        (sflow5(flow_sample(raw_header(FRAME)))[:-4], "short"),
        (sflow5(structure(1, bytes(12))), "short"),
        (sflow5(structure(1, bytes(28) + b"\xff\xff\xff\xff")), "limit"),
    ],
)
def test_a_broken_datagram_is_refused_with_its_cause(datagram, cause):
    refused(Exporter(), datagram, cause)


def test_templates_are_limited_and_old_ones_make_room():
    exporter = Exporter(lifetime_s=60)
    for number in range(MOST_TEMPLATES):
        decoded(exporter, netflow9(flow_set(0, template(256 + number, (8, 4))), sequence=number), now=0.0)
    more = netflow9(flow_set(0, template(256 + MOST_TEMPLATES, (8, 4))))
    refused(exporter, more, "limit", now=30.0)
    decoded(exporter, more, now=61.0)
    assert exporter.health()["templates"] == 1


def test_domains_are_limited_and_silent_ones_make_room():
    """What they lost stays counted."""
    exporter = Exporter(lifetime_s=60)
    for number in range(MOST_DOMAINS):
        decoded(exporter, netflow9(source=number), now=0.0)
    decoded(exporter, netflow9(source=0, sequence=4), now=1.0)
    refused(exporter, netflow9(source=MOST_DOMAINS), "limit", now=2.0)
    decoded(exporter, netflow9(source=MOST_DOMAINS), now=62.0)
    assert exporter.health()["lost_datagrams"] == 3


def numbered(protocol, sequence, units):
    """A datagram with so many units."""
    return {
        "netflow5": lambda: netflow5(*[v5_record()] * units, sequence=sequence),
        "netflow9": lambda: netflow9(V9_SAMPLED, sequence=sequence),
        "ipfix": lambda: ipfix(
            flow_set(2, template(256, (8, 4), (2, 4))),
            flow_set(256, bytes(8 * units)),
            sequence=sequence,
        ),
        "sflow5": lambda: sflow5(sequence=sequence),
    }[protocol]()


@pytest.mark.parametrize("protocol", ["netflow5", "netflow9", "ipfix", "sflow5"])
def test_gaps_in_sequence_numbers_are_losses(protocol):
    """Of records where these are numbered, else of datagrams; numbers wrap; who was overtaken was not lost."""
    exporter = Exporter()
    units = 2 if protocol in ("netflow5", "ipfix") else 1
    lost = "lost_records" if units == 2 else "lost_datagrams"

    def hear(step):
        decoded(exporter, numbered(protocol, (2**32 - 2 * units + step * units) % 2**32, units))
        return exporter.health()[lost]

    assert [hear(step) for step in (0, 1, 2, 3)] == [0, 0, 0, 0]
    assert hear(7) == 3 * units
    assert hear(5) == 2 * units
    assert hear(8) == 2 * units
    health = exporter.health()
    assert (health["reordered"], health["restarts"]) == (1, 0)
    assert sum(health[name] for name in ("lost_records", "lost_datagrams")) == 2 * units


def test_an_exporter_that_begins_anew_has_lost_nothing():
    exporter = Exporter()
    decoded(exporter, netflow9(sequence=500_000))
    decoded(exporter, netflow9(sequence=0))
    decoded(exporter, netflow9(sequence=1))
    health = exporter.health()
    assert (health["lost_datagrams"], health["restarts"]) == (0, 1)


def test_records_of_an_unknown_template_say_nothing_about_loss():
    """IPFIX numbers records: how many were in a set without template, nobody knows."""
    exporter = Exporter()
    decoded(exporter, ipfix(flow_set(999, bytes(40)), sequence=0))
    decoded(exporter, ipfix(sequence=5))
    decoded(exporter, ipfix(sequence=6))
    assert exporter.health()["lost_records"] == 1


def test_health_tells_a_clock_that_is_off():
    exporter = Exporter()
    decoded(exporter, netflow9(seconds=EXPORT_S - 3600))
    assert exporter.health()["clock_off_s"] == 3600.2
    assert exporter.health()["protocols"] == ["netflow9"]


def test_received_flows_are_checked():
    """What `read_flows` refuses: missing columns, numbers out of range."""
    (batch,) = Exporter().decode(netflow5(v5_record()), 1, 0.0, RECEIVED_US)
    with pytest.raises(MessageError):
        read_flows({"packets": 1})
    with pytest.raises(MessageError):
        read_flows(RecordBatch({name: batch[name] for name in batch if name != "packets"}))
    for name, wrong in (("dst_port", 70_000), ("sampling", 0), ("first_us", -1), ("bytes", 2**63)):
        column = batch[name].copy()
        column[0] = wrong
        with pytest.raises(MessageError):
            read_flows(RecordBatch({**batch, name: column}))
