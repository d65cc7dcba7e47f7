"""The windows of all switches wait for the one that is furthest behind, unless it is idle."""

from apps.sonata_adapter.host.slowest_switch import SlowestSwitch


def test_the_switch_furthest_behind_decides():
    slowest = SlowestSwitch(["s1", "s2"], now=0.0, idle_s=10.0)
    slowest.move({"s1": 9_000}, now=1.0)
    assert slowest.next(now=1.0) == 0
    slowest.move({"s2": 4_000, "unknown": 1}, now=2.0)
    assert slowest.next(now=2.0) == 4_000
    assert slowest.next(now=2.1) == 0
    slowest.move({"s2": 3_000}, now=3.0)
    slowest.move({"s2": 12_000}, now=3.0)
    assert slowest.next(now=3.0) == 9_000


def test_an_idle_switch_holds_nobody_up_once_all_it_sent_was_read():
    slowest = SlowestSwitch(["s1", "s2"], now=0.0, idle_s=10.0)
    slowest.move({"s1": 9_000}, now=20.0)
    assert slowest.next(now=20.0) == 0
    slowest.all_read(noted=9.0)
    assert (slowest.idle, slowest.next(now=20.0)) == ([], 0)
    slowest.all_read(noted=11.0)
    assert (slowest.idle, slowest.next(now=20.0)) == (["s2"], 9_000)
    slowest.move({"s2": 10_000}, now=21.0)
    slowest.move({"s1": 30_000}, now=21.0)
    assert (slowest.idle, slowest.next(now=21.0)) == ([], 10_000)


def test_where_all_are_idle_time_stands_at_the_last_one():
    slowest = SlowestSwitch(["s1", "s2"], now=0.0, idle_s=10.0)
    slowest.move({"s1": 9_000, "s2": 4_000}, now=1.0)
    slowest.all_read(noted=20.0)
    assert slowest.next(now=20.0) == 9_000


def test_the_same_time_is_told_again_after_a_while():
    """The topic of the times is short, and Spark may have been too late for it."""
    slowest = SlowestSwitch(["s1"], now=0.0, idle_s=10.0)
    slowest.move({"s1": 9_000}, now=1.0)
    assert [slowest.next(now=now) for now in (1.0, 10.9, 11.0, 12.0)] == [9_000, 0, 9_000, 0]


def test_time_never_goes_back():
    slowest = SlowestSwitch(["s1", "s2"], now=0.0, idle_s=10.0)
    slowest.move({"s1": 9_000}, now=15.0)
    slowest.all_read(noted=15.0)
    assert slowest.next(now=15.0) == 9_000
    slowest.move({"s2": 5_000}, now=16.0)
    assert slowest.next(now=16.0) == 0
