"""The queries of the Sonata paper (Gupta et al., SIGCOMM 2018, table 3) and our own, with their parameters.

A key is reported when its value *reaches* the threshold (>=), as in the queries that the authors
published.  Differences to those: a SYN-ACK is flags 0x12 (18, not 17), ssh_brute_force looks at port
22 only, and syn_flood subtracts the ACKs.  SYN, SYN-ACK and ACK look at FIN, SYN, RST and ACK only,
because real floods set ECN bits.

The queries that read payloads look at a host's packets only from the one on with which enough of them have come in
the window (`gate`): a switch counts until then, and copies nothing.
"""

from collections.abc import Callable, Mapping
from typing import Final

import msgspec

from apps.sonata_adapter.query.language import (
    ACK,
    ETHERTYPE_ARP,
    FIN,
    SYN,
    SYN_ACK,
    Query,
    arp,
    count,
    dns,
    eth,
    field,
    ip,
    length,
    payload_contains,
    port,
    tcp,
    total,
    udp,
)
from apps.sonata_adapter.query.parameters import ANY_PREFIX, Parameter, Value, levels, number, prefix, window

Values = Mapping[str, Value]


class Template(msgspec.Struct, frozen=True, kw_only=True):
    """A query with parameters that are not bound yet."""

    name: str
    meaning: str
    result: str
    """The meaning of the result's fields."""
    parameters: tuple[Parameter, ...]
    build: Callable[[Values], Query]

    def query(self, values: Values | None = None) -> Query:
        """The query with these values; other parameters have their defaults."""
        defaults = {parameter.name: parameter.default for parameter in self.parameters}
        return self.build({**defaults, **(values or {})})

    def parameter(self, name: str) -> Parameter | None:
        """The parameter of this name, or None."""
        return next((each for each in self.parameters if each.name == name), None)


def _begin(name: str, values: Values) -> Query:
    return Query(name, int(values["window"]))


def _towards(query: Query, values: Values, *, at: str = "ip.dst") -> Query:
    """Restrict the query to packets whose address `at` lies in the key's prefix `dst`."""
    prefix_text = str(values["dst"])
    return query if prefix_text == ANY_PREFIX else query.filter(field(at).within(prefix_text))


def _from(query: Query, values: Values) -> Query:
    prefix_text = str(values["src"])
    return query if prefix_text == ANY_PREFIX else query.filter(ip.src.within(prefix_text))


def _new_tcp(values: Values) -> Query:
    syns = _towards(_begin("new_tcp", values).filter(tcp.flags == SYN), values)
    return (
        syns.map(dst=ip.dst).reduce("dst", count=count()).filter(field("count") >= int(values["threshold"]))
    )


def _ssh_brute_force(values: Values) -> Query:
    ssh = _towards(_begin("ssh_brute_force", values).filter(tcp.dport == 22), values)
    tries = ssh.map(dst=ip.dst, src=ip.src, length=length).distinct()
    return tries.reduce("dst", "length", count=count()).filter(field("count") >= int(values["threshold"]))


def _superspreader(values: Values) -> Query:
    packets = _from(_begin("superspreader", values).filter(ip.version != 0), values)
    pairs = packets.map(src=ip.src, dst=ip.dst).distinct()
    return pairs.reduce("src", count=count()).filter(field("count") >= int(values["threshold"]))


def _port_scan(values: Values) -> Query:
    packets = _from(_begin("port_scan", values).filter(tcp.dport >= 0), values)
    pairs = packets.map(src=ip.src, dport=tcp.dport).distinct()
    return pairs.reduce("src", count=count()).filter(field("count") >= int(values["threshold"]))


def _ddos(values: Values) -> Query:
    packets = _towards(_begin("ddos", values).filter(ip.version != 0), values)
    pairs = packets.map(src=ip.src, dst=ip.dst).distinct()
    return pairs.reduce("dst", count=count()).filter(field("count") >= int(values["threshold"]))


def _syn_flood(values: Values) -> Query:
    packets = _begin("syn_flood", values)
    syns = _towards(packets.filter(tcp.flags == SYN), values)
    answers = _towards(packets.filter(tcp.flags == SYN_ACK), values, at="ip.src")
    acks = _towards(packets.filter(tcp.flags == ACK), values)
    joined = (
        syns.map(dst=ip.dst)
        .reduce("dst", syns=count())
        .join(answers.map(dst=ip.src).reduce("dst", syn_acks=count()), "dst", kind="outer")
        .join(acks.map(dst=ip.dst).reduce("dst", acks=count()), "dst", kind="left")
    )
    half_open = joined.map("dst", count=field("syns") + field("syn_acks") - field("acks"))
    return half_open.filter(field("count") >= int(values["threshold"]))


def _incomplete_flows(values: Values) -> Query:
    packets = _begin("incomplete_flows", values)
    syns = _towards(packets.filter(tcp.flags == SYN), values)
    ends = _towards(packets.filter(tcp.flags == FIN), values, at="ip.src")
    joined = (
        syns.map(dst=ip.dst)
        .reduce("dst", syns=count())
        .join(ends.map(dst=ip.src).reduce("dst", fins=count()), "dst", kind="left")
    )
    return joined.map("dst", count=field("syns") - field("fins")).filter(
        field("count") >= int(values["threshold"])
    )


def _slowloris(values: Values) -> Query:
    packets = _towards(_begin("slowloris", values).filter(tcp.dport >= 0), values)
    connections = packets.map(dst=ip.dst, src=ip.src, sport=tcp.sport).distinct()
    per_host = connections.reduce("dst", connections=count())
    volume = packets.map(dst=ip.dst, length=length).reduce("dst", bytes=total(field("length")))
    joined = (
        per_host.filter(field("connections") >= int(values["connections"]))
        .join(volume.filter(field("bytes") >= int(values["bytes"])), "dst")
        .filter(field("bytes") <= field("connections") * int(values["threshold"]))
    )
    return joined.map("dst", "connections", "bytes", count=field("bytes") // field("connections"))


def _dns_tunnel(values: Values) -> Query:
    packets = _begin("dns_tunnel", values).gate(udp.sport == 53, int(values["gate"]), dst=ip.dst)
    answers = _towards(packets.filter((udp.sport == 53) & (dns.response == 1)), values)
    names = answers.map(dst=ip.dst, name=dns.name).distinct().reduce("dst", names=count())
    syns = _towards(packets.filter(tcp.flags == SYN), values, at="ip.src")
    contacts = syns.map(dst=ip.src, peer=ip.dst).distinct().reduce("dst", contacts=count())
    joined = names.join(contacts, "dst", kind="left")
    unused = joined.map("dst", count=field("names") - field("contacts"))
    return unused.filter(field("count") >= int(values["threshold"]))


def _zorro(values: Values) -> Query:
    packets = _begin("zorro", values).gate(tcp.dport == 23, int(values["gate"]), dst=ip.dst)
    telnet = _towards(packets.filter(tcp.dport == 23), values)
    guesses = telnet.map(dst=ip.dst, length=length).reduce("dst", "length", similar=count())
    guessed = guesses.filter(field("similar") >= int(values["similar"])).map("dst").distinct()
    commands = telnet.filter(payload_contains(b"zorro")).map(dst=ip.dst).reduce("dst", count=count())
    return guessed.join(commands, "dst").filter(field("count") >= int(values["threshold"]))


_ANY, _RRSIG = 255, 46


def _dns_reflection(values: Values) -> Query:
    packets = _begin("dns_reflection", values).gate(udp.sport == 53, int(values["gate"]), dst=ip.dst)
    large = (dns.qtype == _ANY) | (dns.qtype == _RRSIG)
    answers = _towards(packets.filter((udp.sport == 53) & (dns.response == 1) & large), values)
    # a packet between two ports 53 is taken for an answer
    asks = (udp.dport == 53) & (udp.sport != 53)
    questions = _towards(packets.filter(asks), values, at="ip.src")
    unasked = (
        answers.map(dst=ip.dst, src=ip.src)
        .distinct()
        .join(questions.map(dst=ip.src, src=ip.dst).distinct(), "dst", "src", kind="anti")
    )
    return unasked.reduce("dst", count=count()).filter(field("count") >= int(values["threshold"]))


def _arp_scan(values: Values) -> Query:
    asked = _begin("arp_scan", values).filter((eth.type == ETHERTYPE_ARP) & (arp.op == 1))
    pairs = _towards(asked, values, at="arp.dst").map(port=port, mac=eth.src, target=arp.dst).distinct()
    return pairs.reduce("port", "mac", count=count()).filter(field("count") >= int(values["threshold"]))


_DST: Final = prefix("dst", "only hosts in this prefix")
_SRC: Final = prefix("src", "only senders in this prefix")
_W: Final = window(3_000)


def _gate(default: int, what: str) -> Parameter:
    return number("gate", default, f"look at a host's packets from its {what} of this number on", unit=what)


_REFINE: Final = levels()

CATALOGUE: Final[dict[str, Template]] = {
    template.name: template
    for template in (
        Template(
            name="new_tcp",
            meaning="hosts to which many TCP connections are opened",
            result="dst: the host; count: SYNs to it",
            parameters=(_W, number("threshold", 40, "report at this many SYNs", unit="SYNs"), _DST, _REFINE),
            build=_new_tcp,
        ),
        Template(
            name="ssh_brute_force",
            meaning="hosts that get frames of one length to port 22 from many senders",
            result="dst: the host; length: bytes of the frames; count: senders",
            parameters=(
                _W,
                number("threshold", 40, "report at this many senders", unit="senders"),
                _DST,
                _REFINE,
            ),
            build=_ssh_brute_force,
        ),
        Template(
            name="superspreader",
            meaning="hosts that contact many destinations",
            result="src: the host; count: destinations",
            parameters=(
                _W,
                number("threshold", 40, "report at this many destinations", unit="destinations"),
                _SRC,
                _REFINE,
            ),
            build=_superspreader,
        ),
        Template(
            name="port_scan",
            meaning="hosts that send TCP to many ports",
            result="src: the host; count: destination ports",
            parameters=(
                _W,
                number("threshold", 40, "report at this many ports", unit="ports", high=65_536),
                _SRC,
                _REFINE,
            ),
            build=_port_scan,
        ),
        Template(
            name="ddos",
            meaning="hosts that many sources send to",
            result="dst: the host; count: sources",
            parameters=(
                _W,
                number("threshold", 45, "report at this many sources", unit="sources"),
                _DST,
                _REFINE,
            ),
            build=_ddos,
        ),
        Template(
            name="syn_flood",
            meaning="hosts with half-open connections: SYNs to + SYN-ACKs from - ACKs to them",
            result="dst: the host; count: the difference at the window's end",
            parameters=(_W, number("threshold", 3, "report at this difference", unit="segments"), _DST),
            build=_syn_flood,
        ),
        Template(
            name="incomplete_flows",
            meaning="hosts with connections that do not end: SYNs to - FINs from them",
            result="dst: the host; count: the difference at the window's end",
            parameters=(
                window(30_000),
                number("threshold", 1, "report at this difference", unit="connections"),
                _DST,
            ),
            build=_incomplete_flows,
        ),
        Template(
            name="slowloris",
            meaning="hosts with many TCP connections that carry few bytes each",
            result="dst: the host; connections; bytes; count: bytes per connection",
            parameters=(
                _W,
                number("threshold", 90, "report up to this many bytes per connection", unit="bytes"),
                number("connections", 5, "only hosts with this many connections", unit="connections"),
                number("bytes", 500, "only hosts with this many bytes", unit="bytes"),
                _DST,
            ),
            build=_slowloris,
        ),
        Template(
            name="dns_tunnel",
            meaning="hosts that are told many names and connect to few hosts",
            result="dst: the host; count: names answered - hosts connected to, at the window's end",
            parameters=(
                # 40 as for the other counts: a page asks for tens of names but connects to their hosts
                _W,
                number("threshold", 40, "report at this difference", unit="names"),
                _gate(10, "DNS answer"),
                _DST,
            ),
            build=_dns_tunnel,
        ),
        Template(
            name="zorro",
            meaning="hosts that get the command zorro in a window with many telnet frames of one length",
            result="dst: the host; count: frames with the command",
            parameters=(
                # a minute: guessing passwords and what follows must fall into one window
                window(60_000),
                number("threshold", 1, "report at this many frames with the command", unit="frames"),
                # 10: a telnet login that is typed by hand has fewer frames of one length
                number("similar", 10, "telnet frames of one length that count as guessing", unit="frames"),
                _gate(10, "telnet frame"),
                _DST,
            ),
            build=_zorro,
        ),
        Template(
            name="dns_reflection",
            meaning="hosts that get DNS answers of type ANY or RRSIG from many servers they did not ask",
            result="dst: the host; count: servers",
            parameters=(
                _W,
                number("threshold", 40, "report at this many servers", unit="servers"),
                _gate(10, "DNS answer"),
                _DST,
            ),
            build=_dns_reflection,
        ),
        Template(
            name="arp_scan",
            meaning="senders that ask for many addresses by ARP",
            result="port: the switch's; mac: the sender's; count: addresses asked for",
            parameters=(
                _W,
                number("threshold", 40, "report at this many addresses", unit="addresses"),
                prefix("dst", "only addresses in this prefix"),
            ),
            build=_arp_scan,
        ),
    )
}
"""Name to template: those of the paper in its order, then our own."""
OUR_OWN: Final = frozenset({"arp_scan"})
"""Queries that the paper does not have."""
PAPER: Final = tuple(name for name in CATALOGUE if name not in OUR_OWN)
"""The paper's eleven, in its order."""
