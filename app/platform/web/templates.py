"""Jinja2 pages: one environment, autoescaped, with the filters that every page uses."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from enum import StrEnum
from functools import lru_cache
from pathlib import Path
from typing import Any

import plotly
from fastapi import Request
from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape
from markupsafe import Markup

from app.platform.database import now
from app.platform.jobs.titles import state_in_words
from app.platform.numbers import counted, fixed, ma, minutes, number, p_text, place, rate, size, stated, time_left, typed, when, whole
from app.platform.web.charts import written
from app.settings import get_settings
from ml.outcomes import ALL, ALL_PREDICTED, ALL_WEIGHED, ANY, ANY_PREDICTED, OUTCOMES
from ml.outcomes.records import Outcome

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
    """Render a page as text. `me` (who is signed in, or None), `path` and `synthetic` (code of the simulation that it is about, or None)
    are there for every template.

    Not `caller`: that word belongs to Jinja inside `call` blocks, where it would silently mean something else.
    """
    shown = values.get("participant")
    if getattr(shown, "synthetic", False):
        request.state.synthetic = getattr(shown, "code", "")
    return _environment.get_template(template).render(
        request=request,
        me=getattr(request.state, "caller", None),
        path=request.url.path,
        synthetic=getattr(request.state, "synthetic", None),
        **values,
    )


def render_part(template: str, **values: Any) -> Markup:
    """Render a part of a page from its values alone. It knows neither the request nor who is signed in, so that it may be cached."""
    return Markup(_environment.get_template(template).render(**values))  # noqa: S704


def static_url(name: str) -> str:
    """Build the URL of a file under static/, with its hash, so that browsers may keep it for ever."""
    return f"/static/{name}?v={_hash(name, (STATIC / name).stat().st_mtime_ns)}"


def plotly_url() -> str:
    """Build the URL of plotly.js, which comes from plotly's own package; charts.js loads it only where there is a chart."""
    return f"/static/plotly/plotly.min.js?v={plotly.__version__}"


@lru_cache(maxsize=256)
def _hash(name: str, _changed: int) -> str:
    return hashlib.sha256((STATIC / name).read_bytes()).hexdigest()[:10]


def sign_on_name() -> str:
    """Name the hospital's sign-on; empty where there is none."""
    settings = get_settings()
    return settings.oidc_name if settings.oidc_issuer else ""


def outcome_value(value: float | None, outcome: Outcome) -> str:
    """Write an outcome of a session: whole where its values are."""
    return fixed(value, 0) if outcome.whole else number(value)


_environment.filters.update(
    outcome=outcome_value,
    written=written,
    counted=counted,
    number=number,
    fixed=fixed,
    stated=stated,
    whole=whole,
    ma=ma,
    rate=rate,
    place=place,
    typed=typed,
    p=p_text,
    minutes=minutes,
    time_left=time_left,
    state_in_words=state_in_words,
    size=size,
    when=when,
)


def outcome_columns(unit: str) -> list[dict[str, Any]]:
    """Return the head of a table's columns of outcomes, with the named unit of their records."""
    return [{"label": o.short, "num": True, "unit": getattr(o, unit)} for o in OUTCOMES]


_environment.globals.update(
    static_url=static_url,
    plotly_url=plotly_url,
    now=now,
    sign_on_name=sign_on_name,
    OUTCOMES=OUTCOMES,
    ALL_OUTCOMES=ALL,
    ALL_PREDICTED=ALL_PREDICTED,
    ALL_WEIGHED=ALL_WEIGHED,
    ANY_OUTCOME=ANY,
    ANY_PREDICTED=ANY_PREDICTED,
    outcome_columns=outcome_columns,
)


class Part(StrEnum):
    """Part of a page that a later phase makes, from the session, the record of the page, and the caller."""

    SLOTS_OF_VISIT = "planned sessions against recorded ones, on the page of a visit"
    STANDINGS = "a sentence on every policy, by its number, on pages that show policies"
    TESTED_STANDINGS = "the same of policies with sessions or harms alone, on pages that list many"
    SUGGESTED_VISIT = "the visit that one button drafts, on pages that say what to test next"
    OUTLOOK = "sentences on what further visits would settle, on the page of a draft"


_makers: dict[Part, Callable[..., Any]] = {}


def provide(part: Part, maker: Callable[..., Any]) -> None:
    """Register the function that makes a part; `app.main` does so for every one."""
    _makers[part] = maker


def make_part(part: Part, *arguments: Any) -> Any:
    """Make a part of a page. Raises KeyError where no function is provided."""
    return _makers[part](*arguments)
