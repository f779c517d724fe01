"""Commands of accounts: `betaloop user add` and `betaloop token create`."""

from __future__ import annotations

import sys
from getpass import getpass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer
from pydantic import BaseModel, ValidationError

from app.accounts import repository, second_factor, studies
from app.accounts import service as accounts
from app.accounts.permissions import SYSTEM
from app.accounts.sign_on import remove_links
from app.accounts.studies import HINT, NameChange, SiteIn, StudyChange, StudyIn
from app.platform.database import now, transaction
from app.platform.errors import Invalid, NotFound
from app.platform.terminal import ACTOR, AsJson, Why, bad_call, reason, show
from app.tables.accounts import Role, Scope

FIRST_ACCOUNT = "No account exists yet. Make the first one on this machine: betaloop user add YOU@CLINIC.EXAMPLE --role admin"


def say_how_to_begin() -> None:
    """Print how the first account is made, where there is none."""
    with transaction(ACTOR) as db:
        if not repository.has_users(db):
            typer.echo(FIRST_ACCOUNT)


user_app = typer.Typer(no_args_is_help=True, help="Users.")
token_app = typer.Typer(no_args_is_help=True, help="API tokens.")


@user_app.command("add", epilog="Example: betaloop user add ada@clinic.example --role clinician --site north")
def user_add(
    email: Annotated[str, typer.Argument(help="E-mail address to sign in with.")],
    role: Annotated[Role, typer.Option(help=", ".join(Role))],
    study: Annotated[str | None, typer.Option(help="Code of the study, where there are several.")] = None,
    site: Annotated[str | None, typer.Option(help="Code of the only site that the user sees; all sites by default.")] = None,
    password_file: Annotated[Path | None, typer.Option(help="File with the password; asked for when omitted ('-': stdin).")] = None,
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


# Commands of studies, sites and users: `betaloop study add`, `study site`, `study rename`, `user role` and others.

Draft = TypeVar("Draft", bound=BaseModel)


def study_add(
    code: Annotated[str, typer.Argument(help="Code of the new study.")],
    name: Annotated[str, typer.Option(help="Its name.")],
    site: Annotated[str | None, typer.Option(help="Code of its first site; the study's by default.")] = None,
    prefix: Annotated[str | None, typer.Option(help="Of its participants' codes; code and hyphen by default.")] = None,
    as_json: AsJson = False,
) -> None:
    """Add a study with its first site."""
    draft = _checked(StudyIn, code=code, name=name, site={"code": site or code, "name": name}, code_prefix=prefix)
    with transaction(ACTOR) as db:
        begins = studies.add_study(db, draft, SYSTEM).code_prefix
    codes = f", of whose participants codes begin with {begins}" if begins else ""
    said = (
        f"Added study {code}{codes}. Nobody works in it yet: give somebody a role with `betaloop user role EMAIL admin --study {code}`. "
        "The audit trail, which covers all studies, is read by who has a role with that right in each of them."
    )
    show({"code": code, "site": site or code, "code_prefix": begins}, as_json, said)


def study_site(
    code: Annotated[str, typer.Argument(help="Code of the study.")],
    site: Annotated[str, typer.Argument(help="Code of the new site.")],
    name: Annotated[str, typer.Option(help="Its name.")],
    as_json: AsJson = False,
) -> None:
    """Add a site to a study."""
    draft = _checked(SiteIn, code=site, name=name)
    with transaction(ACTOR) as db:
        studies.add_site(db, studies.study_to_manage(db, code, SYSTEM), draft)
    show({"study": code, "site": site}, as_json, f"Added site {site} to study {code}.")


def study_rename(
    code: Annotated[str, typer.Argument(help="Code of the study.")],
    name: Annotated[str, typer.Option(help="Its new name; the code stays.")],
    reason: Why,
    site: Annotated[str | None, typer.Option(help="Code of a site; the study itself by default.")] = None,
    as_json: AsJson = False,
) -> None:
    """Give a study or a site another name."""
    with transaction(ACTOR) as db:
        study = studies.study_to_manage(db, code, SYSTEM)
        if site is None:
            studies.change_study(db, study, _checked(StudyChange, name=name, reason=reason), SYSTEM)
        else:
            change = _checked(NameChange, name=name, reason=reason)
            studies.rename_site(db, study, site, change.name, change.reason)
    show(
        {"study": code, "site": site, "name": name}, as_json, f"{f'Study {code}' if site is None else f'Site {site}'} is called {name} now."
    )


def study_prefix(
    code: Annotated[str, typer.Argument(help="Code of a study that has no prefix.")],
    prefix: Annotated[str, typer.Argument(help="What codes of its participants begin with from now on.")],
    reason: Why,
    as_json: AsJson = False,
) -> None:
    """Set the prefix of new participants' codes in a study, so that they are never compared with those of other studies."""
    with transaction(ACTOR) as db:
        change = _checked(StudyChange, code_prefix=prefix, reason=reason)
        studies.change_study(db, studies.study_to_manage(db, code, SYSTEM), change, SYSTEM)
    show({"study": code, "code_prefix": prefix}, as_json, f"Codes of new participants of study {code} begin with {prefix}.")


def user_role(
    email: Annotated[str, typer.Argument(help="E-mail address of the user.")],
    role: Annotated[str, typer.Argument(help="A role, or 'none' to end the one that the user has there.")],
    study: Annotated[str | None, typer.Option(help="Code of the study, where there are several.")] = None,
    site: Annotated[str | None, typer.Option(help="Code of the site; all sites by default.")] = None,
    also: Annotated[bool, typer.Option("--also", help="Keep a role at all sites besides this one at a single site.")] = False,
    as_json: AsJson = False,
) -> None:
    """Give a user a role in a study, or end it. A role at one site ends one at all sites, unless --also is given."""
    if role not in {*Role, "none"}:
        raise Invalid(f"{role!r} is no role.", f"Known: {', '.join(Role)}, none.")
    with transaction(ACTOR) as db:
        where = accounts.study_of(db, study)
        if role == "none":
            studies.end_membership(db, where, email, site, SYSTEM)
        else:
            studies.grant(db, where, email, Role(role), site, SYSTEM, also=also)
        result = {"email": email, "role": role, "study": where.code, "site": site}
        words = accounts.roles_in_words(db, studies.user_of(db, email), where)
    show(result, as_json, words)


def user_remove_second_factor(email: Annotated[str, typer.Argument(help="E-mail address of the user.")], as_json: AsJson = False) -> None:
    """Take a user's second factor away, for one who has lost phone and recovery codes. Make sure who asks."""
    with transaction(ACTOR) as db:
        user = repository.user_by_email(db, email)
        if user is None:
            raise NotFound(f"There is no user {email}.")
        had = second_factor.remove(db, user.id)
    said = f"{email} signs in with the password alone now." if had else f"{email} has no second factor."
    show({"email": email, "removed": had}, as_json, said)


def user_remove_sign_on(email: Annotated[str, typer.Argument(help="E-mail address of the user.")], as_json: AsJson = False) -> None:
    """Forget who a user is at the hospital's sign-on, where the hospital has given them another identity. Make sure who asks."""
    with transaction(ACTOR) as db:
        user = repository.user_by_email(db, email)
        if user is None:
            raise NotFound(f"There is no user {email}.")
        had = remove_links(db, user.id)
        for opened in repository.open_sign_ins(db, user.id):
            opened.confirmed_at = None
            if opened.issuer is not None:
                opened.ended_at = now()
    said = f"The next sign-on that vouches for {email} is linked." if had else f"{email} is linked with no sign-on."
    show({"email": email, "removed": had}, as_json, said)


def register(study: typer.Typer, user: typer.Typer) -> None:
    """Put the commands where people look for them."""
    study.command("add", epilog="Example: betaloop study add ADAPT --name 'Adaptive DBS' --site north")(study_add)
    study.command("rename", epilog="Example: betaloop study rename ADAPT --name 'Adaptive DBS' --reason 'protocol 2'")(study_rename)
    study.command("prefix", epilog="Example: betaloop study prefix ADAPT A- --reason 'codes of their own'")(study_prefix)
    study.command("site", epilog="Example: betaloop study site ADAPT south --name 'Clinic South'")(study_site)
    user.command("role", epilog="Example: betaloop user role ada@clinic.example coordinator --study ADAPT --site north")(user_role)
    example = "Example: betaloop user remove-second-factor ada@clinic.example"
    user.command("remove-second-factor", epilog=example)(user_remove_second_factor)
    user.command("remove-sign-on", epilog="Example: betaloop user remove-sign-on ada@clinic.example")(user_remove_sign_on)


def _checked(kind: type[Draft], **values: Any) -> Draft:
    try:
        return kind(**values)
    except ValidationError as error:
        first = error.errors()[0]
        where = " ".join(map(str, first["loc"]))
        raise Invalid(f"The {where}: {first['msg']}.", HINT) from error
