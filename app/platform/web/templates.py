"""Jinja2 pages: one environment, autoescaped, with the filters that every page uses."""

from __future__ import annotations

import hashlib
import math
from datetime import date, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

import plotly
from fastapi import Request
from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape
from markupsafe import Markup

from app.platform.database import now
from app.platform.web.charts import counted, written
from app.settings import get_settings

ROOT = Path(__file__).resolve().parents[3]

STATIC = ROOT / "static"

_environment = Environment(
    loader=FileSystemLoader(Path(__file__).resolve().parents[2] / "templates"),
    autoescape=select_autoescape(default=True),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def render(request: Request, template: str, **values: Any) -> str:
    """A page as text. `me` (who is signed in, or None) and `path` are there for every template.

    Not `caller`: that word belongs to Jinja inside `call` blocks, where it would silently mean something else.
    """
    return _environment.get_template(template).render(
        request=request, me=getattr(request.state, "caller", None), path=request.url.path, **values
    )


def render_part(template: str, **values: Any) -> Markup:
    """A part of a page, made of its values alone: it knows neither the request nor who is signed in, so that it may be kept."""
    return Markup(_environment.get_template(template).render(**values))  # noqa: S704


def static_url(name: str) -> str:
    """URL of a file under static/, with its hash, so that browsers may keep it for ever."""
    return f"/static/{name}?v={_hash(name, (STATIC / name).stat().st_mtime_ns)}"


def plotly_url() -> str:
    """URL of plotly.js, which comes from plotly's own package; charts.js loads it only where there is a chart."""
    return f"/static/plotly/plotly.min.js?v={plotly.__version__}"


@lru_cache(maxsize=256)
def _hash(name: str, _changed: int) -> str:
    return hashlib.sha256((STATIC / name).read_bytes()).hexdigest()[:10]


def number(value: float | None, digits: int = 3) -> str:
    """A number for people: significant digits, an em dash where there is none."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "—"
    if value == 0:
        return "0"
    if abs(value) >= 10**digits:
        return f"{value:,.0f}".replace(",", "\u202f").replace("-", "\u2212")
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{min(decimals, 6)}f}".replace("-", "\u2212")


def fixed(value: float | None, decimals: int = 1) -> str:
    """A number with a fixed count of decimals; what rounds to nothing has no sign."""
    return "—" if value is None or math.isnan(value) else f"{value:z.{decimals}f}".replace("-", "\u2212")


def stated(value: float | None) -> str:
    """A number that somebody stated or a device has, in as few digits as it needs, six at most: 2.5 mA stays 2.5, 20 min stay 20."""
    return "\u2014" if value is None or math.isnan(value) else f"{value:z.6g}".replace("-", "\u2212")


def whole(value: float) -> int:
    """The nearest whole number, to count with."""
    return round(value)


def rate(value: float) -> str:
    """A learning rate as people write it: 3e-4."""
    return f"{value:.0e}".replace("e-0", "e-")


def place(value: float) -> str:
    """A coordinate of a drawing; nobody reads it."""
    return f"{value:.2f}"


def typed(value: float | None) -> str:
    """A number as it stands in a field, for a form to send back: four significant digits, nothing where there is none."""
    return "" if value is None else f"{value:.4g}"


def p_text(p: float | None) -> str:
    """A p-value for people, without the zero that every p has before its point; one that rounds to nothing is said to be below .001."""
    if p is None or math.isnan(p):
        return "\u2014"
    if p < 0.001:
        return "< .001"
    return "1" if p > 0.9995 else f"{p:.3f}".removeprefix("0")


def minutes(seconds: float | None) -> str:
    """A length of time for people: 10 min 20 s."""
    if seconds is None:
        return "—"
    whole = round(seconds)
    return f"{whole // 60} min" + (f" {whole % 60} s" if whole % 60 else "") if whole >= 60 else f"{whole} s"


def minutes_left(seconds: float) -> str:
    """A remaining time for people, no finer than it can be known."""
    if seconds < 60:
        return "less than a minute left"
    return f"about {math.ceil(seconds / 60)} min left" if seconds <= 7200 else f"about {seconds / 3600:.0f} h left"


def time_left(seconds: float | None) -> str:
    """The remaining time of a job in words, also where it cannot be told yet: on pages, in events and in the terminal."""
    return "time left not known yet" if seconds is None else minutes_left(seconds)


def size(value: int) -> str:
    """Bytes for people."""
    if value < 1024:
        return f"{value} B"
    amount, unit = float(value), "B"
    for larger in ("KiB", "MiB", "GiB"):
        if amount >= 1024:
            amount, unit = amount / 1024, larger
    return f"{number(amount)} {unit}"


def when(value: datetime | date | None) -> str:
    """A date, or a time to the minute (UTC)."""
    if value is None:
        return "—"
    return value.strftime("%Y-%m-%d %H:%M UTC") if isinstance(value, datetime) else value.isoformat()


def sign_on_name() -> str:
    """What the hospital's sign-on is called; empty where there is none."""
    settings = get_settings()
    return settings.oidc_name if settings.oidc_issuer else ""


_environment.filters.update(
    written=written,
    counted=counted,
    number=number,
    fixed=fixed,
    stated=stated,
    whole=whole,
    rate=rate,
    place=place,
    typed=typed,
    p=p_text,
    minutes=minutes,
    time_left=time_left,
    size=size,
    when=when,
)
_environment.globals.update(static_url=static_url, plotly_url=plotly_url, now=now, sign_on_name=sign_on_name)
