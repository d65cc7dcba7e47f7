"""What the operator can set about the firewall as a whole."""

from typing import Literal

import msgspec

from apps.firewall.policy import Rules
from apps.firewall.syn_policy import SynRules


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
    known_limit: int = 4000
    """Known sources in the switch, the most recent ones."""
    known_days: int = 30
    """A handshake counts for so long."""
    allow_surroundings: bool = False
    """Never block this machine's own addresses, gateways, DNS servers and management peers; off in replays,
    whose captures come from elsewhere."""
    arp: Literal["block", "tell", "off"] = "block"
    """What follows from an ARP claim of another's address while the other is there (needs the Sonata adapter)."""
    arp_training_s: int = 600
    """Who has which address is learnt in the first seconds; only claims of these addresses lead to blocks."""
    arp_settle_s: int = 3600
    """Later bindings count after this time without another claim; a claim of one is told."""
    arp_contest_s: int = 60
    """The owner has to speak within this time after a claim."""
    eve_file: str = ""
    """Alerts and decisions are appended here as EVE JSON, a line each; empty: nowhere."""
    eve_redis: str = ""
    """Redis URL of a server that takes the same lines in a list; empty: none."""
    eve_list: str = "sdnator"
    """Name of that list."""
    webhook: str = ""
    """URL that gets decisions and notices as JSON by POST; empty: none."""
    webhook_token: str = ""
    """Bearer token for the webhook."""
    archive_patience_s: float = 5.0
    """A decision waits this long for what Data Archives know of the sender."""
