"""Equal names of many messages are one object."""

from apps.firewall.arrivals import evidence_of
from apps.firewall.evidence.shared import MOST_SHARED, shared_sender, shared_text
from apps.messages import Sender
from due import Item
from tests.apps.firewall.alerts import CAMERA
from tests.apps.firewall.desk import ALERT


def item(number: int) -> Item:
    key = f"{ALERT}{number}"[: len(ALERT)]
    return Item(key, None, number, number, "kitsune", "i1", number)


def test_a_sender_is_the_one_that_came_first() -> None:
    first, again = (shared_sender(Sender.from_value(CAMERA.to_value())) for _ in range(2))
    assert first is again
    assert first == CAMERA


def test_exhibits_share_their_key() -> None:
    first, again = evidence_of(item(1), "one"), evidence_of(item(2), "two")
    assert first.key is again.key


def test_a_text_is_the_one_that_came_first() -> None:
    first, again = (f"10.0.0.{number}"[:-1] for number in (1, 2))
    assert first is not again
    assert shared_text(first) is shared_text(again)


def test_names_of_long_ago_are_not_held() -> None:
    """A network meets ever new addresses: what shares their names is bounded in time, and so is this."""
    for number in range(2 * MOST_SHARED):
        shared_text(f"198.51.{number // 256}.{number % 256}")
        shared_sender(
            Sender(switch="s1", port=1, mac="02:00:00:00:00:01", ip=f"10.1.{number // 256}.{number % 256}")
        )
    assert shared_text.cache_info().currsize == shared_sender.cache_info().currsize == MOST_SHARED
    assert MOST_SHARED <= 2_048
