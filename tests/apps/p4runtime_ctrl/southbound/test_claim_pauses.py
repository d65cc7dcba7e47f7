"""A switch is claimed again at once from a standby, and ever less often from a controller that claims it, too."""

from itertools import pairwise

from apps.p4runtime_ctrl.southbound.claim_pauses import ClaimPauses


def claims(pauses, seconds):
    return [now for now in seconds if pauses.due(now)]


def test_the_first_claim_is_due_at_once_and_the_next_ones_after_longer_and_longer_pauses():
    found = claims(ClaimPauses(), range(1000))
    between = [after - before for before, after in pairwise(found)]
    assert found[0] == 0
    assert between[:5] == [2, 3, 5, 9, 17]
    assert set(between[7:]) == {61}, "it is claimed once a minute at least"


def test_a_controller_that_had_its_switch_for_long_claims_it_at_once_again():
    pauses = ClaimPauses()
    claims(pauses, range(20))
    assert claims(pauses, [1000, 1000.5, 1001.5]) == [1000, 1001.5]
