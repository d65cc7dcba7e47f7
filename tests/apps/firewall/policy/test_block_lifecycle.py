"""The life of a block: expiry, extension, probation, escalation, caps."""

import ipaddress
from random import Random

from apps.firewall.policy.block_lifecycle import SECOND, BlockLifecycle
from apps.firewall.policy.rules import Rules
from apps.messages import Alert, Confirmation, Decision, Exhibit, Sender, Target
from tests.apps.firewall.alerts import CAMERA, alert


def opened(lifecycle: BlockLifecycle, at_s: int = 100, offences: int = 0) -> Decision:
    return opened_for(lifecycle, alert(at_s), offences)


def opened_for(lifecycle: BlockLifecycle, cause: Alert, offences: int = 0) -> Decision:
    return lifecycle.open(
        cause.sender.switch,
        Target(kind="mac", address=cause.sender.mac, port=cause.sender.port),
        "hot",
        (),
        cause.event_time,
        offences=offences,
        first_packet=cause.first_packet,
        training_rate=cause.training_rate,
        host=cause.sender.ip,
    )


def confirmation(decision: Decision, state: str) -> Confirmation:
    return Confirmation.from_value(
        {"id": decision.id, "switch": "s1", "state": state, "action": "block", "event_time": 101 * SECOND}
    )


def test_first_block_lasts_ten_minutes_and_later_ones_longer():
    """Repeat offenders stay out for an hour, a day, a week."""
    lengths = [
        (d.expires - d.event_time) // SECOND
        for d in (opened(BlockLifecycle(Rules()), offences=n) for n in range(6))
    ]
    assert lengths == [600, 3600, 86_400, 604_800, 604_800, 604_800]


def test_a_block_after_a_lift_is_another_one_in_the_same_moment_too():
    """By hand, while no switch says that time goes on: the lift in the archive must not end the second block."""
    lifecycle = BlockLifecycle(Rules())
    first = opened(lifecycle)
    assert lifecycle.lift(first.id, first.event_time, "by hand") is not None
    assert opened(lifecycle).id != first.id
    assert opened(BlockLifecycle(Rules())).id == first.id, "the same in every replay"


def test_block_covers_its_station_and_nobody_else():
    """A MAC block is of one port of one switch."""
    lifecycle = BlockLifecycle(Rules())
    opened(lifecycle)
    assert lifecycle.covering(CAMERA) is not None
    assert lifecycle.covering(Sender(switch="s1", port=2, mac=CAMERA.mac, ip=CAMERA.ip)) is None
    assert lifecycle.covering(Sender(switch="s2", port=1, mac=CAMERA.mac, ip=CAMERA.ip)) is None


def covering_by_a_look_at_each(lifecycle: BlockLifecycle, sender: Sender) -> str | None:
    for block in lifecycle.blocks.values():
        target = block.decision.target
        covered = sender.ip != "" and (
            ipaddress.ip_address(sender.ip) in ipaddress.ip_network(target.address)
            if "/" in target.address
            else target.address == sender.ip
        )
        if target.kind == "mac":
            covered = target.address == sender.mac and target.port in (None, sender.port)
        if covered and block.decision.switch in (sender.switch, "*"):
            return block.decision.id
    return None


def test_the_oldest_of_several_blocks_covers():
    """As a look at each block in force would find it, however they come and go."""
    random = Random(7)
    targets = [
        *(
            Target(kind="mac", address=f"02:00:00:00:00:0{n}", port=port)
            for n in (1, 2)
            for port in (None, 1)
        ),
        *(Target(kind="ip", address=each) for each in ("10.0.0.1", "10.0.0.2", "fd00::1", "10.0.0.0/31")),
    ]
    senders = [
        Sender(switch=switch, port=port, mac=f"02:00:00:00:00:0{n}", ip=ip)
        for switch in ("s1", "s2")
        for port in (1, 2)
        for n in (1, 3)
        for ip in ("", "10.0.0.1", "10.0.0.3", "fd00::1")
    ]
    lifecycle = BlockLifecycle(Rules())
    kinds = set()
    for at in range(300):
        step = random.random()
        if step < 0.5:
            lifecycle.open(random.choice(["s1", "s2", "*"]), random.choice(targets), "", (), at * SECOND)
        elif lifecycle.blocks and step < 0.9:
            lifecycle.lift(random.choice([*lifecycle.blocks]), at * SECOND, "by hand")
        elif lifecycle.blocks:
            (decision, *_) = (block.decision for block in lifecycle.blocks.values())
            lifecycle.confirm(confirmation(decision, "failed"))
        for sender in senders:
            found = lifecycle.covering(sender)
            assert (found and found.decision.id) == covering_by_a_look_at_each(lifecycle, sender)
            kinds.add(found is not None)
    assert kinds == {True, False}


def test_quiet_block_runs_out_into_probation():
    """It is lifted at its expiry, and for ten minutes one anomalous second blocks again."""
    lifecycle = BlockLifecycle(Rules())
    decision = opened(lifecycle)
    assert lifecycle.due(decision.expires - 1) == []
    (lifted,) = lifecycle.due(decision.expires)
    assert (lifted.action, lifted.id) == ("unblock", decision.id)
    assert lifecycle.covering(CAMERA) is None
    assert lifecycle.on_probation(CAMERA, decision.expires + 599 * SECOND)
    assert not lifecycle.on_probation(CAMERA, decision.expires + 600 * SECOND)


def test_probation_that_is_over_takes_no_room():
    lifecycle = BlockLifecycle(Rules())
    for number in range(3):
        target = Target(kind="ip", address=f"10.0.0.{number}")
        lifecycle.open("s1", target, "hot", (), number * 1000 * SECOND, seconds=10)
        lifecycle.due((number * 1000 + 10) * SECOND)
    assert list(lifecycle.probation) == [("s1", "ip", "10.0.0.2")]


def test_block_is_extended_while_the_attack_goes_on():
    """Sixty-one drops a second are more than three times a training rate of twenty."""
    lifecycle = BlockLifecycle(Rules())
    decision = opened(lifecycle)
    lifecycle.count_drops(decision.id, 61 * 600, decision.expires)
    (extended,) = lifecycle.due(decision.expires)
    assert (extended.action, extended.expires) == ("block", decision.expires + 600 * SECOND)
    assert "still going on" in extended.reason


def test_pause_of_the_flood_does_not_end_the_block():
    """The rate counts over a minute: half a minute of silence is a pause."""
    lifecycle = BlockLifecycle(Rules())
    decision = opened(lifecycle)
    end = decision.expires
    for before_end, drops in ((120, 0), (60, 6_000), (30, 12_000), (1, 12_000), (0, 12_000)):
        lifecycle.count_drops(decision.id, drops, end - before_end * SECOND)
    assert lifecycle.due(end)[0].action == "block"


def test_drops_at_the_training_rate_do_not_extend():
    """A camera that only does its usual work is given another chance."""
    lifecycle = BlockLifecycle(Rules())
    decision = opened(lifecycle)
    lifecycle.count_drops(decision.id, 20 * 600, decision.expires)
    assert lifecycle.due(decision.expires)[0].action == "unblock"


def test_a_restart_does_not_make_a_block_of_a_busy_host_endless():
    """What is usual for it, and which host it is, comes with the decision; where it does not nothing is extended."""
    for seconds, packets, then in ((600, 20, "unblock"), (600, 61, "block")):
        decision = opened(BlockLifecycle(Rules()))
        restarted = BlockLifecycle(Rules())
        restarted.restore([Decision.from_value(decision.to_value())])
        restarted.count_drops(decision.id, packets * seconds, decision.expires)
        assert restarted.due(decision.expires)[0].action == then
    old = {
        name: value for name, value in decision.to_value().items() if name not in ("training_rate", "host")
    }
    restarted.restore([Decision.from_value(old)])
    restarted.count_drops(decision.id, 1_000_000, decision.expires)
    assert restarted.due(decision.expires)[0].action == "unblock"
    assert restarted.on_probation(CAMERA, decision.expires)


def test_a_known_host_that_is_blocked_by_its_mac_is_known_after_a_restart():
    decision = opened(BlockLifecycle(Rules()))
    restarted = BlockLifecycle(Rules(), known={CAMERA.ip, "10.0.0.77"})
    restarted.restore([Decision.from_value(decision.to_value())])
    assert "max_known_share" in (restarted.cap_reached(decision.event_time, "10.0.0.77") or "")


def test_a_block_that_was_asked_for_ends_when_it_says():
    """However much it drops, also after a restart, and it puts nobody on probation: it rests on no evidence."""
    said = Exhibit(key="network.instruction.operator.firewall", timestamp=1, summary="block")
    first, restarted = BlockLifecycle(Rules()), BlockLifecycle(Rules())
    target = Target(kind="mac", address=CAMERA.mac, port=CAMERA.port)
    decision = first.open("*", target, "by hand: ticket 4711", [said], 100 * SECOND, seconds=30)
    restarted.restore([decision])
    for lifecycle in (first, restarted):
        lifecycle.count_drops(decision.id, 1_000_000, decision.expires)
        assert lifecycle.due(decision.expires - 1) == []
        (lifted,) = lifecycle.due(decision.expires)
        assert (lifted.action, lifted.id) == ("unblock", decision.id)
        assert lifecycle.blocks == {}
        assert not lifecycle.on_probation(CAMERA, decision.expires)


def test_block_refused_by_the_switch_is_not_in_force():
    """What failed does not count as covered: the next alert tries again."""
    lifecycle = BlockLifecycle(Rules())
    made = opened(lifecycle)
    lifecycle.confirm(confirmation(made, "installed"))
    assert lifecycle.covering(CAMERA) is not None
    lifecycle.confirm(confirmation(made, "failed"))
    assert lifecycle.covering(CAMERA) is None


def test_caps_stop_blocking():
    """Too many decisions a minute, or blocks in force, stop the firewall."""
    lifecycle = BlockLifecycle(Rules(max_decisions_per_minute=2))
    for second in (100, 101):
        assert lifecycle.cap_reached(second * SECOND) is None
        opened(lifecycle, second)
    assert "max_decisions_per_minute" in (lifecycle.cap_reached(102 * SECOND) or "")
    assert lifecycle.cap_reached(161 * SECOND) is None
    assert "max_blocks" in (BlockLifecycle(Rules(max_blocks=0)).cap_reached(0) or "")


def test_a_clock_that_was_ahead_does_not_stop_blocking():
    """One decision a day ahead; when the clock is right again, one block in ten minutes is no cap, and a cap is told."""
    lifecycle = BlockLifecycle(Rules(max_decisions_per_minute=3))
    opened(lifecycle, 86_400)
    lifecycle.refuse("too many (test)", "10.0.0.1", 86_400 * SECOND)
    lifecycle.notices.clear()
    for number in range(5):
        assert lifecycle.cap_reached(number * 600 * SECOND) is None
        opened(lifecycle, number * 600)
    lifecycle.refuse("too many (test)", "10.0.0.1", 3_000 * SECOND)
    assert len(lifecycle.notices) == 1


def test_the_cap_holds_though_the_clocks_of_two_senders_differ_by_minutes():
    lifecycle = BlockLifecycle(Rules(max_decisions_per_minute=3))
    for number in range(4):
        opened(lifecycle, number + 120 * (number % 2))
    assert lifecycle.cap_reached(124 * SECOND) is not None


def test_dry_run_is_marked():
    """Decisions of a dry run say so, and are never extended."""
    lifecycle = BlockLifecycle(Rules(dry_run=True))
    decision = opened(lifecycle)
    assert decision.dry_run
    lifecycle.count_drops(decision.id, 10**6, decision.expires)
    assert lifecycle.due(decision.expires)[0].action == "unblock"


def test_same_decision_has_the_same_id_in_every_replay():
    """Ids follow from switch, target and capture time."""
    assert opened(BlockLifecycle(Rules())).id == opened(BlockLifecycle(Rules())).id
    other = alert(100, Sender(switch="s1", port=1, mac="00:00:00:00:00:01"))
    lifecycle = BlockLifecycle(Rules())
    made = opened_for(lifecycle, other)
    assert made.id != opened(lifecycle).id


def test_only_decisions_of_the_last_minute_are_remembered_for_the_cap():
    """Also where nothing asks for the cap: an operator's blocks do not."""
    lifecycle = BlockLifecycle(Rules())
    for second in range(0, 3_000, 10):
        opened(lifecycle, at_s=second)
    assert len(lifecycle._recent) == 6
