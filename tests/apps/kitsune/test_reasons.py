"""What an alert says of a sender that training never saw."""

import pytest

from apps.kitsune.reasons import _comparisons


@pytest.mark.parametrize(
    ("hosts", "end"), [(0, "40 packets/s"), (1, "40 packets/s to 1 host"), (7, "40 packets/s to 7 hosts")]
)
def test_hosts_are_named_where_there_are_any(hosts, end):
    """A second of packets without addresses was sent to no host: then none is counted."""
    (text,) = _comparisons("a camera", 40, 0, hosts, 0)
    assert text.endswith(end)
