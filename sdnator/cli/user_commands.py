"""`sdnator user`: who may sign in to the dashboard, and as what."""

import json
import sys
import time
from typing import Annotated

import typer

from sdnator.cli.plain_table import plain_table
from sdnator.errors import BadInput, PipelineError
from sdnator.rights.audit_trail import note
from sdnator.rights.sign_in_link import new_link
from sdnator.rights.users import MOST, UserRole, Users
from sdnator.up import running

app = typer.Typer(no_args_is_help=True, help="Who may sign in to the dashboard, and as what.")

NameArgument = Annotated[str, typer.Argument(metavar="NAME")]
StdinOption = Annotated[
    bool, typer.Option("--password-stdin", help="Read the password from the first line of standard input.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]


@app.command("add")
def user_add(
    name: NameArgument,
    *,
    role: Annotated[
        str, typer.Option(help="viewer: may look; operator: may also undo blocks and allow addresses.")
    ] = "viewer",
    password_stdin: StdinOption = False,
) -> None:
    """Let somebody sign in, at once; asks for the password.

    Example: sdnator user add ada --role operator
    """
    if role not in ("viewer", "operator"):
        raise BadInput(f"--role {role}: give viewer or operator")
    chosen: UserRole = "operator" if role == "operator" else "viewer"
    Users(running.state_folder()).add(name, chosen, _password(stdin=password_stdin))
    note(f"added user {name}, {role}")
    print(f"{name} may sign in as {role}")


@app.command("list")
def user_list(*, as_json: JsonOption = False) -> None:
    """Show who may sign in.

    Example: sdnator user list
    """
    found = Users(running.state_folder()).all
    if as_json:
        users = [{"name": name, "role": one.role, "changed": one.changed} for name, one in found.items()]
        print(json.dumps({"users": users}))
        return
    rows = (
        (name, one.role, time.strftime("%Y-%m-%d %H:%M", time.localtime(one.changed / 1e9)))
        for name, one in sorted(found.items())
    )
    print(plain_table(("name", "role", "password since"), rows))


@app.command("passwd")
def user_passwd(name: NameArgument, *, password_stdin: StdinOption = False) -> None:
    """Change a password; the user's sessions end.

    Example: sdnator user passwd ada
    """
    Users(running.state_folder()).change_password(name, _password(stdin=password_stdin))
    note(f"changed the password of user {name}")
    print(f"{name} now signs in with the new password")


@app.command("remove")
def user_remove(name: NameArgument) -> None:
    """Withdraw somebody's sign-in; the user's sessions end.

    Example: sdnator user remove ada
    """
    Users(running.state_folder()).remove(name)
    note(f"removed user {name}")
    print(f"{name} can no longer sign in")


@app.command("link")
def user_link() -> None:
    """Print a link that signs you in once, as `sdnator up` does on a terminal.

    Example: sdnator user link
    """
    found = running.need()
    if not found.dashboard:
        raise PipelineError("the pipeline serves no dashboard: start it without --no-dashboard")
    try:
        link = new_link(running.state_folder(), found.dashboard)
    except OSError as error:
        raise PipelineError(
            f"{error.filename}: cannot be written ({error.strerror}); check its permissions"
        ) from None
    note("created a link that signs in as the owner")
    print(link)


def _password(*, stdin: bool) -> str:
    if stdin:
        return sys.stdin.readline(4 * MOST).rstrip("\r\n")
    return str(typer.prompt("Password", hide_input=True, confirmation_prompt=True))
