"""What modelled blocks drop is what a look at each block says."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from apps.messages import Decision, Target
from benchmarks.decision_blocks import ModelledBlocks

MACS = ["02:00:00:00:00:01", "02:00:00:00:00:02"]
targets = st.one_of(
    st.builds(Target, kind=st.just("mac"), address=st.sampled_from(MACS), port=st.sampled_from([None, 1, 2])),
    st.builds(Target, kind=st.just("ip"), address=st.sampled_from(["10.0.0.1", "10.0.0.2", "fe80::1"])),
)
PACKETS = [
    (port, mac, version, source)
    for port in (1, 2, 3)
    for mac in (0x020000000001, 0x020000000003)
    for version, source in ((4, 0x0A000001), (4, 0x0A000003), (6, 0x0A000002), (0, 0))
]


def decision(number, target, action="block"):
    return Decision(
        id=f"{number}", action=action, switch="s1", target=target, reason="", event_time=0, expires=0
    )


def columns():
    names = ("port", "eth_src", "ip_version", "ip_src_lo")
    return {name: np.array(column) for name, column in zip(names, zip(*PACKETS, strict=True), strict=True)}


def covered(target, packet):
    port, mac, version, source = packet
    if target.kind == "mac":
        return int(target.address.replace(":", ""), 16) == mac and target.port in (None, port)
    return version == 4 and target.address == f"10.0.0.{source & 255}"


@given(st.lists(targets, max_size=6), st.sets(st.integers(0, 5)))
def test_blocks_drop_what_they_cover(chosen, lifted):
    """Also of two blocks of the same sender, of which one is lifted."""
    blocks = ModelledBlocks()
    for number, target in enumerate(chosen):
        blocks.decide(decision(number, target))
        blocks.decide(decision(number, target))  # extended
    for number in lifted:
        if number < len(chosen):
            blocks.decide(decision(number, chosen[number], "unblock"))
    left = [target for number, target in enumerate(chosen) if number not in lifted]
    expected = [any(covered(target, packet) for target in left) for packet in PACKETS]
    assert blocks.drops(columns()).tolist() == expected
