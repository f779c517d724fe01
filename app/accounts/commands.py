"""Commands of accounts: `betaloop user add` and `betaloop token create`."""

from __future__ import annotations

import sys
from getpass import getpass
from pathlib import Path
from typing import Annotated

import typer

from app.accounts import service as accounts
from app.platform.database import transaction
from app.platform.terminal import ACTOR, AsJson, bad_call, reason, show
from app.tables.accounts import Role, Scope

user_app = typer.Typer(no_args_is_help=True, help="Users.")
token_app = typer.Typer(no_args_is_help=True, help="API tokens.")


@user_app.command("add", epilog="Example: betaloop user add ada@clinic.example --role clinician --site north")
def user_add(
    email: Annotated[str, typer.Argument(help="E-mail address to sign in with.")],
    role: Annotated[Role, typer.Option(help=", ".join(Role))],
    study: Annotated[str | None, typer.Option(help="Code of the study, where there are several.")] = None,
    site: Annotated[str | None, typer.Option(help="Code of the only site that the user sees; all sites by default.")] = None,
    password_file: Annotated[Path | None, typer.Option(help="File with the password; asked for when left out ('-': stdin).")] = None,
    as_json: AsJson = False,
) -> None:
    """Add a user with a role in a study."""
    password = _password(password_file)
    with transaction(ACTOR) as db:
        user = accounts.add_user(db, email, role, password, study, site_code=site)
        result = {"id": user.id, "email": user.email, "role": role.value, "site": site}
        words = accounts.roles_in_words(db, user, accounts.study_of(db, study))
    show(result, as_json, f"Added. {words}")


@token_app.command("create", epilog="Example: betaloop token create ada@clinic.example --name upload-tablet")
def token_create(
    email: Annotated[str, typer.Argument(help="E-mail address of the user.")],
    name: Annotated[str, typer.Option(help="What will use the token.")],
    scope: Annotated[Scope, typer.Option(help="What it may do of what the user may.")] = Scope.FULL,
    days: Annotated[int, typer.Option(help="Days after which it ends.")] = accounts.TOKEN_DAYS,
    as_json: AsJson = False,
) -> None:
    """Make an API token and print it; it is shown this once."""
    with transaction(ACTOR) as db:
        token = accounts.create_token(db, email, name, scope, days)
    show({"email": email, "name": name, "token": token}, as_json, token)


def _password(path: Path | None) -> str:
    if path is None:
        if not sys.stdin.isatty():
            raise typer.BadParameter("No terminal to ask for a password.", param_hint="--password-file")
        return getpass("Password: ")
    if str(path) == "-":
        return sys.stdin.readline().rstrip("\r\n")
    try:
        return path.read_text("utf-8").rstrip("\r\n")
    except (OSError, UnicodeDecodeError) as error:
        raise bad_call(f"The password file {path} cannot be read: {reason(error)}.") from error
