"""The way to a hospital's identity provider and back. Addresses, not forms: a form may lead to no other site (Content-Security-Policy)."""

from __future__ import annotations

import base64
import binascii
import json
import secrets
import time
from dataclasses import asdict, dataclass

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response

from app.accounts import service as accounts
from app.accounts import sign_on
from app.accounts.deps import COOKIE, SIGNED_OUT, CurrentCaller, count_try, failed_sign_ins, local_path, signed_in
from app.accounts.sign_on_provider import RETURN_PATH, Begun, Identity, ProviderAway, Refused, configured, provider
from app.platform.database import set_actor, transaction
from app.platform.errors import BetaloopError, NotFound, TooMany, Unauthorized
from app.platform.web.templates import render
from app.settings import get_settings

pages = APIRouter(prefix="/sign-on")

BEGUN = "betaloop_sign_on"
BEGUN_FOR_S = 600
_PATH = "/sign-on"
_NONCE_BYTES = 12


@dataclass(frozen=True)
class _Way:
    """Content of the sealed cookie: the beginning, where to go on, and whether it confirms a session instead of opening one."""

    begun: Begun
    target: str
    confirms: bool


@pages.get("")
def begin(request: Request, next: str = "/") -> Response:
    """Send the browser to the provider."""
    _require_configured()
    return _sent_off(local_path(next), confirms=False, fresh=SIGNED_OUT in request.cookies)


@pages.get("/confirm")
def begin_to_confirm(caller: CurrentCaller, next: str = "/") -> Response:
    """Send the browser to the provider, which asks its user once more who they are: instead of the password of a signature."""
    _require_configured()
    caller.require_browser()
    return _sent_off(local_path(next), confirms=True, fresh=True)


@pages.get("/return")
def come_back(request: Request) -> Response:
    """Receive the browser that the provider sends back."""
    _require_configured()
    way, source = _opened(request.cookies.get(BEGUN, "")), None
    try:
        if way is None:
            raise Refused("This sign-on was not begun in this browser, or more than ten minutes ago.", "Begin again from here.")
        source = count_try(request)
        answer = _arrived(request, way, provider().finish(way.begun, request.query_params, _max_age_s()))
        failed_sign_ins.give_back(source)
    except BetaloopError as error:
        if isinstance(error, ProviderAway) and source is not None:
            failed_sign_ins.give_back(source)  # no refusal
        answer = _refusal(request, error, way)
    # each begin is good for one return
    answer.delete_cookie(BEGUN, path=_PATH, httponly=True, samesite="lax", secure=get_settings().cookie_secure)
    return answer


@pages.get("/end")
def end() -> Response:
    """Send the browser to where its session at the provider ends too."""
    _require_configured()
    return RedirectResponse(provider().sign_out_address() or "/sign-in", 303)


def _require_configured() -> None:
    if not configured():
        raise NotFound("This installation has no sign-on.", "Sign in with your password.")


def _max_age_s() -> int:
    """Limit the age of a login: another person must not restore an idled-out browser session with one click."""
    return 60 * get_settings().session_idle_minutes


def _sent_off(target: str, *, confirms: bool, fresh: bool) -> Response:
    url, begun = provider().begin(_max_age_s(), fresh=fresh)
    answer = RedirectResponse(url, 303)
    answer.set_cookie(
        BEGUN, _sealed(_Way(begun, target, confirms)), max_age=BEGUN_FOR_S, path=_PATH,
        httponly=True, samesite="lax", secure=get_settings().cookie_secure,
    )  # fmt: skip
    return answer


def _arrived(request: Request, way: _Way, identity: Identity) -> Response:
    with transaction() as db:
        set_actor(db, "unknown", request_id=request.state.request_id)
        if not way.confirms:
            token = sign_on.sign_on(db, identity)
            answer = signed_in(token, way.target)
            answer.delete_cookie(SIGNED_OUT, path=_PATH)
            return answer
        caller = accounts.caller_of_cookie(db, request.cookies.get(COOKIE, ""))
        if caller is None:
            raise Unauthorized("Your session has ended meanwhile.", "Sign in again.")
        set_actor(db, caller.label, caller.user_id, request.state.request_id)
        sign_on.confirm(db, caller, identity)
    return RedirectResponse(way.target, 303)


def _refusal(request: Request, error: BetaloopError, way: _Way | None) -> Response:
    target = way.target if way else "/"
    headers = {"Retry-After": str(error.retry_after_s)} if isinstance(error, TooMany) else {}
    if way and way.confirms:
        # who had signed in still is: the page that asked says what is wrong
        problem = error.problem(RETURN_PATH) | {"request_id": request.state.request_id}
        page = render(request, "error.html", problem=problem, title=error.title, advice="", only_advice=False, entries=[], again="")
        return HTMLResponse(page, error.status, headers)
    page = render(request, "accounts/sign_in.html", problem=error.problem(RETURN_PATH), email="", next=target, first=False)
    return HTMLResponse(page, error.status, headers)


def _sealed(way: _Way) -> str:
    nonce = secrets.token_bytes(_NONCE_BYTES)
    return base64.urlsafe_b64encode(nonce + AESGCM(_key()).encrypt(nonce, json.dumps(asdict(way)).encode(), BEGUN.encode())).decode()


def _opened(cookie: str) -> _Way | None:
    """Open a cookie of ours; None for any other, and for an old one."""
    try:
        sealed = base64.urlsafe_b64decode(cookie.encode("ascii"))
        held = json.loads(AESGCM(_key()).decrypt(sealed[:_NONCE_BYTES], sealed[_NONCE_BYTES:], BEGUN.encode()))
    except (InvalidTag, ValueError, binascii.Error):
        return None
    way = _Way(Begun(**held["begun"]), held["target"], held["confirms"])
    return way if time.time() - way.begun.at < BEGUN_FOR_S else None


def _key() -> bytes:
    return get_settings().secret("sign-on")
