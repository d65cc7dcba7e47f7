"""Calls to a switch over TLS: who is not known to the other side gets nowhere; errors name the file."""

import subprocess

import msgspec
import pytest

from apps.p4runtime_ctrl.errors import P4InfoError
from apps.p4runtime_ctrl.settings import Settings, SwitchSettings
from apps.p4runtime_ctrl.southbound.connection import Connection
from apps.p4runtime_ctrl.southbound.session import Address, CompiledProgram, address_of
from p4rt import INSECURE, ChannelSecurity
from sdnator.testing.product_program import PROGRAM, pipeline, program
from sdnator.testing.switch_target import SwitchTarget
from tests.apps.p4runtime_ctrl.southbound.test_connection import Listener
from tests.requirements import require_program


@pytest.fixture
def certificate(tmp_path):
    """A self-signed certificate for the loopback address: its own CA."""
    certificate, key = tmp_path / "tls.pem", tmp_path / "tls.key"
    subprocess.run(
        [require_program("openssl"), "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1",
         "-nodes", "-days", "1", "-subj", "/CN=controller", "-addext", "subjectAltName=IP:127.0.0.1",
         "-keyout", str(key), "-out", str(certificate)],
        check=True, capture_output=True,
    )  # fmt: skip
    return str(certificate), str(key)


@pytest.fixture
def target(certificate, tmp_path):
    ca, key = certificate
    options = ("--tls-cert", ca, "--tls-key", key, "--tls-client-ca", ca)
    made = SwitchTarget("embedded", tmp_path, more=options)
    made.start()
    yield made
    made.stop()


def connected(target, listener, security):
    made = Connection(Address(target.address, 1, 1, security=security), pipeline(), listener)
    made.open()
    return made


def test_both_sides_show_a_certificate(target, certificate):
    ca, key = certificate
    listener = Listener()
    connection = connected(target, listener, ChannelSecurity(ca=ca, certificate=ca, key=key))
    listener.until(lambda: listener.sessions)
    assert listener.sessions[0].alive() == "1.4.0"
    connection.close()


@pytest.mark.parametrize("with_ca", [True, False])
def test_who_shows_none_gets_nowhere(target, certificate, with_ca):
    listener = Listener()
    connection = connected(target, listener, ChannelSecurity(ca=certificate[0]) if with_ca else INSECURE)
    listener.until(lambda: listener.lost_causes)
    assert not listener.sessions
    connection.close()


def settings(**options):
    switch = SwitchSettings(name="s1", address="127.0.0.1:1", insecure=options.pop("insecure", False))
    return Settings(switches=(switch,), program="", p4info="", **options), switch


@pytest.mark.parametrize("target", ["embedded", "bmv2", ""])
def test_the_embedded_switch_forgets_digests_of_frames(target):
    chosen, switch = settings(insecure=True)
    assert address_of(chosen, msgspec.structs.replace(switch, target=target)).remembers == (
        target != "embedded"
    )


def test_a_missing_file_is_named():
    with pytest.raises(P4InfoError, match=r"TLS file /nowhere/ca\.pem: No such file"):
        address_of(*settings(tls_ca="/nowhere/ca.pem"))


def test_a_tcp_address_without_tls_is_refused_with_what_to_write():
    with pytest.raises(P4InfoError, match=r"127\.0\.0\.1:1: .*tls_ca.*sdnator cert init.*insecure = true"):
        address_of(*settings())
    assert address_of(*settings(insecure=True)).security == INSECURE


def test_programs_are_told_apart_by_their_cookie():
    one = CompiledProgram(PROGRAM.read_bytes(), program().message)
    other = CompiledProgram(PROGRAM.read_bytes() + b" ", program().message)
    assert one.cookie == CompiledProgram(PROGRAM.read_bytes(), program().message).cookie
    assert one.cookie != other.cookie
    assert 0 < one.cookie < 1 << 63
