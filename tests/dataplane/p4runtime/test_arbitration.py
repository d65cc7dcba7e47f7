"""Arbitration follows P4Runtime 1.4: highest id ever seen wins, ids are unique, roles are apart."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataplane.p4runtime.arbitration import Arbitration
from dataplane.p4runtime.status import Denied, InvalidArgument, MissingEntity, Precondition

OK, NO_PRIMARY, BACKUP = 0, 5, 6


def told(notices):
    return {notice.client: (notice.code, notice.election_id) for notice in notices}


def test_the_first_client_with_an_id_becomes_primary():
    assert told(Arbitration().update(1, "", 7)) == {1: (OK, 7)}


def test_a_lower_id_becomes_backup_and_only_it_is_told():
    arbitration = Arbitration()
    arbitration.update(1, "", 7)
    assert told(arbitration.update(2, "", 3)) == {2: (BACKUP, 7)}


def test_a_higher_id_takes_over_and_everybody_is_told_the_new_primary_last():
    arbitration = Arbitration()
    arbitration.update(1, "", 7)
    notices = arbitration.update(2, "", 8)
    assert told(notices) == {1: (BACKUP, 8), 2: (OK, 8)}
    assert notices[-1].client == 2


def test_an_id_in_use_is_refused():
    arbitration = Arbitration()
    arbitration.update(1, "", 7)
    with pytest.raises(InvalidArgument):
        arbitration.update(2, "", 7)
    assert arbitration.role_of(2) is None


def test_the_same_id_again_by_its_owner_is_no_change():
    arbitration = Arbitration()
    arbitration.update(1, "", 7)
    assert told(arbitration.update(1, "", 7)) == {1: (OK, 7)}


def test_a_client_without_an_id_never_becomes_primary():
    arbitration = Arbitration()
    assert told(arbitration.update(1, "", None)) == {1: (NO_PRIMARY, None)}
    assert arbitration.primary() is None


def test_after_the_primary_left_only_an_id_as_high_as_the_highest_follows():
    arbitration = Arbitration()
    arbitration.update(1, "", 7)
    arbitration.update(2, "", 3)
    assert told(arbitration.leave(1)) == {2: (NO_PRIMARY, 7)}
    assert told(arbitration.update(2, "", 6)) == {2: (NO_PRIMARY, 7)}
    assert told(arbitration.update(2, "", 7)) == {2: (OK, 7)}


def test_a_primary_that_lowers_its_id_leaves_the_role_without_primary():
    arbitration = Arbitration()
    arbitration.update(1, "", 7)
    arbitration.update(2, "", 3)
    assert told(arbitration.update(1, "", 2)) == {1: (NO_PRIMARY, 7), 2: (NO_PRIMARY, 7)}


def test_roles_have_primaries_of_their_own_and_may_share_ids():
    arbitration = Arbitration()
    arbitration.update(1, "", 7)
    assert told(arbitration.update(2, "guard", 7)) == {2: (OK, 7)}
    assert sorted(arbitration.primaries()) == [1, 2]


def test_a_stream_keeps_its_role():
    arbitration = Arbitration()
    arbitration.update(1, "", 7)
    with pytest.raises(Precondition):
        arbitration.update(1, "guard", 7)


def test_writes_need_the_primary_s_id_and_a_known_role():
    arbitration = Arbitration()
    with pytest.raises(Denied):
        arbitration.check("", 0)
    arbitration.update(1, "", 7)
    arbitration.check("", 7)
    with pytest.raises(Denied):
        arbitration.check("", 6)
    with pytest.raises(MissingEntity):
        arbitration.check("guard", 7)
    arbitration.leave(1)
    with pytest.raises(Denied):
        arbitration.check("", 7)


STEPS = st.lists(st.tuples(st.integers(0, 3), st.one_of(st.none(), st.integers(0, 4), st.just("leave"))))


@given(STEPS)
def test_a_primary_always_has_the_highest_id_ever_accepted(steps):
    arbitration, highest, ids = Arbitration(), -1, {}
    for client, what in steps:
        if what == "leave":
            arbitration.leave(client)
            ids.pop(client, None)
            continue
        try:
            arbitration.update(client, "", what)
        except InvalidArgument:
            assert what in [number for other, number in ids.items() if other != client]
            continue
        ids[client] = what
        highest = max(highest, -1 if what is None else what)
        primary = arbitration.primary()
        assert (primary is None) == (highest not in ids.values())
        assert primary is None or ids[primary] == highest
