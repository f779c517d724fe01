"""Samples of a session on a page: the chart that the session's page loads, and a page of its own that needs no script."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, BinaryIO

import numpy as np
from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse, JSONResponse, StreamingResponse
from markupsafe import Markup
from numpy.typing import NDArray
from pydantic import Field

from app.accounts.deps import CurrentCaller
from app.overview.samples import MEDIA_TYPES, SampleFormat, session_samples
from app.overview.signals import Signals, SignalWindow, signals_of
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.numbers import hover, number
from app.platform.web.charts import ACCENT, Cell, axis, figure, written
from app.platform.web.png import colour_scale, picture
from app.platform.web.schemas import Model, problems
from app.platform.web.svg import Plane, drawing
from app.platform.web.templates import render
from app.study.deps import CurrentSession, SessionViewed
from ml.sample_views import Spectrogram, fewer_columns

# API types of samples at the resolution of a screen.

ChannelNumber = Annotated[int, Query(ge=0, le=1000, description="A channel's place in the session, from 0.")]
Time = Annotated[float | None, Query(ge=-1e6, le=1e6, allow_inf_nan=False, description="Seconds from the session's start.")]


class SignalChannelOut(Model):
    """One channel of a recording within a session."""

    number: int = Field(description="Its place in the session, from 0.")
    recording: int
    hemisphere: str | None
    channel: str
    unit: str
    rates_hz: list[float]
    samples: int
    begin_s: float = Field(description="First sample, seconds from the session's start.")
    end_s: float


class SpectrogramOut(Model):
    """Power over time and frequency: Hann segments of 1 s that overlap by half, averaged per column."""

    first_s: float = Field(description="Where column 0 begins, seconds from the session's start.")
    width_s: float = Field(description="Seconds of a column.")
    hz: list[float]
    decibel: list[list[float | None]] = Field(
        description="A list per column: 10 log10 of the density in the samples' unit squared per Hz; null without a whole segment."
    )


class SignalOut(Model):
    """A channel between two times: extremes per bin, or every sample where there are few."""

    channels: list[SignalChannelOut] = Field(description="All channels of the session.")
    channel: int
    begin_s: float
    end_s: float
    resolution_s: float = Field(description="Width of a bin; 0 where every sample is given.")
    t_s: list[float] = Field(description="Middle of each bin, or time of each sample, seconds from the session's start.")
    low: list[float | None] = Field(description="Lowest sample of each bin; null where samples are missing.")
    high: list[float | None]
    spectrogram: SpectrogramOut


# Samples of a window as API types.


def signal_out(signals: Signals, window: SignalWindow) -> SignalOut:
    """Convert a window, and list the other channels."""
    power = window.power
    return SignalOut(
        channels=[SignalChannelOut.model_validate(c) for c in signals.channels],
        channel=window.channel.number,
        begin_s=window.begin_s,
        end_s=window.end_s,
        resolution_s=window.resolution_s,
        t_s=np.round(window.t_s, 6).tolist(),
        low=_listed(window.low),
        high=_listed(window.high),
        spectrogram=SpectrogramOut(
            first_s=power.first_s,
            width_s=power.width_s,
            hz=power.hz.tolist(),
            decibel=[_listed(column) for column in decibel(power.density)],
        ),
    )


def decibel(density: NDArray[np.float32]) -> NDArray[np.float64]:
    """Convert a density to 10 log10, to a tenth; NaN where it is 0 or not known."""
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.round(10 * np.log10(density.astype(np.float64)), 1)
    return np.where(np.isfinite(found), found, np.nan)


def _listed(values: NDArray[Any]) -> list[float | None]:
    return [None if v != v else float(f"{v:.6g}") for v in values.tolist()]


# Samples and spectrogram of a window as a chart, and as a drawing without a script.

RANGE = (5.0, 99.0)
"""Percentiles of the window's power between which the colours run: a single burst of noise must not take them all."""

W, LEFT, RIGHT, TOP, LFP_H, BETWEEN, POWER_H, BOTTOM = 1100.0, 60.0, 16.0, 30.0, 180.0, 56.0, 200.0, 44.0
TABLE_ROWS = 60


def chart_figure(window: SignalWindow, span_s: tuple[float, float], low_hz: float, high_hz: float) -> dict[str, Any]:
    """Build the chart: samples above, power below, minutes of the session along both, from and to `span_s`."""
    unit = window.channel.unit
    x, y = _line(window)
    power, (bottom, top) = _decibel(window.power)
    columns = (window.power.first_s + window.power.width_s * (np.arange(power.shape[0]) + 0.5)) / 60
    per_hz = written(f"{unit}2/Hz")
    data: list[dict[str, Any]] = [
        {
            "type": "scatter", "mode": "lines", "name": "LFP", "x": np.round(x / 60, 6), "y": y, "connectgaps": False,
            "line": {"color": ACCENT, "width": 1}, "hovertemplate": f"%{{x:.4f}} min<br>{hover()} {unit}<extra></extra>",
        },
        {
            "type": "heatmap", "name": "Power", "x": columns, "y": window.power.hz, "z": power.T, "yaxis": "y2", "zmin": bottom,
            "zmax": top, "colorscale": colour_scale(), "hoverongaps": False,
            "hovertemplate": f"%{{x:.2f}} min, %{{y:.0f}} Hz<br>%{{z:.1f}} dB re 1 {per_hz}<extra></extra>",
            "colorbar": {"title": {"text": "dB", "font": {"size": 12}}, "thickness": 10, "len": 0.46, "y": 0.0, "yanchor": "bottom",
                         "outlinewidth": 0, "xpad": 6},
        },
    ]  # fmt: skip
    band = [
        {
            "type": "line", "xref": "paper", "x0": 0, "x1": 1, "yref": "y2", "y0": hz, "y1": hz,
            "line": {"color": "#fff", "width": 1, "dash": "dot"},
        }
        for hz in (low_hz, high_hz)
    ]  # fmt: skip
    return figure(
        data,
        grid={"rows": 2, "columns": 1},
        xaxis=axis("Time in session", "min", anchor="y2", zeroline=False, range=[t / 60 for t in span_s]),
        yaxis=axis("LFP", unit, domain=[0.56, 1.0], zeroline=False, fixedrange=True),
        yaxis2=axis("Frequency", "Hz", domain=[0.0, 0.46], zeroline=False, fixedrange=True),
        shapes=band,
        showlegend=False,
        dragmode="zoom",
        margin={"l": 62, "r": 62, "t": 12, "b": 44},
    )


def picture_of(window: SignalWindow, low_hz: float, high_hz: float) -> Markup:
    """Draw the window as a static picture, with the beta band marked in words."""
    unit = written(window.channel.unit)
    span = (window.begin_s / 60, window.end_s / 60)
    known = np.concatenate([window.low, window.high])
    known = known[~np.isnan(known)].astype(np.float64)
    extent = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    above = Plane(LEFT, TOP, W - LEFT - RIGHT, LFP_H, span, extent)
    above.axes("", f"LFP ({unit})", x_ticks=10, y_ticks=4)
    x, y = _line(window)
    points = [(t / 60, None if np.isnan(v) else float(v)) for t, v in zip(x.tolist(), y.tolist(), strict=True)]
    above.line(points, "accent", 0.8)
    power, (bottom, top) = _decibel(window.power)
    hz = window.power.hz
    first = TOP + LFP_H + BETWEEN
    below = Plane(LEFT, first, W - LEFT - RIGHT, POWER_H, span, (float(hz[0]), float(hz[-1])) if hz.size else (0.0, 1.0))
    below.axes("Time in the session (min)", "Frequency (Hz)", x_ticks=10, y_ticks=5)
    if power.size:  # over the grid, which would cross out what it shows
        left = below.at_x(window.power.first_s / 60)
        right = below.at_x((window.power.first_s + window.power.width_s * power.shape[0]) / 60)
        place = f'x="{left:.1f}" y="{first:.1f}" width="{right - left:.1f}" height="{POWER_H:.1f}"'
        look = 'preserveAspectRatio="none" style="image-rendering: pixelated"'
        below.parts.append(f'<image href="{picture(power.T[::-1], bottom, top)}" {place} {look}/>')
    for edge in (low_hz, high_hz):
        y_edge = below.at_y(edge)
        place = f'x1="{LEFT}" x2="{W - RIGHT}" y1="{y_edge:.1f}" y2="{y_edge:.1f}"'
        below.parts.append(f'<line {place} stroke="#fff" stroke-width="1" stroke-dasharray="2 3"/>')
    told = f"Power from {bottom:.0f} (dark) to {top:.0f} (light) dB re 1 {unit}²/Hz; dotted: the beta band, {low_hz:g} to {high_hz:g} Hz."
    return drawing(W, first + POWER_H + BOTTOM, "Samples and spectrogram", told, [above, below])


def table_of(window: SignalWindow, low_hz: float, high_hz: float) -> list[list[Cell]]:
    """List the rows of the table: begin (s), lowest and highest sample, mean density in the beta band, for at most `TABLE_ROWS` pieces."""
    power = fewer_columns(window.power, window.begin_s, window.end_s, TABLE_ROWS)
    inside = (power.hz >= low_hz) & (power.hz <= high_hz)
    rows: list[list[Cell]] = []
    for i, column in enumerate(power.density):
        begin = power.first_s + i * power.width_s
        here = (window.t_s >= begin) & (window.t_s < begin + power.width_s)
        low, high = window.low[here], window.high[here]
        known = bool(np.any(~np.isnan(low)))
        density = float(column[inside].mean()) if inside.any() else float("nan")
        rows.append(
            [begin, float(np.nanmin(low)) if known else None, float(np.nanmax(high)) if known else None,
             None if np.isnan(density) else density]
        )  # fmt: skip
    return rows


def _line(window: SignalWindow) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return times (s) and values of the line: each sample, or each bin's lowest and highest one after the other."""
    if window.resolution_s == 0:
        return window.t_s, window.low
    return np.repeat(window.t_s, 2), np.stack([window.low, window.high], axis=1).reshape(-1)


def _decibel(power: Spectrogram) -> tuple[NDArray[np.float64], tuple[float, float]]:
    shown = decibel(power.density)
    known = shown[np.isfinite(shown)]
    if known.size == 0:
        return shown, (0.0, 1.0)
    bottom, top = np.percentile(known, RANGE)
    return shown, (float(bottom), float(top))


# The samples of a session to download, from its page and over REST.

samples_api = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))
CHUNK = 1 << 18

ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"content": {media: {"schema": {"type": "string", "format": "binary"}} for media in MEDIA_TYPES.values()}},
    **problems(409),
}
Form = Annotated[SampleFormat, Query(alias="format", description="Parquet: a row per sample. NWB 2: needs the extra `nwb`.")]


@samples_api.get("/sessions/{session_id}/samples", response_class=StreamingResponse, responses=ANSWERS)
def read_samples(session: CurrentSession, db: Db, caller: CurrentCaller, form: Form = SampleFormat.PARQUET) -> StreamingResponse:
    """Return every sample of a session's recordings with its time from the session's start, and every 2 s trace, as one file."""
    found = session_samples(db, session, form, caller)
    headers = {"Content-Disposition": f'attachment; filename="{found.name}"', "Content-Length": str(found.size)}
    return StreamingResponse(_chunks(found.content), media_type=MEDIA_TYPES[form], headers=headers)


def _chunks(content: BinaryIO) -> Iterator[bytes]:
    with content:
        while chunk := content.read(CHUNK):
            yield chunk


# Samples of a session at the resolution of a screen.

api = APIRouter(tags=["study"], responses=problems(401, 403, 404, 409, 422))

Points = Annotated[int, Query(ge=50, le=4000, description="Bins wanted; there are at most four times as many.")]


@api.get("/sessions/{session_id}/signal", dependencies=[SessionViewed])
def read_signal(
    session: CurrentSession,
    db: Db,
    caller: CurrentCaller,
    channel: ChannelNumber = 0,
    begin_s: Time = None,
    end_s: Time = None,
    points: Points = 1000,
) -> SignalOut:
    """Return a channel of raw samples between two times: extremes per bin (every sample, where there are few), and the spectrogram.

    The first request for a session decodes its files, which may take seconds; the results are cached.
    """
    signals = signals_of(db, session, caller)
    return signal_out(signals, signals.window(channel, begin_s, end_s, points))


pages = APIRouter()

POINTS = 1200
"""Bins of a chart: about one for each pixel of its width."""


@pages.get("/sessions/{session_id}/signal.json", dependencies=[SessionViewed])
def signal_figure(
    session: CurrentSession,
    db: Db,
    caller: CurrentCaller,
    channel: ChannelNumber = 0,
    begin_s: Time = None,
    end_s: Time = None,
) -> JSONResponse:
    """Return the chart of a channel between two times, its title, and the names of all channels."""
    signals = signals_of(db, session, caller)
    window = signals.window(channel, begin_s, end_s, POINTS)
    settings = session.visit.participant.current_settings
    # all of the session unless a stretch is asked for, as the charts next to it
    span = (-settings.window * settings.period_s if begin_s is None else begin_s, session.duration_s if end_s is None else end_s)
    content: dict[str, Any] = {
        "figure": chart_figure(window, span, settings.beta_low_hz, settings.beta_high_hz),
        "subtitle": resolution(window),
        "channels": [name for _, name in _named(signals.channels)],
    }
    return JSONResponse(content)


@pages.get("/sessions/{session_id}/signal", dependencies=[SessionViewed])
def signal_page(
    request: Request, session: CurrentSession, db: Db, caller: CurrentCaller, channel: str = "0", begin_s: str = "", end_s: str = ""
) -> HTMLResponse:
    """Show a drawing of a channel between two times, and the numbers behind it."""
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
    """Describe how much of the samples a figure shows."""
    rates = " and ".join(f"{r:g}" for r in window.channel.rates_hz)
    shown = "every sample" if window.resolution_s == 0 else f"lowest and highest sample of every {1000 * window.resolution_s:.0f} ms"
    named, samples = written(f"{window.channel.channel} · {window.channel.unit}"), number(window.channel.samples)
    return f"{named} · {rates} Hz · n = {samples} samples · {shown}"


def _named(channels: Any) -> list[tuple[int, str]]:
    many = len({c.recording for c in channels}) > 1
    return [(c.number, written(c.channel) + (f", {c.hemisphere or f'recording {c.recording}'}" if many else "")) for c in channels]


def _seconds(text: str) -> float | None:
    """Parse a typed number; None where it is no number, as for an empty field."""
    try:
        value = float(text.replace(",", "."))
    except ValueError:
        return None
    return value if abs(value) < 1e7 else None
