"""HTML pages of accounts: sign in and out, one's own password and tokens, the users of a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session
from starlette.datastructures import FormData

from app.accounts import permissions as can
from app.accounts import repository, second_factor, service
from app.accounts.deps import COOKIE, SIGNED_OUT, CurrentCaller, count_try, failed_sign_ins, local_path, signed_in
from app.accounts.passwords import AT_ONCE, MIN_PASSWORD
from app.accounts.permissions import Caller
from app.platform.database import Db, now, set_actor, transaction
from app.platform.errors import BetaloopError, Invalid, NotFound, TooMany, about
from app.platform.web.forms import FormValues, field_notes
from app.platform.web.schemas import RowId
from app.platform.web.sources import Bounded
from app.platform.web.templates import render
from app.settings import get_settings
from app.tables.accounts import Role, Scope, User

router = APIRouter()

SCOPE_NAMES = {
    Scope.FULL: "all that I may",
    Scope.READ: "read",
    Scope.UPLOAD: "upload and read",
    Scope.JOBS: "jobs and read",
    Scope.METRICS: "figures of the service alone",
}
_A_DAY_S = 86_400
_passwords = Bounded(AT_ONCE, 100)  # in threads of their own, so that those who wait hold up nothing else


@router.get("/sign-in")
def sign_in_page(request: Request, db: Db, next: str = "/") -> Response:
    """Show the sign-in form; a user who is signed in already goes on."""
    token = request.cookies.get(COOKIE)
    if token and service.caller_of_cookie(db, token):
        return RedirectResponse(local_path(next), 303)
    return HTMLResponse(
        render(request, "accounts/sign_in.html", problem=None, email="", next=local_path(next), first=not repository.has_users(db))
    )


@router.post("/sign-in")
async def sign_in(request: Request, values: FormValues) -> Response:
    """Open a browser session."""
    try:
        source = count_try(request)
        answer = await _passwords.run(_sign_in, request, values)
    except TooMany as error:
        return _sign_in_refused(request, values, error)
    except DBAPIError:
        failed_sign_ins.give_back(source)  # no verdict was given
        raise
    if answer.status_code == 303:
        failed_sign_ins.give_back(source)
    return answer


def _sign_in(request: Request, values: FormData) -> Response:
    email, target = str(values.get("email", "")), local_path(str(values.get("next", "/")))
    try:
        with transaction() as db:
            set_actor(db, "unknown", request_id=request.state.request_id)  # the owner of a typed address has done nothing yet
            token = service.sign_in(db, email, str(values.get("password", "")), str(values.get("code", "")))
    except BetaloopError as error:
        return _sign_in_refused(request, values, error)
    return signed_in(token, target)


def _sign_in_refused(request: Request, values: FormData, error: BetaloopError) -> Response:
    email, target = str(values.get("email", "")), local_path(str(values.get("next", "/")))
    page = render(request, "accounts/sign_in.html", problem=error.problem(request.url.path), email=email, next=target, first=False)
    headers = {"Retry-After": str(error.retry_after_s)} if isinstance(error, TooMany) else {}
    return HTMLResponse(page, error.status, headers)


@router.post("/sign-out")
def sign_out(request: Request, db: Db) -> Response:
    """End the browser session, here and on the server."""
    if token := request.cookies.get(COOKIE):
        if caller := service.caller_of_cookie(db, token):
            set_actor(db, caller.label, caller.user_id, request.state.request_id)
        service.sign_out(db, token)
    answer = RedirectResponse("/sign-in?done=out", 303)
    answer.delete_cookie(COOKIE, httponly=True, samesite="lax", secure=get_settings().cookie_secure)
    if get_settings().oidc_issuer:
        secure = get_settings().cookie_secure
        answer.set_cookie(SIGNED_OUT, "yes", max_age=_A_DAY_S, path="/sign-on", httponly=True, samesite="lax", secure=secure)
    return answer


@router.get("/account")
def account(request: Request, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show one's own access."""
    return _account_page(request, db, caller)


@router.post("/account/password")
def change_password(request: Request, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Change one's password; every browser session ends, also this one."""
    caller.require_browser()
    try:
        if values.get("password") != values.get("again"):
            raise Invalid("The two new passwords differ.", "Type the same one twice.", field="again")
        present, new, code = (str(values.get(name, "")) for name in ("present", "password", "code"))
        service.change_own_password(db, _own_id(caller), present, new, code)
    except BetaloopError as error:
        db.rollback()
        return _account_page(request, db, caller, error, refused=("password", {}))
    return RedirectResponse("/sign-in?done=password", 303)


@router.post("/account/second-factor")
def begin_second_factor(request: Request, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Begin to set up an authenticator app, with the password; the page shows its key until a code of it was given."""
    caller.require_browser()
    try:
        # else a person who finds a browser signed in could shut its user out
        with about("present"):
            service.confirm_password(_own_id(caller), str(values.get("present", "")))
        second_factor.begin(db, db.get_one(User, _own_id(caller)))
    except BetaloopError as error:
        db.rollback()
        return _account_page(request, db, caller, error, refused=("begin", {}))
    return RedirectResponse("/account#second-factor", 303)


@router.post("/account/second-factor/confirm")
def confirm_second_factor(request: Request, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Switch the second factor on with a first code, and show the recovery codes this once."""
    caller.require_browser()
    try:
        codes = second_factor.confirm(db, db.get_one(User, _own_id(caller)), str(values.get("code", "")))
    except BetaloopError as error:
        db.rollback()
        return _account_page(request, db, caller, error, refused=("confirm", {}))
    return _account_page(request, db, caller, codes=codes)


@router.post("/account/second-factor/remove")
def remove_second_factor(request: Request, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Switch the second factor off with password and code; wrong ones are counted together with sign-ins."""
    caller.require_browser()
    try:
        with about("present"):
            service.confirm_password(_own_id(caller), str(values.get("present", "")), str(values.get("code", "")))
        second_factor.remove(db, _own_id(caller))
    except BetaloopError as error:
        db.rollback()
        return _account_page(request, db, caller, error, refused=("remove", {}))
    return RedirectResponse("/account?done=factor", 303)


@router.post("/account/tokens")
def create_token(request: Request, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Make an API token and show it this once."""
    caller.require_browser()
    try:
        token = service.create_token(db, caller.label, str(values.get("name", "")), _scope(values), _days(values))
    except BetaloopError as error:
        db.rollback()
        return _account_page(request, db, caller, error, refused=("token", values))
    return _account_page(request, db, caller, token=token)


@router.post("/account/tokens/{token_id}/revoke")
def revoke_token(token_id: RowId, db: Db, caller: CurrentCaller) -> Response:
    """End one of one's own tokens."""
    caller.require_browser()
    service.revoke_token(db, _own_id(caller), token_id)
    return RedirectResponse("/account?done=revoked", 303)


@router.get("/accounts")
def accounts(request: Request, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show the users of the studies that the caller administers."""
    caller.require(can.MANAGE_ACCOUNTS)
    return _accounts_page(request, db, caller)


@router.post("/accounts")
def add_user(request: Request, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Add a user to the study."""
    caller.require_browser()
    fields = {name: str(values.get(name, "")) for name in ("email", "name", "role", "study", "site")}
    try:
        caller.require(can.MANAGE_ACCOUNTS)
        mine = [s.code for s in repository.studies(db) if service.administers(caller, s.id)]
        study = fields["study"] or (mine[0] if len(mine) == 1 else "")
        if study not in mine:
            raise NotFound("There is no such study, or you do not administer it.", field="study")
        if fields["role"] not in set(Role):
            raise Invalid("Choose a role.", f"Known: {', '.join(Role)}.", field="role")
        password = str(values.get("password", ""))
        service.add_user(db, fields["email"], Role(fields["role"]), password, study, fields["name"].strip()[:200], fields["site"].strip())
    except BetaloopError as error:
        db.rollback()
        return _accounts_page(request, db, caller, error, fields)
    return RedirectResponse("/accounts?done=added", 303)


@router.post("/accounts/{user_id}/password")
def reset_password(request: Request, user_id: RowId, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Give a user a new password; the user's browser sessions end."""
    user = _managed_user(db, caller, user_id)
    try:
        service.set_password(db, user, str(values.get("password", "")))
    except BetaloopError as error:
        db.rollback()
        return _accounts_page(request, db, caller, error, refused=f"user-{user_id}")
    return RedirectResponse("/accounts?done=password", 303)


@router.post("/accounts/{user_id}/active")
def set_active(user_id: RowId, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Shut a user out, or let the user in again."""
    active = values.get("active") == "yes"
    service.set_active(db, _managed_user(db, caller, user_id), active, caller)
    return RedirectResponse(f"/accounts?done={'opened' if active else 'closed'}", 303)


def _scope(values: FormData) -> Scope:
    scope = str(values.get("scope", Scope.FULL))
    if scope not in set(Scope):
        raise Invalid("Choose what the token may do.", f"Known: {', '.join(Scope)}.", field="scope")
    return Scope(scope)


def _days(values: FormData) -> int:
    text = str(values.get("days", service.TOKEN_DAYS)).strip()
    if not text.isdecimal():
        raise Invalid(f"'{text[:20]}' is no number of days.", f"Give 1 to {service.MOST_TOKEN_DAYS}.", field="days")
    return int(text[:6])


def _own_id(caller: Caller) -> int:
    if caller.user_id is None:
        raise NotFound("The system itself has no account.")
    return caller.user_id


def _managed_user(db: Session, caller: Caller, user_id: int) -> User:
    caller.require_browser()
    caller.require(can.MANAGE_ACCOUNTS)
    user = db.get(User, user_id)
    if user is None or not service.manages(caller, user):
        raise NotFound("There is no such user, or you do not administer all of its studies.")
    return user


def _factor(db: Session, user: User) -> dict[str, Any]:
    """Collect what the account's page shows of the second factor; the secret while it is being set up, in groups to type."""
    secret = second_factor.pending_secret(db, user.id)
    shown = second_factor.base32(secret) if secret else ""
    return {
        "on": second_factor.wanted(db, user.id),
        "secret": " ".join(shown[i : i + 4] for i in range(0, len(shown), 4)),
        "address": second_factor.address(secret, user.email) if secret else "",
        "recovery": second_factor.RECOVERY_CODES,
        "recovery_left": second_factor.recovery_codes_left(db, user.id),
    }


def _account_page(
    request: Request,
    db: Session,
    caller: Caller,
    error: BetaloopError | None = None,
    token: str = "",
    codes: Sequence[str] = (),
    refused: tuple[str, Mapping[str, Any]] = ("", {}),
) -> HTMLResponse:
    """Show one's own access; `refused` is the form that `error` is about, and what was typed into it."""
    user = db.get_one(User, _own_id(caller))
    values = {"user": user, "tokens": repository.tokens_of(db, user.id), "token": token, "min_password": MIN_PASSWORD}
    values |= {"factor": _factor(db, user), "codes": codes}
    values |= {"sign_on_links": repository.sign_on_links(db, user.id)}
    values |= {"scopes": SCOPE_NAMES, "days": service.TOKEN_DAYS, "most_days": service.MOST_TOKEN_DAYS, "now": now()}
    values |= {"refused": refused[0], "typed": refused[1], "remarks": field_notes(error, {})}
    problem = error.problem(request.url.path) if error else None
    return HTMLResponse(render(request, "accounts/account.html", problem=problem, **values), error.status if error else 200)


def _accounts_page(
    request: Request,
    db: Session,
    caller: Caller,
    error: BetaloopError | None = None,
    draft: dict[str, Any] | None = None,
    refused: str = "new",
) -> HTMLResponse:
    """Show who may sign in; `refused` is the form that `error` is about."""
    page = render(
        request,
        "accounts/accounts.html",
        users=[u for u in repository.users(db) if service.manages(caller, u)],
        studies=[s for s in repository.studies(db) if service.administers(caller, s.id)],
        roles=list(Role),
        draft=draft or {"email": "", "name": "", "role": Role.CLINICIAN, "study": "", "site": ""},
        refused=refused,
        remarks=field_notes(error, {}),
        problem=error.problem(request.url.path) if error else None,
        min_password=MIN_PASSWORD,
    )
    return HTMLResponse(page, error.status if error else 200)
