"""Charts of one recording: every trace on its own grid, and the spectrum of every channel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.platform.numbers import hover
from app.platform.web.charts import Cell, Chart, axis, figure
from app.study.recordings.facts import clock_fit
from app.study.traces import unpack
from app.tables.recordings import Recording, Trace

_DASHES = ("solid", "dash", "dot", "dashdot", "longdash")
TIME = "session"
"""Charts over the time of a session zoom together."""
_COLOURS = ("token:cdbs", "token:rl", "token:random", "token:distilled", "token:other", "token:no_dbs")


@dataclass(frozen=True)
class Stretch:
    """The part of a recording that a page shows, in the recording's seconds.

    Attributes:
        origin_s: where the session starts. first_s, last_s: what is shown, from the session's start.
    """

    origin_s: float
    first_s: float
    last_s: float


def trace_charts(recording: Recording, traces: Sequence[Trace], stretch: Stretch) -> list[Chart]:
    """Plot all traces of a recording, one chart per unit and length of step; what is missing stays a gap."""
    charts = []
    kinds = sorted({(t.unit, t.dt_s) for t in traces})
    for number, (unit, dt_s) in enumerate(kinds):
        group = [t for t in traces if (t.unit, t.dt_s) == (unit, dt_s)]
        lines: list[dict[str, Any]] = []
        rows: list[list[Cell]] = []
        for i, trace in enumerate(group):
            ends = trace.first_end_s - stretch.origin_s + trace.dt_s * np.arange(trace.n)
            inside = (ends > stretch.first_s - dt_s / 2) & (ends <= stretch.last_s + dt_s / 2)
            values = unpack(trace)[inside]
            name = trace_name(trace)
            lines.append(_line(name, ends[inside] / 60, values, i, unit))
            known = values[~np.isnan(values)]
            spread: list[Cell] = [float(np.median(known)), float(known.min()), float(known.max())] if known.size else [None, None, None]
            rows.append([name, int(known.size), int(values.size), *spread, trace.source.replace("_", " "), trace.decode_version])
        layout = {
            "xaxis": axis("Time in session", "min"), "yaxis": axis("", unit, zeroline=False, fixedrange=True), "showlegend": True,
            "dragmode": "zoom",
        }  # fmt: skip
        charts.append(
            Chart(
                f"traces-{recording.id}-{number}",
                _title(group),
                f"{unit} over {dt_s:g} s · {_windows(rows)}",
                figure(lines, **layout),
                ("Trace", "Valid", "Windows", f"Median ({unit})", f"Minimum ({unit})", f"Maximum ({unit})", "Source", "Decode version"),
                rows,
                height=_height(300, lines),
                zoom=TIME,
            )
        )
    return charts


def spectrum_charts(recording: Recording, low_hz: float, high_hz: float) -> list[Chart]:
    """Plot the power spectral density per channel over the whole recording, one chart per unit; the beta band is shaded."""
    spectra = [s for s in recording.details.get("spectra") or [] if s.get("hz")]
    charts = []
    for number, unit in enumerate(sorted({str(s["unit"]) for s in spectra})):
        group = [s for s in spectra if s["unit"] == unit]
        lines = []
        for i, spectrum in enumerate(group):
            line = _line(str(spectrum["channel"]), _numbers(spectrum["hz"]), _numbers(spectrum["density"]), i, unit)
            lines.append(line | {"mode": "lines", "hovertemplate": f"%{{x:.1f}} Hz<br>{hover()} {unit}"})
        band = {
            "type": "rect", "xref": "x", "x0": low_hz, "x1": high_hz, "yref": "paper", "y0": 0, "y1": 1, "line": {"width": 0},
            "fillcolor": "token:accent/0.12", "layer": "below",
        }  # fmt: skip
        label = {
            "text": f"beta {low_hz:g}-{high_hz:g} Hz", "xref": "x", "x": (low_hz + high_hz) / 2, "yref": "paper", "y": 1, "yanchor": "top",
            "showarrow": False, "font": {"size": 12, "color": "token:muted"},
        }  # fmt: skip
        layout = {
            "xaxis": axis("Frequency", "Hz", zeroline=False), "yaxis": axis("Density", unit, type="log", exponentformat="power"),
            "shapes": [band], "annotations": [label], "showlegend": True,
        }  # fmt: skip
        seconds = "; ".join(f"{s['channel']} {float(s['seconds']):.0f} s" for s in group)
        columns = ("Frequency (Hz)", *(f"{s['channel']} ({unit})" for s in group))
        charts.append(
            Chart(
                f"spectrum-{recording.id}-{number}",
                "Spectrum",
                f"{unit} · whole recording, gaps left out · signal: {seconds}",
                figure(lines, **layout),
                columns,
                _by_frequency(group),
                height=_height(320, lines),
            )
        )
    return charts


def clock_chart(recording: Recording) -> Chart | None:
    """Plot the residuals of PacketGenTime over the implant's ticks, and where a clock was set; None where nothing is known of it."""
    fit = clock_fit(recording)
    if fit is None or not fit.residual_ms:
        return None
    minutes = np.array(fit.residual_t_s) / 60
    line = {
        "type": "scatter", "mode": "markers", "name": "PacketGenTime", "x": minutes, "y": np.array(fit.residual_ms),
        "marker": {"size": 3.5, "color": "token:cdbs"}, "hovertemplate": "%{x:.2f} min<br>%{y:.0f} ms<extra></extra>",
    }  # fmt: skip
    steps = [("PC", t, by) for t, by in fit.pc_steps] + [("implant", t, by) for t, by in fit.implant_steps]
    shapes = [
        {
            "type": "line", "xref": "x", "x0": t / 60, "x1": t / 60, "yref": "paper", "y0": 0, "y1": 1,
            "line": {"width": 1.5, "dash": "dot", "color": "token:warn"},
        }
        for _, t, _ in steps
    ]  # fmt: skip
    labels = [
        {
            "text": f"{whose} clock set by {by:+.1f} s", "xref": "x", "x": t / 60, "yref": "paper", "y": 1, "yanchor": "bottom",
            "showarrow": False, "font": {"size": 12, "color": "token:muted"},
        }
        for whose, t, by in steps
    ]  # fmt: skip
    said = ["ms · extremes per piece of the recording; times are those of the implant's ticks"]
    if fit.sd_ms is not None and fit.beyond_50_ms is not None:
        said.append(f"SD {fit.sd_ms:.0f} ms, {100 * fit.beyond_50_ms:.1f} % of packets beyond 50 ms")
    said.append("too short to tell the drift" if fit.drift_ppm is None else f"drift {fit.drift_ppm:+.0f} ppm")
    layout = {
        "xaxis": axis("Time in recording", "min"), "yaxis": axis("Residual", "ms"), "shapes": shapes, "annotations": labels,
        "showlegend": False, "margin": {"l": 62, "r": 20, "t": 30 if steps else 12, "b": 44},
    }  # fmt: skip
    rows: list[list[Cell]] = [[t, ms] for t, ms in zip(fit.residual_t_s, fit.residual_ms, strict=True)]
    return Chart(
        f"clock-{recording.id}",
        "Clock of the computer against the implant's",
        " · ".join(said),
        figure([line], **layout),
        ("Time in recording (s)", "Residual (ms)"),
        rows,
        height=200,
    )


def _windows(rows: Sequence[Sequence[Cell]]) -> str:
    """Describe valid windows of each trace in words, from rows (name, valid, windows, …)."""
    valid, windows = (_span([int(row[i] or 0) for row in rows]) for i in (1, 2))
    return (
        f"n = {valid} of {windows} windows valid"
        if len(rows) == 1
        else f"{len(rows)} traces, n = {valid} of {windows} windows valid in each"
    )


def _span(counts: Sequence[int]) -> str:
    return str(counts[0]) if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"


def trace_name(trace: Trace) -> str:
    """Name a trace for a page."""
    return f"{trace.stream} {trace.channel}".strip().replace("_", " ")


def _by_frequency(group: Sequence[Mapping[str, Any]]) -> list[list[Cell]]:
    tables = [dict(zip(s["hz"], s["density"], strict=False)) for s in group]
    return [[float(hz), *(t.get(hz) for t in tables)] for hz in sorted({hz for t in tables for hz in t})]


def _line(name: str, x: NDArray[np.float64], y: NDArray[np.float64], i: int, unit: str) -> dict[str, Any]:
    colour = _COLOURS[i % len(_COLOURS)]
    return {
        # markers, for a single window between two gaps has no line
        "type": "scatter", "mode": "lines+markers", "name": name, "x": x, "y": y, "connectgaps": False,
        "marker": {"size": 2.5, "color": colour},
        "line": {"color": colour, "dash": _DASHES[i // len(_COLOURS) % len(_DASHES)], "width": 1.3},
        "hovertemplate": f"%{{x:.2f}} min<br>{hover(digits=4)} {unit}",
    }  # fmt: skip


def _height(base: int, lines: Sequence[Any]) -> int:
    """Return the height for a legend of several rows."""
    return base + 20 * max(0, (len(lines) - 1) // 4)


def _title(group: Sequence[Trace]) -> str:
    streams = ", ".join(sorted({t.stream.replace("_", " ") for t in group}))
    return streams[:1].upper() + streams[1:]


def _numbers(values: Sequence[float | None]) -> NDArray[np.float64]:
    return np.array([np.nan if v is None else v for v in values], dtype=np.float64)
