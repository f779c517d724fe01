"""A proposed session at a glance: beta above, amplitude below, small enough for the row of its form."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from app.platform.numbers import counted
from app.platform.web.charts import written
from app.platform.web.svg import Plane, drawing
from app.study.sessions.usable_steps import SessionData

W, LEFT, TOP, EACH, BETWEEN, BOTTOM = 520.0, 44.0, 22.0, 48.0, 44.0, 38.0


def thumbnail(data: SessionData) -> Markup | None:
    """Draw the steps of a session; None where neither beta nor an amplitude is known. Missing steps stay gaps."""
    table = data.table
    inside = table.t_s > 0
    minutes = table.t_s[inside] / 60
    known_ma = bool(np.any(~np.isnan(table.amplitude_ma[inside])))
    amplitude = table.amplitude_ma[inside] if known_ma else 100 * table.fraction[inside]
    unit = written(table.beta_trace.unit) if table.beta_trace else ""
    strips = [(table.beta[inside], f"Beta ({unit})", "accent"), (amplitude, f"Amplitude ({'mA' if known_ma else '% of cDBS'})", "text")]
    shown = [s for s in strips if np.any(~np.isnan(s[0]))]
    if not shown:
        return None
    titles = [""] * (len(shown) - 1) + ["Time (min)"]
    planes = [_strip(minutes, *strip, titles[k], TOP + k * (EACH + BETWEEN)) for k, strip in enumerate(shown)]
    height = TOP + len(shown) * (EACH + BETWEEN) - BETWEEN + BOTTOM
    words = " and ".join(title for _, title, _ in shown)
    return drawing(W, height, f"{words} over {counted(round(float(minutes[-1])), 'minute')}", "Gaps are steps without a value.", planes)


def _strip(minutes: NDArray[np.float64], values: NDArray[Any], title: str, colour: str, below: str, top: float) -> Plane:
    highest = float(np.nanquantile(values, 0.98)) or 1.0
    plane = Plane(LEFT, top, W - LEFT - 8, EACH, (0.0, float(minutes[-1])), (min(0.0, float(np.nanmin(values))), 1.1 * highest))
    plane.axes(below, title, x_ticks=6, y_ticks=2)
    plane.line(_points(minutes, values), colour, 1.2, step=colour == "text")
    return plane


def _points(minutes: NDArray[np.float64], values: NDArray[Any]) -> Sequence[tuple[float, float | None]]:
    return [(t, None if np.isnan(v) else float(v)) for t, v in zip(minutes.tolist(), values.tolist(), strict=True)]
