"""Services are read from text, and wrong ones are named."""

import pytest

from apps.firewall.services import Service
from apps.messages import Target


@pytest.mark.parametrize(
    ("text", "service"),
    [
        ("192.0.2.1:80", Service("192.0.2.1", 80)),
        ("[2001:DB8::0:1]:443", Service("2001:db8::1", 443)),
        ("2001:db8::1:443", Service("2001:db8::1", 443)),
    ],
)
def test_service_is_address_and_port(text, service):
    """IPv6 addresses are brought into one spelling."""
    assert Service.parse(text) == service


@pytest.mark.parametrize("text", ["192.0.2.1", "192.0.2.1:0", "192.0.2.1:65536", "web:80", ":80", ""])
def test_wrong_service_is_named(text):
    """The operator is told which text is wrong and what would do."""
    with pytest.raises(ValueError, match="ADDRESS:PORT"):
        Service.parse(text)


def test_text_and_target():
    """What is shown can be read again; decisions name address and port."""
    service = Service("2001:db8::1", 443)
    assert Service.parse(str(service)) == service
    assert service.target == Target(kind="ip", address="2001:db8::1", port=443)
