"""From DUE keys to queries, and to the keys under which results are written.

    network.traffic_query.sonata.<query>:window=3s,threshold=40,dst=10.0.0.0/8     results
    network.traffic_capture.sonata.<protocol>:flag=syn,dst=…,dport=80               packets
    network.handshake.sonata.tcp                                                     completed handshakes

`threshold=auto` learns a threshold (`evidence.auto_thresholds`).  A missing parameter has its default.  Items carry all parameters, spelled as in the interest
(`window=3000ms` stays so), so that the observer receives them.
"""

import re
from collections.abc import Mapping
from typing import Final, Literal

import msgspec

from apps.sonata_adapter.errors import InvalidRequest
from apps.sonata_adapter.query.catalogue import Template
from apps.sonata_adapter.query.expressions import ACK, FIN, RST, SYN_ACK, Flags, Term
from apps.sonata_adapter.query.language import ETHERTYPE_ARP, Query, arp, eth, ip, tcp, udp
from apps.sonata_adapter.query.parameters import ANY_PREFIX, UNREFINED, Parameter, Value, prefix
from due import Key

QUERY_PREFIX: Final = "network.traffic_query.sonata"
CAPTURE_PREFIX: Final = "network.traffic_capture.sonata"
HANDSHAKE: Final = "network.handshake.sonata.tcp"

AUTO: Final = "auto"
_THRESHOLD: Final = "threshold"

Kind = Literal["query", "capture", "handshake"]

_FLAGS: Final[dict[str, Flags]] = {
    "syn": Flags("syn", 0x02, 0x12),  # SYN set, ACK clear
    "syn+ack": Flags("syn+ack", 0x12, 0x12),
    "ack": ACK,
    "fin": FIN,
    "rst": RST,
}
_PREFIXES: Final = (prefix("src", "source address"), prefix("dst", "destination address"))


class Protocol(msgspec.Struct, frozen=True):
    """The packets that a raw stream's protocol selects."""

    meaning: str
    conditions: tuple[Term, ...]
    ports: tuple[Term, Term] | None = None
    flags: bool = False


_HANDSHAKES: Final = Query(HANDSHAKE).filter((tcp.flags == SYN_ACK) | (tcp.flags == ACK))
_DNS: Final = (udp.sport == 53) | (udp.dport == 53)
PROTOCOLS: Final[dict[str, Protocol]] = {
    "tcp": Protocol("TCP segments", (ip.proto == 6,), (tcp.sport, tcp.dport), flags=True),
    "udp": Protocol("UDP datagrams", (ip.proto == 17,), (udp.sport, udp.dport)),
    "icmp": Protocol("ICMP and ICMPv6", ((ip.proto == 1) | (ip.proto == 58),)),
    # the classifier knows the EtherType, so that only ARP is copied
    "arp": Protocol("ARP", (eth.type == ETHERTYPE_ARP, arp.op >= 0)),
    "dns": Protocol("DNS over UDP", (_DNS,), (udp.sport, udp.dport)),
    "ip": Protocol("IPv4 and IPv6", (ip.version != 0,)),
}


class QueryRequest(msgspec.Struct, frozen=True):
    """The query that a key requests."""

    key: str
    """The interest's key, canonical for DUE."""
    kind: Kind
    name: str
    identity: str
    """Equal for keys that request the same: the key with all parameters in canonical spelling."""
    output: str
    """Key of the results: all parameters, spelled as in the interest."""
    query: Query
    values: tuple[tuple[str, Value], ...] = ()
    coarse: int = 0
    """Count by prefixes of this many bits for IPv4, four times as many for IPv6; 0: by addresses."""
    within: str = ""
    """A prefix that the query was narrowed down to by refinement; its filters say so, too."""
    on_host: bool = False
    """It stays on the host for now, whatever room the switch has."""


def request_of(key: str, templates: Mapping[str, Template]) -> QueryRequest | None:
    """The query that an interest requests; None for a key that requests none itself.

    A wildcard (`window=*`, `sonata.*`) receives what others request.  Raises `InvalidRequest` for an
    unknown query or parameter and for a value out of bounds; the text says what is accepted.
    """
    parsed = Key.parse(key)
    if not parsed.concrete:
        return None
    path = ".".join(parsed.segments[:3])
    name = parsed.segments[-1]
    given = {name: parsed.spec(name) for name in parsed.specs}
    if parsed.path == HANDSHAKE:
        return QueryRequest(parsed.text, "handshake", "tcp", HANDSHAKE, HANDSHAKE, _HANDSHAKES)
    if len(parsed.segments) == 4 and path == QUERY_PREFIX:
        return _query_request(parsed, name, given, templates)
    if len(parsed.segments) == 4 and path == CAPTURE_PREFIX:
        return _capture_request(parsed, name, given)
    raise InvalidRequest(
        f"{key}: not a key of the Sonata adapter; write {QUERY_PREFIX}.<query> or {CAPTURE_PREFIX}.<protocol>"
    )


def canonical_key(template: Template, values: Mapping[str, Value] | None = None) -> str:
    """The key of a query with all parameters written out."""
    chosen = {each.name: each.default for each in template.parameters} | dict(values or {})
    specs = {each.name: each.text(chosen[each.name]) for each in template.parameters}
    return Key(f"{QUERY_PREFIX}.{template.name}").with_specs(**specs).text


def is_auto(key: Key) -> bool:
    """Whether a query's key leaves its threshold to what the network's training saw."""
    is_query = ".".join(key.segments[:-1]) == QUERY_PREFIX
    return is_query and key.concrete and _THRESHOLD in key.specs and key.spec(_THRESHOLD) == AUTO


def values_beside_auto(key: Key, template: Template) -> tuple[dict[str, Value], str]:
    """The values of a key with `threshold=auto` but for the threshold, and the key of its results.

    Raises `InvalidRequest` for an unknown parameter, for a value out of bounds, and with `refine`.
    """
    parameters = {each.name: each for each in template.parameters}
    given = {name: key.spec(name) for name in key.specs}
    if _THRESHOLD not in parameters:
        raise InvalidRequest(f"{key}: no parameter {_THRESHOLD}; there are {', '.join(parameters)}")
    values = _values(key, parameters, {name: text for name, text in given.items() if name != _THRESHOLD})
    if values.get("refine", UNREFINED) != UNREFINED:
        raise InvalidRequest(f"{key}: refine needs a threshold that is a number, since prefixes count more")
    texts = {name: given.get(name, each.text(values[name])) for name, each in parameters.items()}
    return values, Key(f"{QUERY_PREFIX}.{template.name}").with_specs(**texts).text


def _query_request(
    key: Key, name: str, given: Mapping[str, str], templates: Mapping[str, Template]
) -> QueryRequest:
    template = templates.get(name)
    if template is None:
        raise InvalidRequest(f"{key}: there is no query {name}; there are {', '.join(templates)}")
    if is_auto(key):
        raise InvalidRequest(
            f"{key}: only a running adapter learns thresholds (`sdnator explain` shows them); give a number here"
        )
    values = _values(key, {each.name: each for each in template.parameters}, given)
    identity = canonical_key(template, values)
    texts = {each.name: given.get(each.name, each.text(values[each.name])) for each in template.parameters}
    output = Key(f"{QUERY_PREFIX}.{name}").with_specs(**texts).text
    query = msgspec.structs.replace(template.query(values), name=identity)
    return QueryRequest(key.text, "query", name, identity, output, query, tuple(sorted(values.items())))


def _values(key: Key, parameters: Mapping[str, Parameter], given: Mapping[str, str]) -> dict[str, Value]:
    for name in given:
        if name not in parameters:
            raise InvalidRequest(f"{key}: no parameter {name}; there are {', '.join(parameters)}")
    try:
        return {
            name: each.parse(given[name]) if name in given else each.default
            for name, each in parameters.items()
        }
    except InvalidRequest as error:
        raise InvalidRequest(f"{key}: {error}") from None


def capture_parameters(protocol: Protocol) -> dict[str, str]:
    """Specs of a raw stream and what they mean."""
    found = {each.name: each.meaning for each in _PREFIXES}
    if protocol.ports is not None:
        found |= {"sport": "source port", "dport": "destination port"}
    if protocol.flags:
        found["flag"] = f"one of {', '.join(_FLAGS)}"
    return found


def _capture_request(key: Key, name: str, given: Mapping[str, str]) -> QueryRequest:
    protocol = PROTOCOLS.get(name)
    if protocol is None:
        raise InvalidRequest(f"{key}: there is no raw stream {name}; there are {', '.join(PROTOCOLS)}")
    known = capture_parameters(protocol)
    for spec in given:
        if spec not in known:
            raise InvalidRequest(f"{key}: no parameter {spec}; there are {', '.join(known)}")
    query = Query(name)
    for always in protocol.conditions:
        query = query.filter(always)
    texts: dict[str, str] = {}
    try:
        for spec, text in sorted(given.items()):
            condition, texts[spec] = _capture_condition(protocol, spec, text)
            if condition is not None:
                query = query.filter(condition)
    except InvalidRequest as error:
        raise InvalidRequest(f"{key}: {error}") from None
    identity = Key(f"{CAPTURE_PREFIX}.{name}").with_specs(**texts).text
    return QueryRequest(
        key.text, "capture", name, identity, key.text, msgspec.structs.replace(query, name=identity)
    )


def _capture_condition(protocol: Protocol, spec: str, text: str) -> tuple[Term | None, str]:
    """The condition of one spec, and its one spelling."""
    if spec == "flag":
        pattern = _FLAGS.get(text.lower())
        if pattern is None:
            raise InvalidRequest(f"flag={text} is unknown; give one of {', '.join(_FLAGS)}")
        return tcp.flags == pattern, text.lower()
    if spec in ("sport", "dport"):
        assert protocol.ports is not None  # noqa: S101 - else the spec is not known
        if not re.fullmatch("[0-9]{1,5}", text) or int(text) > 65_535:
            raise InvalidRequest(f"{spec}={text} is not a port; give 0 to 65535")
        return protocol.ports[spec == "dport"] == int(text), str(int(text))
    parameter = _PREFIXES[spec == "dst"]
    value = str(parameter.parse(text))
    address = ip.dst if spec == "dst" else ip.src
    return (None if value == ANY_PREFIX else address.within(value)), value
