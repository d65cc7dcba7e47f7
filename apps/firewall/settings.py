"""Options of the firewall as a whole."""

import re
from typing import Final, Literal

import msgspec

from apps.firewall.enforcement.syslog_sink import Facility, syslog_place
from apps.firewall.policy.rules import Rules
from apps.firewall.syn.syn_policy import SynRules

_SEGMENT: Final = re.compile(r"[a-z0-9_]{1,64}")


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the firewall."""

    rules: Rules = Rules()
    syn: SynRules = SynRules()
    guard: tuple[str, ...] = ()
    """Services guarded from the start: ADDRESS:PORT, IPv6 addresses in brackets."""
    detect: bool = True
    """Ask the switch for SYN floods (needs the Sonata adapter)."""
    learn: bool = True
    """Learn known sources from completed handshakes (needs the Sonata adapter, and both directions)."""
    evidence_queries: tuple[str, ...] = ()
    """Queries whose results are evidence as well, the user's own among them (needs the Sonata adapter)."""
    evidence_apps: tuple[str, ...] = ()
    """Further apps whose evidence counts, by app id; the firewall acts on its own anyway, and not twice."""
    known_limit: int = 4000
    """Known sources in the switch, the most recent ones."""
    known_days: int = 30
    """Days for which a completed handshake makes a source known."""
    allow_surroundings: bool = False
    """Never block this machine's own addresses, gateways, DNS servers and management peers; off in replays,
    whose captures come from other networks."""
    arp: Literal["block", "tell", "off"] = "block"
    """When a host claims another's address by ARP while the owner is present: block it, only report it, or
    ignore it (needs the Sonata adapter)."""
    arp_training_s: int = 600
    """Seconds at the start in which address owners are learnt; only claims of these addresses lead to blocks."""
    arp_settle_s: int = 3600
    """Seconds without a competing claim after which a later binding counts; a claim of it is only reported."""
    arp_contest_s: int = 60
    """Seconds after a claim within which the owner must send a frame to be taken as present."""
    enforcers: tuple[str, ...] = ("p4runtime_ctrl",)
    """Apps that carry blocks out, by app id: the switches' controller, nftables, webhook_enforcer, or your own."""
    eve_file: str = ""
    """File to which incidents and decisions are appended as EVE JSON, one per line; empty: none."""
    eve_redis: str = ""
    """Redis URL of a server that gets the same lines in a list; empty: none."""
    eve_list: str = "sdnator"
    """Name of that list."""
    eve_format: Literal["eve", "ecs"] = "eve"
    """Fields of these lines: Suricata's EVE, or those of the Elastic Common Schema."""
    syslog: str = ""
    """Collector that gets the same lines as syslog messages (RFC 5424): udp://, tcp:// or tls://HOST:PORT; empty:
    none."""
    syslog_facility: Facility = "local0"
    """Facility of these messages."""
    syslog_ca: str = ""
    """CA certificates that may have signed the collector's (tls), a file; empty: the system's."""
    webhook: str = ""
    """URL to which decisions and notices are sent as JSON by POST; empty: none."""
    webhook_token: str = ""
    """Bearer token for the webhook."""
    archive_patience_s: float = 5.0
    """Seconds that a decision waits for the sender's history from Data Archives."""

    def __post_init__(self) -> None:
        for name in (*self.evidence_queries, *self.evidence_apps, *self.enforcers):
            if not _SEGMENT.fullmatch(name):
                raise ValueError(f"{name!r} is not the name of a query or an app: letters, digits and _ only")
        if self.syslog:
            syslog_place(self.syslog)
        if not self.enforcers or len(set(self.enforcers)) < len(self.enforcers):
            raise ValueError(f"enforcers={list(self.enforcers)}: must name one or more apps, each once")
