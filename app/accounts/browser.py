"""Effects of signing in on a browser, by whatever way: its cookie, where it goes on, and how often one source may fail."""

from __future__ import annotations

from fastapi import Request
from fastapi.responses import RedirectResponse

from app.accounts import service
from app.accounts.deps import COOKIE
from app.platform.errors import TooMany
from app.platform.sources import Allowance, in_words, network_address
from app.settings import get_settings

SIGNED_OUT = "betaloop_signed_out"
"""Cookie of a browser in which a user has signed out. Its next sign-on asks again, so that one click does not restore their session."""

failed_sign_ins = Allowance(lambda: get_settings().failed_sign_ins_per_source, service.FAILURE_WINDOW.total_seconds())
"""By network address, whatever the accounts: who tries one password with many accounts meets no lock-out of an account."""


def count_try(request: Request) -> str:
    """Count a sign-in before it is judged, however many come at once; give it back where it was right. Returns its source.

    Raises:
        TooMany: too many failed from there.
    """
    source = network_address(request)
    if wait_s := failed_sign_ins.take(source):
        raise TooMany("Too many failed sign-ins came from here.", f"Wait {in_words(wait_s)} and try again.", wait_s)
    return source


def signed_in(token: str, target: str) -> RedirectResponse:
    """Redirect a user who has just signed in, with the session's cookie."""
    settings, answer = get_settings(), RedirectResponse(target, 303)
    answer.set_cookie(
        COOKIE, token, max_age=3600 * settings.session_max_hours, httponly=True, samesite="lax", secure=settings.cookie_secure
    )
    return answer


def local_path(target: str) -> str:
    """Return a path of this service, or `/`: signing in never leads to another site.

    Browsers read a backslash as a slash and drop tabs and line ends, hence the strict look at every character.
    """
    ok = target.startswith("/") and not target.startswith("//") and "\\" not in target and all(" " < c < "\x7f" for c in target)
    return target if ok else "/"
