"""Pictures of a device's history."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from app.platform.numbers import hover, stated
from app.platform.web.charts import Cell, Chart, axis, figure
from app.study.recordings.history import History, Spectrum, Trend

SIDES = {"left": "token:cdbs", "right": "token:rl"}
_COLOURS = ("token:cdbs", "token:rl", "token:random", "token:distilled", "token:other", "token:no_dbs")
_DASHES = ("solid", "dash", "dot")
AVERAGE_S = 10 * 60.0
MOST_POINTS = 1500
"""Of a line: about one for each pixel of its width. A device keeps 60 days, 8640 averages of each side."""
GAP_S = 2 * AVERAGE_S
"""Two averages further apart than this are not joined: the device makes one every ten minutes."""
MOST_SPECTRA = 12
"""Snapshots in one picture, the newest; the interface gives all."""


def charts_of(history: History) -> list[Chart]:
    """Plot everything that a history has."""
    number = history.recording.id
    found = [*_trend_charts(history, number), _group_chart(history, number)]
    for name, title, spectra in (("snapshot", "Spectra at events", history.snapshots), ("survey", "Survey of spectra", history.surveys)):
        for side in sorted({s.side or "" for s in spectra}):
            found.append(
                _spectra_chart(f"{name}-{side or 'unknown'}-{number}", title, side, [s for s in spectra if (s.side or "") == side])
            )
    return [c for c in found if c is not None]


def _trend_charts(history: History, number: int) -> list[Chart]:
    """Plot power and amplitude over weeks, with the patient's events; the tables have a row per day."""
    if not history.trends:
        return []
    every = [t for trend in history.trends for t in trend.unix_s]
    averages = ", ".join(f"{t.side} n = {len(t.unix_s)}" for t in history.trends)
    window_s = _window_s(history.trends)
    shown = f", lowest and highest of every {stated(window_s / 3600, 3)} h" if window_s else ""
    span = f"{_day(min(every))} to {_day(max(every))}, averages over 10 min{shown}, {averages}"
    power = [_line(t, t.power, "device units", window_s) for t in history.trends]
    top = max((v for t in history.trends for v in t.power if v is not None), default=1.0)
    marks = _event_marks(history, top, min(every), max(every))
    layout = {"xaxis": axis("Date (UTC)", "", type="date"), "showlegend": True}
    return [
        Chart(
            f"trend-power-{number}", "Trend of the sensed power", f"device units · {span}",
            figure([*power, *marks], yaxis=axis("Power", "device units", rangemode="tozero"), **layout),
            ("Day", *(f"Mean power, {t.side} (device units)" for t in history.trends)), _daily(history.trends, "power"),
        ),
        Chart(
            f"trend-amplitude-{number}", "Trend of the amplitude", f"mA · {span}",
            figure(
                [_line(t, t.amplitude_ma, "mA", window_s) for t in history.trends],
                yaxis=axis("Amplitude", "mA", rangemode="tozero"), **layout,
            ),
            ("Day", *(f"Mean amplitude, {t.side} (mA)" for t in history.trends)), _daily(history.trends, "amplitude_ma"), height=220,
        ),
    ]  # fmt: skip


def _window_s(trends: Sequence[Trend]) -> float:
    """Return the width of the windows of which a line shows the lowest and the highest average, s; 0 where it shows all."""
    most = max(len(t.unix_s) for t in trends)
    return 0.0 if most <= MOST_POINTS else 2 * AVERAGE_S * -(-most // MOST_POINTS)


def _line(trend: Trend, values: Sequence[float | None], unit: str, window_s: float) -> dict[str, Any]:
    """Draw one side; missing averages are a gap."""
    shown: list[tuple[float, float | None]] = []
    held: list[tuple[float, float]] = []
    before = None
    for at, value in zip(trend.unix_s, values, strict=True):
        gap = before is not None and at - before > GAP_S
        if held and (gap or value is None or not window_s or held[0][0] // window_s != at // window_s):
            shown += _extremes(held)
            held = []
        if before is not None and gap:
            shown.append((before + 1, None))
        if value is None:
            shown.append((at, None))
        else:
            held.append((at, value))
        before = at
    shown += _extremes(held)
    return {
        "type": "scatter", "mode": "lines", "name": trend.side, "x": [_iso(at) for at, _ in shown], "y": [v for _, v in shown],
        "connectgaps": False,
        "line": {"color": SIDES.get(trend.side, "token:other"), "width": 1, "dash": "solid" if trend.side == "left" else "dot"},
        "hovertemplate": f"%{{x}}<br>{hover(digits=4)} {unit}",
    }  # fmt: skip


def _extremes(held: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the lowest and the highest of a window's averages in their order, one where all are equal: a spike is not averaged away."""
    if not held:
        return []
    low, high = min(held, key=lambda p: p[1]), max(held, key=lambda p: p[1])
    return [low] if low[1] == high[1] else sorted((low, high))


def _event_marks(history: History, height: float, first_s: float, last_s: float) -> list[dict[str, Any]]:
    events = [e for e in history.patient_events if first_s <= e.at.timestamp() <= last_s]
    if not events:
        return []
    return [
        {
            "type": "scatter", "mode": "markers", "name": "marked by the patient", "x": [_iso(e.at.timestamp()) for e in events],
            "y": [height] * len(events), "text": [e.label for e in events], "hovertemplate": "%{x}<br>%{text}<extra></extra>",
            "marker": {"symbol": "triangle-down", "size": 8, "color": "token:warn"},
        }
    ]  # fmt: skip


def _daily(trends: Sequence[Trend], what: str) -> list[list[Cell]]:
    by_day: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for trend in trends:
        for at, value in zip(trend.unix_s, getattr(trend, what), strict=True):
            if value is not None:
                by_day[_day(at)][trend.side].append(value)
    return [[day, *(float(np.mean(v)) if (v := sides.get(t.side)) else None for t in trends)] for day, sides in sorted(by_day.items())]


def _group_chart(history: History, number: int) -> Chart | None:
    """Plot the amplitude of the active group by side, from visit to visit."""
    active = sorted((g for g in history.groups if g.active and g.at is not None), key=lambda g: str(g.at))
    lines, rows = [], []
    for side in ("left", "right"):
        points = [(g.at, g.name, p.amplitude_ma) for g in active for p in g.programs if p.side == side and p.amplitude_ma is not None]
        if points:
            colour = SIDES[side]
            lines.append(
                {
                    "type": "scatter", "mode": "lines+markers", "name": side, "x": [at.isoformat() for at, _, _ in points if at],
                    "y": [ma for _, _, ma in points], "text": [f"group {name}" for _, name, _ in points],
                    "line": {"color": colour, "shape": "hv", "dash": "solid" if side == "left" else "dot"},
                    "marker": {"size": 7, "color": colour, "symbol": "circle" if side == "left" else "diamond"},
                    "hovertemplate": "%{x}<br>%{text}, %{y:.2f} mA",
                }
            )  # fmt: skip
            rows += [[f"{at:%Y-%m-%d}" if at else "", side, name, ma] for at, name, ma in points]
    if not lines:
        return None
    return Chart(
        f"groups-{number}",
        "Amplitude of the active group",
        f"mA · as set at the end of each of {len({g.at for g in active})} programming sessions",
        figure(lines, xaxis=axis("Date", "", type="date"), yaxis=axis("Amplitude", "mA", rangemode="tozero"), showlegend=True),
        ("Date", "Side", "Group", "Amplitude (mA)"),
        sorted(rows, key=str),
        height=240,
    )


def _spectra_chart(identity: str, title: str, side: str, spectra: Sequence[Spectrum]) -> Chart:
    """Plot spectra of one side, the newest where there are many."""
    shown = sorted(spectra, key=lambda s: str(s.at or ""))[-MOST_SPECTRA:]
    names = [_named(s) for s in shown]
    lines = [
        {
            "type": "scatter", "mode": "lines", "name": name, "x": s.hz, "y": s.magnitude,
            "line": {"color": _COLOURS[i % len(_COLOURS)], "dash": _DASHES[i // len(_COLOURS) % len(_DASHES)], "width": 1.3},
            "hovertemplate": f"%{{x:.1f}} Hz<br>{hover()} uVp",
        }
        for i, (s, name) in enumerate(zip(shown, names, strict=True))
    ]  # fmt: skip
    tables = [dict(zip(s.hz, s.magnitude, strict=True)) for s in shown]
    rows: list[list[Cell]] = [[hz, *(t.get(hz) for t in tables)] for hz in sorted({hz for t in tables for hz in t})]
    several = f"the newest {len(shown)} of {len(spectra)}" if len(shown) < len(spectra) else f"n = {len(shown)}"
    layout = {"xaxis": axis("Frequency", "Hz", zeroline=False), "yaxis": axis("Magnitude", "uVp", rangemode="tozero"), "showlegend": True}
    return Chart(
        identity,
        f"{title}, {side} side" if side else title,
        f"uVp, as the device gives it · {several}",
        figure(lines, **layout),
        ("Frequency (Hz)", *(f"{name} (uVp)" for name in names)),
        rows,
        height=320 + 20 * (len(shown) // 4),
    )


def _named(spectrum: Spectrum) -> str:
    if spectrum.at is not None:
        return f"{spectrum.label}, {spectrum.at:%Y-%m-%d %H:%M}"
    channel = spectrum.channel.replace("_", " ").lower() or "channel not told"
    return f"{channel} (artefact)" if "PRESENT" in spectrum.artifact and "NOT" not in spectrum.artifact else channel


def _iso(unix_s: float) -> str:
    return datetime.fromtimestamp(unix_s, UTC).strftime("%Y-%m-%dT%H:%M:%S")


def _day(unix_s: float) -> str:
    return datetime.fromtimestamp(unix_s, UTC).strftime("%Y-%m-%d")
