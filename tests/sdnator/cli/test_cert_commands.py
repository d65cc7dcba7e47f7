"""`sdnator cert`: keys that others cannot read, and certificates that a switch takes rights from."""

import json
import subprocess
import sys
from contextlib import contextmanager

import grpc
import pytest
from typer.testing import CliRunner

from p4rt import ChannelSecurity, P4RuntimeStub, open_channel, p4runtime
from sdnator.cli.cert_commands import app
from sdnator.cli.switch_place import place_of
from sdnator.errors import BadInput

TIMEOUT_S = 60
NAMES = ("ca", "switch", "controller", "operator", "viewer")


def run(*arguments: str) -> str:
    done = CliRunner().invoke(app, arguments)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("cert") / "certificates"
    said = json.loads(run("init", "--out", str(made), "--json"))
    assert (said["folder"], said["certificates"]) == (str(made), list(NAMES))
    run("add", "packets", "--out", str(made))
    return made


def security(folder, name):
    return ChannelSecurity(
        ca=f"{folder}/ca.pem", certificate=f"{folder}/{name}.pem", key=f"{folder}/{name}.key"
    )


@contextmanager
def switch(folder, *more):
    files = {"cert": "switch.pem", "key": "switch.key", "client-ca": "ca.pem"}
    options = [part for name, file in files.items() for part in (f"--tls-{name}", str(folder / file))]
    command = [
        sys.executable,
        "-m",
        "dataplane",
        "--grpc",
        "127.0.0.1:0",
        *options,
        *more,
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            yield json.loads(process.stdout.readline())["grpc"]
        finally:
            process.terminate()


@pytest.fixture(scope="module")
def address(folder):
    rights = (
        "controller=tables,packet-out,pipeline",
        "operator=tables,packet-out",
        "viewer=",
        "packets=packet-out",
    )
    with switch(folder, *(part for each in rights for part in ("--tls-rights", each))) as where:
        yield where


def test_keys_are_their_owners_alone_and_nothing_is_replaced(folder):
    assert folder.stat().st_mode & 0o777 == 0o700
    assert {path.name for path in folder.iterdir()} == {
        f"{name}.{kind}" for name in (*NAMES, "packets") for kind in ("key", "pem")
    }
    assert {path.stat().st_mode & 0o777 for path in folder.iterdir()} == {0o600}
    before = (folder / "ca.key").read_bytes()
    with pytest.raises(BadInput, match="already holds a CA"):
        run("init", "--out", str(folder))
    assert (folder / "ca.key").read_bytes() == before


def test_openssl_finds_the_chain_good(folder):
    for name in (*NAMES[1:], "packets"):
        purpose = "sslserver" if name == "switch" else "sslclient"
        command = [
            "openssl",
            "verify",
            "-x509_strict",
            "-purpose",
            purpose,
            "-CAfile",
            folder / "ca.pem",
            folder / f"{name}.pem",
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("ca",), "is not ca"),
        (("a b",), "64 letters"),
        (("../x",), "64 letters"),
        (("s", "--host", "ü"), "--host"),
    ],
)
def test_what_no_certificate_can_be_is_misuse(folder, arguments, text):
    with pytest.raises(BadInput, match=text):
        run("add", *arguments, "--out", str(folder))


def test_without_a_ca_the_command_that_makes_one_is_named(tmp_path):
    with pytest.raises(BadInput, match="sdnator cert init"):
        run("add", "x", "--out", str(tmp_path))


class Client:
    """What one certificate may do at a switch; each deed returns the code of its answer."""

    def __init__(self, folder, name, address):
        self._channel = open_channel(address, security(folder, name))
        self._stub = P4RuntimeStub(self._channel)
        self._next = 1

    def close(self):
        self._channel.close()

    def _code(self, deed):
        try:
            deed()
        except grpc.RpcError as error:
            return error.code().name
        return "OK"

    def read(self):
        return self._code(lambda: self._stub.Capabilities(p4runtime.CapabilitiesRequest(), timeout=TIMEOUT_S))

    def write(self):
        """Nobody is primary: who has the right is told so."""
        request = p4runtime.WriteRequest(device_id=1)
        request.updates.add(type=p4runtime.Update.INSERT)
        try:
            self._stub.Write(request, timeout=TIMEOUT_S)
        except grpc.RpcError as error:
            return "no right" if "does not give the right" in (error.details() or "") else "no primary"
        return "OK"

    def set_pipeline(self):
        request = p4runtime.SetForwardingPipelineConfigRequest(device_id=1)
        try:
            self._stub.SetForwardingPipelineConfig(request, timeout=TIMEOUT_S)
        except grpc.RpcError as error:
            return "no right" if "does not give the right" in (error.details() or "") else "no primary"
        return "OK"

    def stream(self, role="", *, packet=False):
        """What a stream's first answers are: `primary`, an error of the packet, or the code that ended it."""
        claim = p4runtime.StreamMessageRequest()
        claim.arbitration.device_id = 1
        claim.arbitration.role.name = role
        claim.arbitration.election_id.low = self._next
        self._next += 1
        sent = [claim]
        if packet:
            sent.append(p4runtime.StreamMessageRequest())
            sent[1].packet.payload = b"x" * 60
        found = []
        try:
            for answer in self._stub.StreamChannel(iter(sent), timeout=TIMEOUT_S):
                kind = answer.WhichOneof("update")
                found.append(answer.error.message if kind == "error" else kind)
        except grpc.RpcError as error:
            found.append(error.code().name)
        return found


@pytest.fixture
def client(folder, address):
    made = []

    def of(name):
        made.append(Client(folder, name, address))
        return made[-1]

    yield of
    for each in made:
        each.close()


def test_the_name_of_the_certificate_decides(client):
    controller, operator, viewer, packets = map(client, ("controller", "operator", "viewer", "packets"))
    assert [each.read() for each in (controller, operator, viewer, packets)] == ["OK"] * 4
    assert [each.write() for each in (controller, operator, viewer, packets)] == [
        *("no primary", "no primary"), *("no right", "no right"),
    ]  # fmt: skip
    assert [each.set_pipeline() for each in (controller, operator, viewer, packets)] == [
        *("no primary", "no right"), *("no right", "no right"),
    ]  # fmt: skip


def test_who_may_only_read_takes_no_controllers_place(client):
    assert client("viewer").stream() == ["PERMISSION_DENIED"]
    assert client("packets").stream() == ["PERMISSION_DENIED"], "the default role is the controllers'"
    assert client("packets").stream("packets")[0] == "arbitration"
    assert client("controller").stream()[0] == "arbitration"


def test_a_packet_needs_its_right(folder):
    with switch(folder, "--tls-rights", "viewer=tables") as where:
        viewer = Client(folder, "viewer", where)
        said = viewer.stream(packet=True)
        viewer.close()
    assert said[0] == "arbitration"
    assert "does not give the right 'packet-out'" in said[1]


def test_a_name_without_rights_and_a_client_without_certificate_get_nothing(folder, address):
    run("add", "stranger", "--out", str(folder))
    stranger = Client(folder, "stranger", address)
    assert (stranger.read(), stranger.stream()) == ("PERMISSION_DENIED", ["PERMISSION_DENIED"])
    stranger.close()
    with open_channel(address, ChannelSecurity(ca=f"{folder}/ca.pem")) as channel:
        with pytest.raises(grpc.RpcError) as caught:
            P4RuntimeStub(channel).Capabilities(p4runtime.CapabilitiesRequest(), timeout=5)
        assert caught.value.code().name == "UNAVAILABLE"
    (folder / "stranger.pem").unlink()
    (folder / "stranger.key").unlink()


def test_a_server_on_tcp_asks_for_certificates_or_says_what_to_give(folder):
    for options, text in (
        ((), "--tls-client-ca"),
        (
            ("--tls-cert", str(folder / "switch.pem"), "--tls-key", str(folder / "switch.key")),
            "--tls-client-ca",
        ),
        (("--insecure", "--tls-client-ca", str(folder / "ca.pem")), "needs --tls-cert"),
    ):
        command = [sys.executable, "-m", "dataplane", "--grpc", "127.0.0.1:0", *options]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=TIMEOUT_S)
        assert (done.returncode, text in done.stderr) == (2, True), done.stderr


def test_commands_take_tls_from_the_configuration(folder, address, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BadInput, match=r"tls_ca.*--insecure"):
        place_of(address, 1)
    assert place_of(address, 1, insecure=True).security == ChannelSecurity(insecure=True)
    config = tmp_path / "sdnator" / "sdnator.toml"
    config.parent.mkdir()
    config.write_text(
        f'[p4runtime_ctrl]\ntls_ca = "{folder}/ca.pem"\ntls_certificate = "{folder}/viewer.pem"\n'
        f'tls_key = "{folder}/viewer.key"\n\n[[switches]]\nkind = "192.0.2.1:9559"\ninsecure = true\n'
    )
    assert place_of("192.0.2.1:9559", 1).security == ChannelSecurity(insecure=True)
    place = place_of(address, 1)
    with open_channel(place.address, place.security) as channel:
        said = P4RuntimeStub(channel).Capabilities(p4runtime.CapabilitiesRequest(), timeout=TIMEOUT_S)
    assert said.p4runtime_api_version == "1.4.0"
