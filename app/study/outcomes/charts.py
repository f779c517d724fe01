"""Charts of the files behind the QoCs: minutes of tremor as stacked bars, intervals of the grasp tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from app.platform.numbers import counted
from app.platform.web.charts import ACCENT, BAD, MUTED, TEXT, WARN, Cell, Chart, axis, figure, horizontal
from app.study.outcomes.values import GraspOutcome, TremorOutcome
from ml.qoc import PLAUSIBLE_INTERVAL_S, TREMOR_CLASSES

# severity by depth of one colour; patterns, so that neighbours differ without colour too
_BARS: dict[str, dict[str, Any]] = {
    "none": {"color": "token:muted/0.15"},
    "slight": {"color": "token:warn/0.25"},
    "mild": {"color": "token:warn/0.6"},
    "moderate": {"color": "token:bad/0.6", "pattern": {"shape": "/", "size": 6, "solidity": 0.25}},
    "strong": {"color": "token:bad", "pattern": {"shape": "x", "size": 6, "solidity": 0.3}},
    "unknown": {"color": "token:muted/0.45", "pattern": {"shape": ".", "size": 5, "solidity": 0.4}},
}
_SYMBOLS = {"left": "circle", "right": "square", None: "diamond"}


def tremor_chart(outcome: TremorOutcome, uploads: dict[int, int]) -> Chart:
    """Plot the minutes over a session, share per class; unclassified time, or only the sum of all tremor, has bars of its own."""
    m, reading = outcome.minutes.minutes, outcome.reading
    begin = (m.start_unix_s - outcome.start_unix_s) / 60
    width = m.duration_s / 60
    undivided = ~np.isfinite(m.fractions[:, 3:].sum(axis=1))
    shares = np.where(undivided[:, None], np.nan, np.nan_to_num(m.fractions))
    bars = {name: shares[:, TREMOR_CLASSES.index(name)] for name in _BARS}
    untold = np.where(undivided, np.nan, 1 - np.nansum(shares, axis=1))
    centre = begin + width / 2
    traces = [_bar(name, centre, width, share, style) for (name, share), style in zip(bars.items(), _BARS.values(), strict=True)]
    if np.any(untold > 0.02):
        traces.append(_bar("of no class", centre, width, np.clip(untold, 0, None), {"color": "token:muted/0.1"}))
    if undivided.any():
        whole = np.where(undivided, m.any_tremor, np.nan)
        traces.append(_bar("any tremor, not divided", centre, width, whole, {"color": "token:accent/0.4", "pattern": {"shape": "-"}}))
    length_min = reading.session_s / 60
    edges = [
        {"type": "line", "xref": "x", "x0": at, "x1": at, "yref": "paper", "y0": 0, "y1": 1, "line": {"color": TEXT, "width": 1.5}}
        for at in (0.0, length_min)
    ]
    layout = {
        "barmode": "stack", "bargap": 0, "shapes": edges, "showlegend": True,
        "xaxis": axis("Time in session", "min", zeroline=False, tickmode="auto" if length_min > 25 else "linear", tick0=0, dtick=1),
        "yaxis": axis("Share of the minute", "%", range=[0, 105], zeroline=False),
    }  # fmt: skip
    inside = np.clip(np.minimum(begin + width, length_min) - np.maximum(begin, 0), 0, None) * 60
    columns = ("From (min)", "In session (s)", *(f"{n.capitalize()} (%)" for n in TREMOR_CLASSES), "Any tremor (%)", "Upload")
    rows: list[list[Cell]] = [
        [float(begin[i]), float(inside[i]), *(_percent(x) for x in m.fractions[i]), _percent(m.any_tremor[i]), str(uploads.get(file, "—"))]
        for i, file in enumerate(outcome.minutes.upload_file_ids)
    ]
    subtitle = (
        f"% of each minute · n = {counted(begin.size, 'minute')}, {reading.covered_s / 60:.1f} of {length_min:.1f} min of the session "
        f"covered, {reading.unknown_s / 60:.1f} min unknown"
    )
    return Chart("tremor", "Tremor by minute", subtitle, figure(traces, **layout), columns, rows, height=300)


def grasp_chart(outcome: GraspOutcome) -> Chart:
    """Plot every interval between open fists, implausible ones marked; tests that do not count are drawn thin."""
    traces: list[dict[str, Any]] = []
    rows: list[list[Cell]] = []
    for test in outcome.tests:
        number = np.arange(1, test.intervals_s.size + 1)
        line = {"color": ACCENT if test.counts else MUTED, "width": 1.5 if test.counts else 1, "dash": "solid" if test.counts else "dot"}
        symbol = _SYMBOLS[test.row.hand]
        traces.append(
            {
                "type": "scatter", "mode": "lines+markers", "name": f"{test.whose} ({test.role})", "x": number, "y": test.intervals_s,
                "line": line, "marker": {"size": 6, "color": line["color"], "symbol": symbol},
                "hovertemplate": "interval %{x}<br>%{y:.3f} s<extra></extra>",
            }
        )  # fmt: skip
        odd = test.implausible
        if odd.any():
            traces.append(
                {
                    "type": "scatter", "mode": "markers", "name": f"implausible, {test.whose}",
                    "x": number[odd], "y": test.intervals_s[odd],
                    "marker": {"size": 12, "symbol": "x-thin", "line": {"width": 2.5, "color": BAD}, "color": BAD}, "hoverinfo": "skip",
                }
            )  # fmt: skip
        rows += [
            [test.whose, i + 1, float(test.open_fist_s[i]), float(seconds), "implausible" if odd[i] else ""]
            for i, seconds in enumerate(test.intervals_s)
        ]
    low, high = PLAUSIBLE_INTERVAL_S
    layout: dict[str, Any] = {
        "xaxis": axis("Interval", "number", zeroline=False),
        "yaxis": axis("Between open fists", "s", rangemode="tozero"),
        "showlegend": True,
        "shapes": [],
        "annotations": [],
    }
    longest = max((float(t.intervals_s.max()) for t in outcome.tests if t.intervals_s.size), default=0.0)
    for at, name in ((low, f"shortest plausible {low:g} s"), (high, f"longest plausible {high:g} s")):
        if at <= 1.2 * longest:
            shape, label = horizontal(at, name, WARN)
            layout["shapes"].append(shape)
            layout["annotations"].append(label)
    n = sum(t.intervals_s.size for t in outcome.tests)
    odd_n = sum(int(t.implausible.sum()) for t in outcome.tests)
    implausible = f", {odd_n} implausible" if odd_n else ""
    subtitle = f"s between open fists · n = {counted(n, 'interval')} in {counted(len(outcome.tests), 'test')}{implausible}"
    columns = ("Hand", "Interval", "From (s)", "Length (s)", "Mark")
    return Chart("grasps", "Grasp intervals", subtitle, figure(traces, **layout), columns, rows, height=280)


def _bar(name: str, centre: Any, width: Any, share: Any, style: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "bar", "name": name, "x": centre, "y": 100 * share, "width": width, "marker": {"line": {"width": 0}, **style},
        "hovertemplate": "%{x:.1f} min<br>%{y:.0f} %<extra>" + name + "</extra>",
    }  # fmt: skip


def _percent(value: float) -> float | None:
    return None if np.isnan(value) else float(100 * value)
