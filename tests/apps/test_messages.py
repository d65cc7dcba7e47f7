"""Messages survive the wire and refuse what is not theirs."""

import pytest

from apps.messages import Alert, Decision, MessageError, Target, one_line
from tests.apps.firewall.alerts import alert


def test_message_survives_the_wire():
    """to_value and from_value are inverse."""
    message = alert()
    assert Alert.from_value(message.to_value()) == message


def test_wrong_field_is_named():
    """A value of another shape is refused, and the text names the field."""
    value = alert().to_value() | {"anomalous_seconds": "many"}
    with pytest.raises(MessageError, match="anomalous_seconds"):
        Alert.from_value(value)


def test_unknown_action_is_refused():
    """A decision can only be one of the four verbs."""
    decision = Decision(
        id="x", action="block", switch="s1", target=Target(kind="ip", address="10.0.0.1"),
        reason="r", event_time=1, expires=2,
    )  # fmt: skip
    with pytest.raises(MessageError, match="action"):
        Decision.from_value(decision.to_value() | {"action": "explode"})


def test_a_line_fit_for_a_log_is_no_copy() -> None:
    """Texts are kept in many places, and most have nothing that must not be shown."""
    text = f"sends to {len('hosts')} times more hosts"
    assert one_line(text) is text
    assert one_line("a\nb\x1b") == "a\\x0ab\\x1b"
