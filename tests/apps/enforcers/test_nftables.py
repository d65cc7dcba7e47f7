"""nftables for real: packets of a blocked host stop in a network namespace, and come again."""

import time
from functools import partial

import pytest

from apps.enforcers.desired_blocks import desired_block_of
from apps.enforcers.nftables.nft_program import NftProgram
from apps.enforcers.nftables.nft_table import NftTable
from apps.enforcers.nftables.ruleset import TablePlan
from sdnator.testing.enforcer_run import EnforcerRun
from sdnator.testing.routed_lab import FORWARD, INPUT, OTHERS, SENDER_MAC, SENDERS, RoutedLab
from sdnator.testing.waiting import wait_for
from tests.requirements import require_netns, require_program

MODULE = "apps.enforcers.nftables.service"


@pytest.fixture(scope="module")
def lab():
    require_netns()
    require_program("nft")
    with RoutedLab() as made:
        yield made


@pytest.fixture
def run(lab, tmp_path, request):
    """A started enforcer on the gateway; its table is gone afterwards."""
    settings = {"place": "gateway", "check_s": 0.2, **getattr(request, "param", {})}
    with EnforcerRun(tmp_path, MODULE, settings, partial(lab.inside, "gateway")) as made:
        made.start()
        yield made
    lab.nft("add", "table", "inet", "sdnator")
    lab.nft("delete", "table", "inet", "sdnator")


@pytest.mark.parametrize(
    ("target", "address"),
    [
        (INPUT[4], SENDERS[4]),
        (FORWARD[4], SENDERS[4]),
        (INPUT[6], SENDERS[6]),
        (FORWARD[6], SENDERS[6]),
        (INPUT[4], SENDER_MAC),
        (FORWARD[6], SENDER_MAC),
        (FORWARD[4], "10.77.1.0/30"),
        (INPUT[6], "fd77:1::/120"),
    ],
)
def test_packets_of_a_blocked_host_stop_and_come_again(lab, run, target, address):
    """To the host itself and through it; the counter of the block has seen them."""
    with lab.path(target) as path:
        wait_for(path.passes)
        block = run.decide(run.block(address))
        run.wait_for(block, "installed")
        assert not path.passes()
        wait_for(lambda: any(each.packets for each in run.reports[-1].blocks), why=run.words)
        assert run.held() == {block.id}
        run.lift(block)
        run.wait_for(block, "removed")
        assert path.passes()


def test_others_go_on(lab, run):
    """One address is blocked, its neighbour on the same MAC is not."""
    block = run.decide(run.block(SENDERS[4]))
    run.wait_for(block, "installed")
    with lab.path(INPUT[4]) as blocked, lab.path(INPUT[4], OTHERS[4]) as free:
        assert not blocked.passes()
        assert free.passes()


def test_allowed_ones_pass_whatever_is_blocked(lab, run):
    """A block of the allowed address is refused, one of a MAC does not touch it, and a new entry lifts."""
    first = run.decide(run.block(OTHERS[4]))
    run.wait_for(first, "installed")
    run.allow(OTHERS[4])
    run.wait_for(first, "removed")
    refused = run.decide(run.block("10.77.1.0/29"))
    run.wait_for(refused, "failed")
    mac = run.decide(run.block(SENDER_MAC))
    run.wait_for(mac, "installed")
    with lab.path(INPUT[4]) as blocked, lab.path(INPUT[4], OTHERS[4]) as free:
        assert not blocked.passes()
        assert free.passes()


def test_prefixes_in_each_other(lab, run):
    """The outer one stands for both; when it is lifted the inner one goes on."""
    outer, inner = run.decide(run.block("10.77.0.0/16")), run.decide(run.block("10.77.1.0/24"))
    for each in (outer, inner):
        run.wait_for(each, "installed")
    with lab.path(INPUT[4]) as path:
        assert not path.passes()
        run.lift(outer)
        run.wait_for(outer, "removed")
        assert not path.passes()
        run.lift(inner)
        run.wait_for(inner, "removed")
        assert path.passes()


def test_a_killed_enforcer_leaves_its_blocks_and_takes_them_up_again(lab, run):
    """The kernel goes on; what was lifted meanwhile is removed, and what ends meanwhile ends by its time-out."""
    stays = run.decide(run.block(SENDERS[4]))
    lifted = run.decide(run.block(SENDERS[6]))
    ends = run.decide(run.block(OTHERS[4], seconds=3))
    for each in (stays, lifted, ends):
        run.wait_for(each, "installed")
    run.kill()
    with lab.path(INPUT[4]) as four, lab.path(INPUT[6]) as six, lab.path(INPUT[4], OTHERS[4]) as short:
        assert not four.passes()
        run.lift(lifted)
        wait_for(short.passes)
        assert not six.passes()
        run.start()
        wait_for(six.passes, why=run.words)
        assert not four.passes()
        wait_for(lambda: run.held() == {stays.id}, why=run.words)


def test_without_an_allow_list_what_stands_stays(lab, run):
    """A new process that knows no history adds, extends and lifts by transactions, also prefixes in each other."""
    addresses = (SENDERS[4], OTHERS[4], "10.78.1.0/24", "10.79.0.0/16", SENDERS[6])
    _, lifted, _, _, extended = blocks = [run.decide(run.block(address)) for address in addresses]
    for each in blocks:
        run.wait_for(each, "installed")
    run.kill()
    new = [run.block(address) for address in ("10.78.0.0/16", "10.79.1.0/24", "02:00:00:00:00:07")]
    longer = run.block(SENDERS[6], seconds=1800, id=extended.id)
    with lab.inside("gateway"):
        table = NftTable(TablePlan(), NftProgram())
        table.change([desired_block_of(each, time.time_ns()) for each in new], [])
        table.change([desired_block_of(longer, time.time_ns())], [desired_block_of(lifted, 0)])
    listed = lab.nft("list", "table", "inet", "sdnator")
    for stands in (SENDERS[4], "10.78.0.0/16", "10.79.0.0/16", "02:00:00:00:00:07", "timeout 30m"):
        assert stands in listed
    for gone in (f"{OTHERS[4]} ", "10.78.1.0/24", "10.79.1.0/24"):
        assert gone not in listed


def restored(run, number):
    """Whether blocks were restored so often."""
    return run.reports[-1].restored >= number


def test_what_somebody_else_removes_is_put_back_and_told(lab, run):
    """The whole ruleset, a rule, an element: each comes back."""
    block = run.decide(run.block(SENDERS[4]))
    run.wait_for(block, "installed")
    with lab.path(INPUT[4]) as path:
        for number, spoiling in enumerate(
            (
                ("flush", "ruleset"),
                ("flush", "chain", "inet", "sdnator", "input"),
                ("flush", "set", "inet", "sdnator", "blocked4"),
            ),
            start=1,
        ):
            lab.nft(*spoiling)
            wait_for(partial(restored, run, number), why=run.words)
            wait_for(lambda: not path.passes(), why=run.words)
    assert any("somebody else" in each.problem for each in run.reports)


def test_foreign_elements_are_removed(lab, run):
    """The table belongs to the enforcer: nobody is blocked in it without a decision."""
    block = run.decide(run.block(SENDERS[6]))
    run.wait_for(block, "installed")
    lab.nft("add", "element", "inet", "sdnator", "blocked4", f"{{ {SENDERS[4]} }}")
    with lab.path(INPUT[4]) as path:
        wait_for(path.passes, why=run.words)


def test_an_extension_goes_on_counting(lab, run):
    """The same decision with a later end: confirmed as standing, and its counter does not begin anew."""
    block = run.decide(run.block(SENDERS[4]))
    run.wait_for(block, "installed")
    with lab.path(INPUT[4]) as path:
        assert not path.passes()
        wait_for(lambda: any(each.packets == 1 for each in run.reports[-1].blocks), why=run.words)
        run.decide(run.block(SENDERS[4], seconds=1200, id=block.id))
        run.wait_for(block, "exists")
        assert not path.passes()
        wait_for(lambda: any(each.packets == 2 for each in run.reports[-1].blocks), why=run.words)
    assert "timeout 20m" in lab.nft("list", "set", "inet", "sdnator", "blocked4")


@pytest.mark.parametrize("run", [{"at_end": "remove"}], indirect=True)
def test_the_table_goes_with_the_enforcer_where_that_is_wanted(lab, run):
    block = run.decide(run.block(SENDERS[4]))
    run.wait_for(block, "installed")
    run.stop()
    with lab.path(INPUT[4]) as path:
        assert path.passes()
    assert "sdnator" not in lab.nft("list", "tables")


def wrapped(folder, rights):
    """A program nft that runs with these capabilities."""
    setpriv, real = require_program("setpriv"), require_program("nft")
    nft = folder / "nft"
    nft.write_text(f'#!/bin/sh\nexec {setpriv} --bounding-set {rights} --inh-caps -all {real} "$@"\n')
    nft.chmod(0o755)
    return {"program": str(nft), "patience_s": 0.2, "place": "gateway"}


def test_without_the_capability_it_says_so(lab, tmp_path):
    """No crash, no silence: blocks fail with what is to be done, and the report says it, too."""
    settings = wrapped(tmp_path, "-net_admin")
    with EnforcerRun(tmp_path, MODULE, settings, partial(lab.inside, "gateway")) as run:
        run.start()
        block = run.decide(run.block("192.0.2.1"))
        run.wait_for(block, "failed")
        assert "CAP_NET_ADMIN" in run.confirmations[-1].cause
        assert not run.reports[-1].working


def test_cap_net_admin_is_enough(lab, tmp_path):
    """No other capability of root is needed."""
    settings = wrapped(tmp_path, "-all,+net_admin") | {"at_end": "remove"}
    with EnforcerRun(tmp_path, MODULE, settings, partial(lab.inside, "gateway")) as run:
        run.start()
        block = run.decide(run.block(SENDERS[4]))
        run.wait_for(block, "installed")
