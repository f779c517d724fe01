"""The comparison as a figure without a script, and the numbers that a script needs to move along it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from markupsafe import Markup

from app.evaluation.replay.schemas import ReplayOut
from app.platform.web.charts import written
from app.platform.web.svg import Plane, apart, drawing

LOOKS = (("rl", ""), ("accent", "7 3"), ("distilled", "2 3"))
"""Colour and dashes of the policies, in their order."""

W, LEFT, RIGHT = 1100.0, 60.0, 132.0
NAME_LETTERS = 16
"""Of a policy's name that fit beside its line; the table below has all of it."""
BETA_H, AMPLITUDE_H, TOP, BETWEEN, BOTTOM = 120.0, 220.0, 30.0, 62.0, 44.0


def figure(found: ReplayOut, step: int) -> Markup:
    """Beta above, amplitudes below: recorded in grey, a line for each policy with its name, and where the reader is.

    Args:
        found: the comparison. step: at which the cursor stands.
    """
    unit_ma = found.cdbs_amplitude_ma
    factor, unit = (unit_ma, "mA") if unit_ma is not None else (100.0, "% of cDBS")
    minutes = [t / 60 for t in found.t_s]
    span = (0.0, minutes[-1] + found.period_s / 60)
    beta = [v for v in found.beta if v is not None]
    above = Plane(LEFT, TOP, W - LEFT - RIGHT, BETA_H, span, (min(0.0, *beta), 1.05 * max(beta)) if beta else (0.0, 1.0))
    above.axes("", f"Beta ({written(found.beta_unit)})", y_ticks=3)
    above.line(list(zip(minutes, found.beta, strict=True)), "muted", 1.2)
    top = TOP + BETA_H + BETWEEN
    known = [v for v in found.recorded_fraction if v is not None]
    below = Plane(LEFT, top, W - LEFT - RIGHT, AMPLITUDE_H, span, (0.0, factor * max(1.08, *known, 0.0)))
    below.axes("Time in the session (min)", f"Amplitude ({unit})", x_ticks=10)
    below.level(factor, "cDBS", "cdbs")
    held = [(t, None if v is None else v * factor) for t, v in zip(minutes, found.recorded_fraction, strict=True)]
    below.line(held, "border", 3.5, step=True)
    named = [("stimulated", "muted", held)]
    for (colour, dash), asked in zip(LOOKS, found.asked, strict=False):
        values = [(t, None if v is None else v * factor) for t, v in zip(minutes, asked.fraction, strict=True)]
        below.line(values, colour, 2.0, dash, step=True)
        named.append((asked.name[:NAME_LETTERS], colour, values))
    _names(below, named)
    at = below.at_x(minutes[step])
    for plane in (above, below):
        ends = f'y1="{plane.top:.0f}" y2="{plane.top + plane.height:.0f}"'
        plane.parts.append(f'<line data-cursor x1="{at:.1f}" x2="{at:.1f}" {ends} stroke="var(--c-text)" stroke-width="1"/>')
    names = ", ".join(a.name for a in found.asked)
    told = f"Lines: {names}. Grey: what stimulated in fact. Would have asked, not would have happened."
    return drawing(W, top + AMPLITUDE_H + BOTTOM, "What the policies would have asked for", told, [above, below])


def _names(plane: Plane, lines: Sequence[tuple[str, str, Sequence[tuple[float, float | None]]]]) -> None:
    """The name of each line in its colour, beside its last value; a line without any has none."""
    ends = [(name, colour, next((v for _, v in reversed(values) if v is not None), None)) for name, colour, values in lines]
    known = [(name, colour, plane.at_y(value) + 4) for name, colour, value in ends if value is not None]
    places = apart([y for _, _, y in known], low=plane.top + 4, high=plane.top + plane.height)
    for (name, colour, _), y in zip(known, places, strict=True):
        plane.text(plane.left + plane.width + 8, y, name, "start", colour, weight=650)


def frame(found: ReplayOut) -> dict[str, Any]:
    """What moving along the session needs: where the figure begins and ends, and the numbers of every step."""
    return {
        "left": LEFT,
        "width": W - LEFT - RIGHT,
        "t_s": found.t_s,
        "period_s": found.period_s,
        "cdbs_ma": found.cdbs_amplitude_ma,
        "rows": [_short(found.beta), _short(found.recorded_fraction), *(_short(a.fraction) for a in found.asked)],
    }


def _short(values: list[float | None]) -> list[float | None]:
    return [None if v is None else round(v, 3) for v in values]
