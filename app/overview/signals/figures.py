"""Samples and spectrogram of a window as a chart, and as a drawing without a script."""

from __future__ import annotations

from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from app.overview.signals.serializers import decibel
from app.overview.signals.service import SignalWindow
from app.platform.web.charts import ACCENT, Cell, axis, figure, written
from app.platform.web.numbers import hover
from app.platform.web.png import colour_scale, picture
from app.platform.web.svg import Plane, drawing
from ml.sample_views import Spectrogram, fewer_columns

RANGE = (5.0, 99.0)
"""Percentiles of the window's power between which the colours run: a single burst of noise must not take them all."""

W, LEFT, RIGHT, TOP, LFP_H, BETWEEN, POWER_H, BOTTOM = 1100.0, 60.0, 16.0, 30.0, 180.0, 56.0, 200.0, 44.0
TABLE_ROWS = 60


def chart_figure(window: SignalWindow, span_s: tuple[float, float], low_hz: float, high_hz: float) -> dict[str, Any]:
    """The chart: samples above, power below, minutes of the session along both, from and to `span_s`."""
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
    """The drawing: the same, with the beta band marked in words."""
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
    """Rows of the table behind: begin (s), lowest and highest sample, mean density in the beta band, for at most `TABLE_ROWS` pieces."""
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
    """Times (s) and values of the line: each sample, or each bin's lowest and highest one after the other."""
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
