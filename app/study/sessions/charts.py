"""The main chart of one session: beta against the threshold and the amplitude on one time axis; its stimulation steps and conflicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.platform.numbers import counted, hover, ma, number, stated
from app.platform.web.charts import ACCENT, BAD, GRID, MUTED, TEXT, WARN, Cell, Chart, axis, figure, horizontal
from app.study.recordings.charts import TIME
from app.study.sessions.usable_steps import SessionData
from app.study.traces import amplitude_program, session_offset_s
from ml.mdp import AMPLITUDE_TOLERANCE

MOST_LEVELS = 12
"""Amplitudes that are shown one by one; more of them are drawn in bins."""
BINS = 10
MOST_LISTED = 60
"""Stretches of equal amplitude that are listed whatever they are."""
NOTED = {"operator_note": "", "patient": "marked by the patient", "annotation": "annotation", "rating": "rating"}
"""Kinds of events that people noted, and the words that follow them."""


@dataclass(frozen=True)
class StimulationStep:
    """A stretch of equal amplitude, in seconds of the session.

    Attributes:
        amplitude_ma, fraction: None where unknown.
    """

    start_s: float
    stop_s: float
    amplitude_ma: float | None
    fraction: float | None

    @property
    def above_cdbs(self) -> bool:
        """True where the fraction exceeds the cDBS amplitude."""
        return self.fraction is not None and self.fraction > 1 + AMPLITUDE_TOLERANCE


def stimulation_steps(data: SessionData, events: Sequence[Mapping[str, Any]], origin_s: float) -> list[StimulationStep]:
    """Find stretches of equal amplitude within the session: from the device's log where there is one, else from the 2 s table.

    Under embedded adaptive stimulation the log of stimulation does not hold what was delivered (the amplitude trace comes from AdaptiveLog
    then): the table counts.

    Args:
        data: the session. events: of its control recording, as stored. origin_s: where the session starts in that recording's clock.
    """
    trace = data.table.amplitude_trace
    origin = trace.details.get("origin") if trace is not None else None
    logged = [e for e in events if e["kind"] == "stimulation" and "delivered_ma" in e["data"] and e["data"].get("origin", origin) == origin]
    known = bool(logged) and all(e["data"]["delivered_ma"] is not None for e in logged)
    return _logged_steps(data, logged, origin_s) if known else _table_steps(data)


def in_chart_table(data: SessionData, steps: Sequence[StimulationStep]) -> bool:
    """Check whether the table behind the chart lists the same, row by row: many stretches, on its grid, of less than two rows each."""
    ends = np.array([(s.start_s, s.stop_s) for s in steps]) / data.settings.period_s
    return (
        len(steps) > MOST_LISTED and 2 * len(steps) > int(np.sum(data.table.t_s > 0)) and bool(np.allclose(ends, np.rint(ends), atol=1e-3))
    )


def _logged_steps(data: SessionData, logged: Sequence[Mapping[str, Any]], origin_s: float) -> list[StimulationStep]:
    """Build steps from the device's log, in the program that the amplitude trace shows, cut at the session's ends."""
    trace, cdbs = data.table.amplitude_trace, data.table.cdbs_ma
    program = amplitude_program(trace) if trace else 0
    changes = sorted((float(e["t_s"]) - origin_s, float(e["data"]["delivered_ma"][program])) for e in logged)
    steps: list[StimulationStep] = []
    for i, (start, amplitude) in enumerate(changes):
        stop = min(changes[i + 1][0] if i + 1 < len(changes) else data.session.duration_s, data.session.duration_s)
        start = max(start, 0.0)
        if stop <= start:
            continue
        if steps and steps[-1].amplitude_ma == amplitude:
            start = steps.pop().start_s
        steps.append(StimulationStep(start, stop, amplitude, amplitude / cdbs if cdbs else None))
    return steps


def operator_conflicts(events: Sequence[Mapping[str, Any]], origin_s: float) -> list[tuple[float, str, float | None]]:
    """List operator's notes that disagree with the device: time in the session (s), the note, what the device delivered (mA)."""
    notes = (e for e in events if e["kind"] == "operator_note" and e["data"].get("conflict"))
    return [(float(e["t_s"]) - origin_s, str(e["label"]), e["data"].get("device_amplitude_ma")) for e in notes]


def notes(events: Sequence[Mapping[str, Any]], origin_s: float, duration_s: float) -> list[tuple[float, str]]:
    """List notes within the session: time in the session (s), and an operator's note, a patient's event, an annotation, a rating."""
    found = [(float(e["t_s"]) - origin_s, _noted(e)) for e in events if e["kind"] in NOTED]
    return sorted((t, label) for t, label in found if 0 <= t <= duration_s)


def _noted(event: Mapping[str, Any]) -> str:
    value = event["data"].get("value") if event["kind"] == "rating" else None
    label = f"{event['label']}: {value:g}" if isinstance(value, int | float) else str(event["label"])
    return f"{label} ({NOTED[event['kind']]})" if NOTED[event["kind"]] else label


def _fit_axis(yaxis: dict[str, Any], values: NDArray[np.float64], threshold: float | None) -> float | None:
    """Keep a few huge windows (an amplifier's step) from flattening the rest; returns the top of the axis where some lie above it."""
    known = values[~np.isnan(values)]
    if known.size < 20:
        return None
    top = 1.5 * float(np.quantile(known, 0.9))
    if float(known.max()) <= 4 * top or top <= 0:
        return None
    top = max(top, 1.2 * threshold if threshold is not None else 0.0)
    yaxis["range"] = [0, top]
    return top


def _table_steps(data: SessionData) -> list[StimulationStep]:
    """Find runs of equal amplitude in the 2 s table; unknown stretches between known ones are steps without amplitude."""
    table, period = data.table, data.settings.period_s
    inside = table.t_s > 0
    ends, values = table.t_s[inside], np.where(np.isnan(table.amplitude_ma), table.fraction, table.amplitude_ma)[inside]
    if not np.any(~np.isnan(values)):
        return []
    # amplitudes are set in steps of 0.1 mA or coarser; float32 noise makes no new step
    keys = np.where(np.isnan(values), -1.0, np.round(values, 4))
    starts = np.flatnonzero(np.r_[True, np.diff(keys) != 0])
    stops = np.r_[starts[1:], keys.size]
    milliamperes, fraction = table.amplitude_ma[inside], table.fraction[inside]
    return [
        StimulationStep(float(ends[i] - period), float(ends[j - 1]), _known(milliamperes[i]), _known(fraction[i]))
        for i, j in zip(starts, stops, strict=True)
    ]


def control_chart(data: SessionData) -> Chart:
    """Plot beta with the threshold above, amplitude in mA and as a fraction below; windows without valid beta stay gaps."""
    table, settings = data.table, data.settings
    minutes = table.t_s / 60
    # rows lie on a grid, of which its begin and its step travel
    grid = {"x0": minutes[0], "dx": settings.period_s / 60}
    unit = table.beta_trace.unit if table.beta_trace else ""
    stream = table.beta_trace.stream if table.beta_trace else "beta"
    name = {"beta": "Beta amplitude", "band_power": "Band power"}.get(stream, stream.replace("_", " ").capitalize())
    known = int(np.sum(~np.isnan(table.beta[table.t_s > 0])))
    traces: list[dict[str, Any]] = [
        {
            "type": "scatter", "mode": "lines+markers", "name": name, **grid, "y": _drawn(table.beta), "connectgaps": False,
            "line": {"color": ACCENT, "width": 1.5}, "marker": {"size": 3.5, "color": ACCENT},
            "hovertemplate": f"%{{x:.2f}} min<br>{hover(digits=4)} {unit}<extra></extra>",
        },
        *_amplitude_traces(data, minutes, grid),
    ]  # fmt: skip
    # from the first row to the last, without the air that markers get: the samples below have the same span
    span = {"minallowed": float(minutes[0]), "maxallowed": float(minutes[-1])}
    layout: dict[str, Any] = {
        "grid": {"rows": 2, "columns": 1},
        "xaxis": axis("Time in session", "min", anchor="y2", zeroline=False, autorangeoptions=span),
        "yaxis": axis(name, unit, domain=[0.47, 1.0], zeroline=False, rangemode="tozero", fixedrange=True),
        "yaxis2": axis(
            "Amplitude", "mA" if _has(table.amplitude_ma) else "fraction", domain=[0.0, 0.38], rangemode="nonnegative", zeroline=False,
            fixedrange=True,
        ),
        "shapes": [], "annotations": [], "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0},
        "hovermode": "x unified", "dragmode": "zoom", "margin": {"l": 62, "r": 62, "t": 30, "b": 44},
    }  # fmt: skip
    _mark_lead(layout, float(minutes[0]))
    if data.threshold is not None:
        line, _ = horizontal(data.threshold, "", WARN)
        layout["shapes"].append(line)
        # named in the legend: beta runs about the threshold, so that a label at the line would lie on the data
        label = f"threshold {stated(data.threshold, 4)} {unit}".strip()
        traces.append({"type": "scatter", "mode": "lines", "name": label, "x": [None], "y": [None], "line": line["line"]})
    missing = _mark_missing(layout, data) if table.beta_trace else 0
    if missing:
        # an entry of the legend for the shading
        shade = {"symbol": "square", "size": 11, "color": "token:warn/0.3"}
        traces.append({"type": "scatter", "mode": "markers", "name": "no valid window", "x": [None], "y": [None], "marker": shade})
    spikes = _spike_rows(data)
    if spikes.any():
        bottom = np.where(np.isnan(table.beta), 0.0, table.beta)
        mark = {"symbol": "x-thin", "size": 9, "color": BAD, "line": {"width": 2, "color": BAD}}
        traces.append(
            {
                "type": "scatter", "mode": "markers", "name": "power spikes left out", "x": minutes[spikes], "y": bottom[spikes],
                "marker": mark, "hoverinfo": "skip",
            }
        )  # fmt: skip
    top = _fit_axis(layout["yaxis"], table.beta, data.threshold)
    over = table.beta > (top if top is not None else np.inf)
    if top is not None:
        traces.append(
            {
                "type": "scatter", "mode": "markers", "name": "above the axis", "x": minutes[over],
                "y": np.full(int(over.sum()), 0.985 * top), "marker": {"symbol": "triangle-up-open", "size": 9, "color": BAD},
                "customdata": table.beta[over], "hovertemplate": f"{hover('customdata', 4)} {unit}<extra>above the axis</extra>",
            }
        )  # fmt: skip
    if _has(table.amplitude_ma) and table.cdbs_ma:
        held, _ = horizontal(table.cdbs_ma, "", MUTED, "dot", "y2")
        layout["shapes"].append(held)
        # in the legend too: a controller often asks for just that amplitude, and its line would lie under a label
        label = f"cDBS {ma(table.cdbs_ma)} mA"
        traces.append({"type": "scatter", "mode": "lines", "name": label, "x": [None], "y": [None], "line": held["line"]})
        highest = 1.15 * max(table.cdbs_ma, float(np.nanmax(table.amplitude_ma)))
        layout["yaxis2"] |= {"range": [0, highest]}
        layout["yaxis3"] = axis(
            "of cDBS",
            "%",
            overlaying="y2",
            side="right",
            range=[0, 100 * highest / table.cdbs_ma],
            showgrid=False,
            zeroline=False,
            tickmode="auto",
            fixedrange=True,
        )
        traces.append({"type": "scatter", "x": [minutes[0]], "y": [None], "yaxis": "y3", "showlegend": False, "hoverinfo": "skip"})
    subtitle = f"{unit or 'no unit'} over {settings.period_s:g} s · n = {known} of {int(np.sum(table.t_s > 0))} steps with a valid window"
    if over.any():
        subtitle += f" · {int(over.sum())} above the axis, up to {number(float(np.nanmax(table.beta)))}"
    if spikes.any():
        subtitle += f" · power spikes left out of {counted(int(spikes.sum()), 'window')}"
    columns = ("Step end (s)", f"{name} ({unit or '—'})", "Amplitude (mA)", "Fraction of cDBS", "Mark")
    marks = [_mark(m, x) for m, x in zip(np.isnan(table.beta), spikes, strict=True)]
    rows: list[list[Cell]] = [
        [float(t), _known(b), _known(a), _known(f), mark]
        for t, b, a, f, mark in zip(table.t_s, table.beta, table.amplitude_ma, table.fraction, marks, strict=True)
    ]
    if table.beta_trace and table.beta_trace.channel not in ("", table.beta_trace.source):
        subtitle = f"{table.beta_trace.channel} · {subtitle}"
    title = f"{name} and amplitude of stimulation" if table.beta_trace else "Amplitude of stimulation"
    return Chart("control", title, subtitle, figure(traces, **layout), columns, rows, height=470, zoom=TIME)


def beta_by_amplitude(data: SessionData) -> Chart | None:
    """Plot beta of the windows at each amplitude: every sustained amplitude, or ten bins where there were many; None below two of them."""
    table = data.table
    in_ma = _has(table.amplitude_ma)
    amplitude, unit = (table.amplitude_ma, "mA") if in_ma else (100 * table.fraction, "% of cDBS")
    known = (table.t_s > 0) & ~np.isnan(table.beta) & ~np.isnan(amplitude)
    beta, held = table.beta[known], amplitude[known]
    levels = np.unique(np.round(held, 1 if in_ma else 0))
    if levels.size < 2:
        return None
    if levels.size <= MOST_LEVELS:
        group = np.argmin(np.abs(held[:, None] - levels), axis=1)
    else:
        edges = np.linspace(held.min(), held.max(), BINS + 1)
        group = np.clip(np.searchsorted(edges, held, side="right") - 1, 0, BINS - 1)
    rows = []
    for k in np.unique(group):
        low, middle, high = np.percentile(beta[group == k], (25, 50, 75))
        rows.append([float(held[group == k].mean()), int(np.sum(group == k)), float(middle), float(low), float(high)])
    x, n, y, low, high = (np.array(column) for column in zip(*rows, strict=True))
    beta_unit = table.beta_trace.unit if table.beta_trace else ""
    line = {
        "type": "scatter", "mode": "lines+markers", "x": x, "y": y, "customdata": n, "line": {"color": GRID, "width": 1},
        "marker": {"color": ACCENT, "size": 8},
        "error_y": {"type": "data", "symmetric": False, "array": high - y, "arrayminus": y - low, "color": ACCENT, "thickness": 1.5},
        "hovertemplate": f"{hover('x')} {unit}<br>{hover(digits=4)} {beta_unit}<br>n = %{{customdata}} windows<extra></extra>",
    }  # fmt: skip
    layout: dict[str, Any] = {"xaxis": axis("Amplitude", unit, zeroline=False), "yaxis": axis("Beta", beta_unit, rangemode="tozero")}
    if data.threshold is not None:
        shape, label = horizontal(data.threshold, "threshold", WARN)
        layout |= {"shapes": [shape], "annotations": [label]}
    columns = (f"Amplitude ({unit})", "Windows", f"Median ({beta_unit})", f"25 % ({beta_unit})", f"75 % ({beta_unit})")
    subtitle = (
        f"median and quartiles, {beta_unit} · n = {counted(int(known.sum()), 'window')} · what came together, not what the amplitude did"
    )
    return Chart("beta-by-amplitude", "Beta by amplitude", subtitle, figure([line], **layout), columns, rows, height=280)


def _drawn(values: NDArray[np.float64]) -> list[float]:
    """Round values to four significant digits: a long session has thousands, and the table next to the chart has no more."""
    return [float(f"{v:.4g}") for v in values]


def _amplitude_traces(data: SessionData, minutes: NDArray[np.float64], grid: Mapping[str, float]) -> list[dict[str, Any]]:
    table = data.table
    values = table.amplitude_ma if _has(table.amplitude_ma) else table.fraction
    # a row holds the amplitude over the period that ends at its time, so the line steps first and then runs
    base: dict[str, Any] = {"type": "scatter", "yaxis": "y2", "connectgaps": False, "line": {"shape": "vh", "color": TEXT, "width": 1.8}}
    shown = hover() + (" mA (%{customdata:.0%})" if _has(table.amplitude_ma) else "") + "<extra>amplitude</extra>"
    line = {"mode": "lines", "name": "Amplitude", **grid, "y": _drawn(values), "hovertemplate": shown}
    if _has(table.amplitude_ma):
        line["customdata"] = np.round(table.fraction, 2)  # written in whole per cent
    traces = [base | line]
    above = table.fraction > 1 + AMPLITUDE_TOLERANCE
    if np.any(above):
        mark = {"symbol": "triangle-up", "size": 8, "color": BAD}
        traces.append(
            {
                "type": "scatter", "mode": "markers", "yaxis": "y2", "name": "above cDBS", "x": minutes[above], "y": values[above],
                "marker": mark, "hoverinfo": "skip",
            }
        )  # fmt: skip
    return traces


def _mark_lead(layout: dict[str, Any], first: float) -> None:
    """Shade the window before the session: the state s_0."""
    layout["shapes"].append(
        {
            "type": "rect", "xref": "x", "yref": "paper", "x0": first, "x1": 0, "y0": 0, "y1": 1, "fillcolor": GRID, "opacity": 0.35,
            "line": {"width": 0}, "layer": "below",
        }
    )  # fmt: skip


def _mark(missing: bool, spikes: bool) -> str:
    return ", ".join(word for word, on in (("no valid window", missing), ("power spikes left out", spikes)) if on)


def _spike_rows(data: SessionData) -> NDArray[np.bool_]:
    """Find rows of the session's grid in which the decoder excluded spikes."""
    table, trace = data.table, data.table.beta_trace
    out = np.zeros(table.t_s.size, dtype=bool)
    if trace is None:
        return out
    rows = np.array([r for r in trace.details.get("spike_rows") or [] if isinstance(r, int)], dtype=np.int64)
    ends = trace.first_end_s + trace.dt_s * rows - session_offset_s(data.session, trace.recording_id)
    at = np.rint((ends - table.t_s[0]) / data.settings.period_s).astype(int)
    out[at[(at >= 0) & (at < out.size)]] = True
    return out


def _mark_missing(layout: dict[str, Any], data: SessionData) -> int:
    """Shade the session's windows without a valid value; returns how many there are."""
    table, period = data.table, data.settings.period_s
    missing = np.isnan(table.beta) & (table.t_s > 0)
    edges = np.flatnonzero(np.diff(np.r_[False, missing, False].astype(int)))
    for first, stop in zip(edges[::2], edges[1::2], strict=True):
        layout["shapes"].append(
            {
                "type": "rect", "xref": "x", "x0": (table.t_s[first] - period) / 60, "x1": table.t_s[stop - 1] / 60, "yref": "y domain",
                "y0": 0, "y1": 1, "fillcolor": "token:warn/0.18", "line": {"width": 0}, "layer": "below",
            }
        )  # fmt: skip
    return int(missing.sum())


def _add(layout: dict[str, Any], line_and_label: tuple[dict[str, Any], dict[str, Any]]) -> None:
    layout["shapes"].append(line_and_label[0])
    layout["annotations"].append(line_and_label[1])


def _has(values: NDArray[np.float64]) -> bool:
    return bool(np.any(~np.isnan(values)))


def _known(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
