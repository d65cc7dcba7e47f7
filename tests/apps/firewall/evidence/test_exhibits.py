"""The pieces that a decision cites: the last ones of each sender, and only for a while."""

from msgspec import structs

from apps.firewall.evidence.exhibits import EVIDENCE_HELD_S, EVIDENCE_KEPT, SENDERS_KEPT, Exhibits
from apps.messages import Exhibit
from tests.apps.firewall.alerts import CAMERA, SECOND

OTHER = structs.replace(CAMERA, ip="10.9.9.9")


def piece(number: int) -> Exhibit:
    return Exhibit(key="network.evidence.kitsune.ports", timestamp=number, summary=f"piece {number}")


def test_the_last_pieces_of_a_sender_are_kept_in_order() -> None:
    kept = Exhibits()
    for number in range(EVIDENCE_KEPT + 2):
        kept.add(CAMERA, piece(number), SECOND)
    assert [each.timestamp for each in kept.of(CAMERA)] == list(range(2, EVIDENCE_KEPT + 2))
    assert kept.of(OTHER) == ()


def test_who_has_been_quiet_for_long_is_forgotten() -> None:
    kept = Exhibits()
    kept.add(CAMERA, piece(1), SECOND)
    kept.add(OTHER, piece(2), EVIDENCE_HELD_S * SECOND)
    assert kept.of(CAMERA)
    kept.add(OTHER, piece(3), (EVIDENCE_HELD_S + 2) * SECOND)
    assert (len(kept), kept.of(CAMERA)) == (1, ())


def test_a_crowd_of_senders_pushes_out_the_one_heard_of_longest_ago() -> None:
    kept = Exhibits()
    kept.add(CAMERA, piece(1), SECOND)
    for number in range(SENDERS_KEPT):
        kept.add(structs.replace(CAMERA, ip=f"10.8.{number // 256}.{number % 256}"), piece(number), SECOND)
    assert (len(kept), kept.of(CAMERA)) == (SENDERS_KEPT, ())
