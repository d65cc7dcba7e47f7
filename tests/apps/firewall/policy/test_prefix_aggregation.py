"""Many misbehaving neighbours are blocked by prefix, but for prefixes where somebody lives."""

import ipaddress

from apps.firewall.policy.block_lifecycle import SECOND, BlockLifecycle
from apps.firewall.policy.prefix_aggregation import any_within, crowded_prefixes, gather_blocks, prefix_of
from apps.firewall.policy.rules import Rules
from apps.messages import Exhibit, Target

NOW = 1000 * SECOND


def hosts(prefix: str, number: int) -> list[str]:
    return [f"{prefix}{each}" for each in range(number)]


def test_only_crowds():
    """As many as asked for, in one prefix, of either IP version."""
    addresses = hosts("192.0.2.", 128) + hosts("198.51.100.", 127) + [f"2001:db8::{n:x}" for n in range(200)]
    found = crowded_prefixes(addresses, 128, 24, 64, lambda _: False)
    assert {str(network): len(members) for network, members in found.items()} == {
        "192.0.2.0/24": 128,
        "2001:db8::/64": 200,
    }
    assert crowded_prefixes(addresses, 0, 24, 64, lambda _: False) == {}
    assert crowded_prefixes(addresses, 128, 24, 64, lambda _: True) == {}


def test_who_is_within():
    """Whichever way is shorter; versions are kept apart."""
    network = prefix_of("192.0.2.77", 24, 64)
    assert any_within(network, ["192.0.2.1"])
    assert any_within(network, set(hosts("198.51.100.", 300)) | {"192.0.2.200"})
    assert not any_within(network, set(hosts("198.51.100.", 300)))
    assert not any_within(network, ["::c000:201"])


def test_prefix_comes_first_then_its_addresses_are_lifted():
    """No moment without a block; evidence of the latest is kept."""
    lifecycle = BlockLifecycle(Rules())
    for address in hosts("192.0.2.", 130):
        evidence = [Exhibit(key="k", timestamp=1, summary=address)]
        lifecycle.open("*", Target(kind="ip", address=address), "why", evidence, NOW)
    made = list(gather_blocks(lifecycle, lambda each: {"192.0.2.0/24": list(each)}, NOW))
    assert [each.action for each in made] == ["block"] + ["unblock"] * 130
    assert made[0].target.address == "192.0.2.0/24"
    assert made[0].expires == NOW + 600 * SECOND
    assert "130 addresses" in made[0].reason
    assert made[0].evidence
    assert [each.decision for each in lifecycle.blocks.values()] == [made[0]]
    assert lifecycle.in_blocked_prefix("192.0.2.99")
    assert not lifecycle.in_blocked_prefix("192.0.3.99")


def test_a_block_that_was_asked_for_outlives_that_of_its_prefix():
    """Whoever lifts the prefix lifts what the firewall decided, not what an operator has."""
    lifecycle = BlockLifecycle(Rules())
    said = Exhibit(key="network.instruction.operator.firewall", timestamp=1, summary="block")
    by_hand = lifecycle.open(
        "*", Target(kind="ip", address="192.0.2.1"), "by hand", [said], NOW, seconds=36_000
    )
    for address in hosts("192.0.2.", 130)[2:]:
        lifecycle.open("*", Target(kind="ip", address=address), "why", (), NOW)
    made = list(gather_blocks(lifecycle, lambda each: {"192.0.2.0/24": list(each)}, NOW))
    assert (len(made), made[0].expires) == (129, NOW + 600 * SECOND)
    assert by_hand.id in lifecycle.blocks


def test_nothing_to_gather():
    """A few addresses stay as they are."""
    assert list(gather_blocks(BlockLifecycle(Rules()), lambda _: {}, NOW)) == []
    assert str(prefix_of("2001:db8::1", 24, 64)) == str(ipaddress.ip_network("2001:db8::/64"))
