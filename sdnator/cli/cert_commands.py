"""`sdnator cert`: the CA and the certificates with which switches and their clients know each other."""

import json
import socket
from pathlib import Path
from typing import Annotated

import typer

from sdnator.up import running

FOLDER = "certificates"
_SWITCH = "switch"
_CLIENTS = ("controller", "operator", "viewer")
_LOOPBACK = ("localhost", "127.0.0.1", "::1")

app = typer.Typer(no_args_is_help=True, help="Certificates for P4Runtime over TCP.")

OutOption = Annotated[
    Path | None, typer.Option("--out", help="Folder; default: in the state folder.", metavar="DIR")
]
HostOption = Annotated[
    list[str] | None,
    typer.Option("--host", help="Name or address under which the switch is reached, one option each."),
]
DaysOption = Annotated[int, typer.Option(help="Days for which it is valid.", min=1, max=3650)]
JsonOption = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]


@app.command("init")
def cert_init(
    *,
    out: OutOption = None,
    host: HostOption = None,
    days: DaysOption = 825,
    as_json: JsonOption = False,
) -> None:
    """Create a CA, a certificate for switches, and one for each of the roles controller, operator and viewer.

    The switch's certificate is valid for this machine's name and loopback, and for each --host. Keys are files of mode
    0600; ca.key signs further certificates: keep it where no switch and no app can read it.

    Example: sdnator cert init --host s1.example.net --host 10.0.0.2
    """
    from sdnator.rights.certificates import CertificateFolder

    folder = _folder(out)
    made = CertificateFolder(folder)
    made.make_ca()
    made.issue(
        _SWITCH, hosts=tuple(dict.fromkeys((*_LOOPBACK, socket.gethostname(), *(host or ())))), days=days
    )
    for name in _CLIENTS:
        made.issue(name, days=days)
    if as_json:
        print(json.dumps({"folder": str(folder), "certificates": ["ca", _SWITCH, *_CLIENTS]}))
        return
    print(
        f"{folder} holds ca, {_SWITCH}, {', '.join(_CLIENTS)}: NAME.pem, and its key in NAME.key\n"
        "in sdnator.toml:\n"
        "[p4runtime_ctrl]\n"
        f'tls_ca = "{folder}/ca.pem"\n'
        f'tls_certificate = "{folder}/controller.pem"\n'
        f'tls_key = "{folder}/controller.key"\n'
        "and in [[switches]] of an embedded switch that listens on HOST:PORT:\n"
        f'tls_certificate = "{folder}/{_SWITCH}.pem"\n'
        f'tls_key = "{folder}/{_SWITCH}.key"'
    )


@app.command("add")
def cert_add(
    name: Annotated[str, typer.Argument(help="Its name (CN): the role of a client.", metavar="NAME")],
    *,
    out: OutOption = None,
    host: HostOption = None,
    days: DaysOption = 825,
    as_json: JsonOption = False,
) -> None:
    """Create one more certificate: a switch's with --host, otherwise a client's; one of that name is replaced.

    Example: sdnator cert add switch-2 --host 10.0.0.3
    """
    from sdnator.rights.certificates import CertificateFolder

    folder = _folder(out)
    CertificateFolder(folder).issue(name, hosts=host or (), days=days)
    if as_json:
        print(json.dumps({"folder": str(folder), "certificates": [name]}))
    else:
        print(f"{folder}/{name}.pem, and its key in {folder}/{name}.key")


def _folder(out: Path | None) -> Path:
    return (out if out is not None else running.state_folder() / FOLDER).absolute()
