"""Samples of a session on a page: the chart that the session's page loads, and a page of its own that needs no script."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, JSONResponse

from app.accounts.deps import CurrentCaller
from app.overview.signals.figures import chart_figure, picture_of, table_of
from app.overview.signals.schemas import ChannelNumber, Time
from app.overview.signals.service import SignalWindow, signals_of
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.web.charts import written
from app.platform.web.numbers import number
from app.platform.web.templates import render
from app.study.deps import CurrentSession, SessionViewed

router = APIRouter()

POINTS = 1200
"""Bins of a chart: about one for each pixel of its width."""


@router.get("/sessions/{session_id}/signal.json", dependencies=[SessionViewed])
def signal_figure(
    session: CurrentSession,
    db: Db,
    caller: CurrentCaller,
    channel: ChannelNumber = 0,
    begin_s: Time = None,
    end_s: Time = None,
) -> JSONResponse:
    """The chart of a channel between two times, its title, and the names of all channels."""
    signals = signals_of(db, session, caller)
    window = signals.window(channel, begin_s, end_s, POINTS)
    settings = session.visit.participant.current_settings
    # all of the session unless a stretch is asked for, as the charts beside it
    span = (-settings.window * settings.period_s if begin_s is None else begin_s, session.duration_s if end_s is None else end_s)
    content: dict[str, Any] = {
        "figure": chart_figure(window, span, settings.beta_low_hz, settings.beta_high_hz),
        "subtitle": resolution(window),
        "channels": [name for _, name in _named(signals.channels)],
    }
    return JSONResponse(content)


@router.get("/sessions/{session_id}/signal", dependencies=[SessionViewed])
def signal_page(
    request: Request, session: CurrentSession, db: Db, caller: CurrentCaller, channel: str = "0", begin_s: str = "", end_s: str = ""
) -> HTMLResponse:
    """A drawing of a channel between two times, and the numbers behind it."""
    settings = session.visit.participant.current_settings
    low_hz, high_hz = settings.beta_low_hz, settings.beta_high_hz
    signals = signals_of(db, session, caller)
    number = next((c.number for c in signals.channels if str(c.number) == channel.strip()), 0)
    problem, status = None, 200
    try:
        window = signals.window(number, _seconds(begin_s), _seconds(end_s), POINTS)
    except BetaloopError as error:
        problem, status = error.problem(request.url.path), error.status
        window = signals.window(number, None, None, POINTS)
    page = render(
        request,
        "overview/signal.html",
        session=session,
        participant=session.visit.participant,
        channels=_named(signals.channels),
        window=window,
        typed={"begin_s": begin_s, "end_s": end_s},
        subtitle=resolution(window),
        drawn=picture_of(window, low_hz, high_hz),
        rows=table_of(window, low_hz, high_hz),
        band=(low_hz, high_hz),
        problem=problem,
    )
    return HTMLResponse(page, status)


def resolution(window: SignalWindow) -> str:
    """How much of the samples a figure shows, in words."""
    rates = " and ".join(f"{r:g}" for r in window.channel.rates_hz)
    shown = "every sample" if window.resolution_s == 0 else f"lowest and highest sample of every {1000 * window.resolution_s:.0f} ms"
    named, samples = written(f"{window.channel.channel} · {window.channel.unit}"), number(window.channel.samples)
    return f"{named} · {rates} Hz · n = {samples} samples · {shown}"


def _named(channels: Any) -> list[tuple[int, str]]:
    many = len({c.recording for c in channels}) > 1
    return [(c.number, written(c.channel) + (f", {c.hemisphere or f'recording {c.recording}'}" if many else "")) for c in channels]


def _seconds(text: str) -> float | None:
    """What was typed; nothing where it is no number, as an empty field."""
    try:
        value = float(text.replace(",", "."))
    except ValueError:
        return None
    return value if abs(value) < 1e7 else None
