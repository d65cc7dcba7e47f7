"""What operators call a false alarm counts less afterwards, and nothing else does."""

import pytest
from msgspec import structs

from apps.firewall.policy.false_alarms import MOST_LESSONS, SUFFIX, WEIGHT, FalseAlarms, ground_of
from apps.messages import Sender
from tests.apps.firewall.alerts import SECOND
from tests.apps.firewall.policy.test_sequential_test import evidence, trained

NOW = 100 * SECOND
DAY_S = 86_400
BACKUP = evidence(20.0, 100, "targets", service="tcp/445", victim_count=0)


def taught(*heard, days=90):
    made = FalseAlarms(days)
    for each in heard:
        made.note(each, "kitsune")
    grounds = made.book.take(heard[0].sender, NOW)
    made.teach("d1", grounds, NOW, "a backup")
    return made


def test_the_same_evidence_counts_a_tenth_and_never_decides_alone():
    """However much of it comes, and from as many statistics as were taught."""
    contacts = evidence(20.0, 100, "contacts")
    lessons = taught(BACKUP, contacts)
    again = [lessons.weighed(each, "kitsune") for each in (BACKUP, contacts)]
    assert [each.nats for each in again] == [20.0 * WEIGHT] * 2
    test = trained()
    for _ in range(1_000):
        tallies = [test.hear(each, "kitsune") for each in again]
    assert 0 < tallies[-1].total(NOW, test.bound) < 0.5 * test.bound


@pytest.mark.parametrize(
    "other",
    [
        {"service": "tcp/23"},
        {"source": "ports"},
        {"sender": Sender(switch="s1", port=2, mac="5c:cf:7f:05:f2:c6", ip="192.168.2.108")},
        {"sender": Sender(switch="s1", port=1, mac="5c:cf:7f:05:f2:c6", ip="192.168.2.109")},
    ],
)
def test_another_service_statistic_port_or_address_counts_in_full(other):
    different = structs.replace(BACKUP, **other)
    assert taught(BACKUP).weighed(different, "kitsune") == different


def test_another_app_counts_in_full():
    """What is taught about Kitsune says nothing about a query of the same name."""
    assert taught(BACKUP).weighed(BACKUP, "honeypot") == BACKUP


def test_its_sum_stays_apart_from_that_of_an_attack_by_the_same_statistic():
    """Tame evidence must not make the attack's part of the sum tame."""
    lessons, test = taught(BACKUP), trained()
    attack = structs.replace(BACKUP, service="tcp/23")
    tally = test.hear(attack, "kitsune")
    alone = tally.total(NOW, test.bound)
    tally = test.hear(lessons.weighed(BACKUP, "kitsune"), "kitsune")
    assert tally.total(NOW, test.bound) >= alone
    assert f"kitsune.targets{SUFFIX}" in tally.contributions


def test_ports_of_the_moment_and_conversations_do_not_narrow_a_lesson():
    """A video call has other ports every time; a score is about the sender."""
    call = evidence(20.0, 100, "one_way", kind="flood", service="udp/50123")
    assert taught(call).weighed(structs.replace(call, service="udp/61002"), "kitsune").nats < call.nats
    score = evidence(20.0, 100, "scores", kind="unlike_training", service="tcp/443", victims=("10.0.0.1",))
    other = structs.replace(score, service="tcp/80", victims=("10.0.0.2",))
    assert ground_of(score, "kitsune") == ground_of(other, "kitsune")


def test_a_victim_narrows_it_where_there_is_no_service():
    scan = evidence(20.0, 100, "ports", victims=("10.0.0.1",))
    lessons = taught(scan)
    assert lessons.weighed(scan, "kitsune").nats < scan.nats
    assert lessons.weighed(structs.replace(scan, victims=("10.0.0.2",)), "kitsune").nats == scan.nats


def test_it_ends_can_be_taken_back_and_survives_a_restart():
    lessons = taught(BACKUP, days=1)
    late = structs.replace(BACKUP, event_time=NOW + (DAY_S + 1) * SECOND)
    assert lessons.weighed(late, "kitsune").nats == late.nats
    (said,) = lessons.told()
    after = FalseAlarms(1)
    after.restore([said])
    assert after.weighed(BACKUP, "kitsune").nats < BACKUP.nats
    after.revoke("d1", NOW)
    (revoked,) = after.told()
    assert after.weighed(BACKUP, "kitsune").nats == BACKUP.nats
    again = FalseAlarms(1)
    again.restore([said, revoked])
    assert "d1" not in again


def test_called_twice_it_counts_a_hundredth_and_no_less():
    lessons = taught(BACKUP)
    for name in ("d2", "d3"):
        lessons.teach(name, (ground_of(BACKUP, "kitsune"),), NOW, "")
    assert lessons.weighed(BACKUP, "kitsune").nats == pytest.approx(0.2)


def test_their_number_is_bounded():
    lessons = FalseAlarms(90)
    for number in range(MOST_LESSONS):
        lessons.teach(f"d{number}", (ground_of(BACKUP, "kitsune"),), NOW, "")
    with pytest.raises(ValueError, match="revoke some"):
        lessons.teach("one more", (), NOW, "")
    with pytest.raises(ValueError, match="already"):
        FalseAlarms.teach(taught(BACKUP), "d1", (), NOW, "")


def test_grounds_are_kept_for_an_hour():
    lessons = FalseAlarms(90)
    for at_s in (100, 3_000, 4_000):
        other = structs.replace(
            evidence(1.0, at_s, "ports"), sender=structs.replace(BACKUP.sender, ip="10.9.9.9")
        )
        lessons.note(other if at_s > 100 else BACKUP, "kitsune")
    assert lessons.book.take(BACKUP.sender, 4_000 * SECOND) == ()
    assert len(lessons.book.take(other.sender, 4_000 * SECOND)) == 1
