"""Services are read from text, and wrong ones are named."""

import pytest

from apps.firewall.syn.services import TcpService
from apps.messages import Target


@pytest.mark.parametrize(
    ("text", "service"),
    [
        ("192.0.2.1:80", TcpService("192.0.2.1", 80)),
        ("[2001:DB8::0:1]:443", TcpService("2001:db8::1", 443)),
        ("2001:db8::1:443", TcpService("2001:db8::1", 443)),
    ],
)
def test_service_is_address_and_port(text, service):
    """IPv6 addresses are brought into one spelling."""
    assert TcpService.parse(text) == service


@pytest.mark.parametrize("text", ["192.0.2.1", "192.0.2.1:0", "192.0.2.1:65536", "web:80", ":80", ""])
def test_wrong_service_is_named(text):
    """The operator is told which text is wrong and what would do."""
    with pytest.raises(ValueError, match="ADDRESS:PORT"):
        TcpService.parse(text)


def test_text_and_target():
    """What is shown can be read again; decisions name address and port."""
    service = TcpService("2001:db8::1", 443)
    assert TcpService.parse(str(service)) == service
    assert service.target == Target(kind="ip", address="2001:db8::1", port=443)
