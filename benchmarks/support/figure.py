"""Figures as plain SVG: bars with error bars (one row per metric, one group per world, one bar per method, like the paper's), and curves
with intervals over visits (one for each arm)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from xml.sax.saxutils import escape

import numpy as np

COLORS = (
    *("#1f5a96", "#c8702a", "#3d8b57", "#8a5aa5", "#b5464c", "#6b6f76", "#caa12f", "#3aa0a8", "#94603d"),
    *("#7fb2e5", "#efb58a", "#8fcfa6", "#c9a6dd"),
)
PANEL, LEFT, TOP, GAP, GROUP_GAP, BAR = 170, 70, 40, 46, 26, 13


def draw(found: dict[str, dict[str, dict[str, list[float]]]], metrics: tuple[str, ...]) -> str:
    """Draw the figure. `found`: world -> method -> metric -> one number per seed; bars are means, error bars standard deviations."""
    methods = list(dict.fromkeys(m for table in found.values() for m in table))
    group = len(methods) * BAR + GROUP_GAP
    width = LEFT + max(1, len(found)) * group + 150
    height = TOP + len(metrics) * (PANEL + GAP)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="sans-serif" font-size="12">',
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
    ]
    for row, metric in enumerate(metrics):
        parts += _panel(found, metric, methods, TOP + row * (PANEL + GAP), group, last=row == len(metrics) - 1)
    for k, method in enumerate(methods):
        y = TOP + 16 * k
        parts.append(f'<rect x="{width - 135}" y="{y}" width="11" height="11" fill="{COLORS[k % len(COLORS)]}"/>')
        parts.append(f'<text x="{width - 118}" y="{y + 10}">{escape(method)}</text>')
    return "\n".join([*parts, "</svg>\n"])


def _panel(
    found: dict[str, dict[str, dict[str, list[float]]]], metric: str, methods: list[str], top: float, group: int, *, last: bool
) -> list[str]:
    rows = [table[m][metric] for table in found.values() for m in methods if table.get(m, {}).get(metric)]
    means = [float(np.mean(r)) for r in rows] or [1.0, 1.0]
    low, high, step = _axis(metric, means)

    def y(value: float) -> float:
        return top + PANEL * (high - min(max(value, low), high)) / (high - low)

    right = LEFT + len(found) * group
    parts = [f'<text x="{LEFT}" y="{top - 8}" font-weight="bold">{escape(metric)}</text>']
    for tick in np.arange(low, high + step / 2, step):
        parts.append(f'<line x1="{LEFT}" x2="{right}" y1="{y(tick):.1f}" y2="{y(tick):.1f}" stroke="#dddddd"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y(tick) + 4:.1f}" text-anchor="end">{tick:.3g}</text>')
    for g, (world, table) in enumerate(found.items()):
        for k, method in enumerate(methods):
            if not table.get(method, {}).get(metric):
                continue
            values = np.asarray(table[method][metric])
            mean, spread = float(values.mean()), float(values.std(ddof=1)) if values.size > 1 else 0.0
            x = LEFT + g * group + GROUP_GAP / 2 + k * BAR
            ends = sorted((y(0.0), y(mean)))
            parts.append(
                f'<rect x="{x}" y="{ends[0]:.1f}" width="{BAR - 2}" height="{max(ends[1] - ends[0], 0.5):.1f}" '
                f'fill="{COLORS[k % len(COLORS)]}"><title>{escape(f"{world} {method}: {mean:.3g} ± {spread:.2g}")}</title></rect>'
            )
            middle = x + (BAR - 2) / 2
            if spread > 0:
                parts.append(
                    f'<line x1="{middle}" x2="{middle}" y1="{y(mean - spread):.1f}" y2="{y(mean + spread):.1f}" stroke="#222222"/>'
                )
            if mean > high:
                parts.append(f'<text x="{middle}" y="{top + 10}" font-size="9" text-anchor="middle" fill="#ffffff">{mean:.0f}</text>')
        if last:
            parts.append(f'<text x="{LEFT + (g + 0.5) * group}" y="{top + PANEL + 18}" text-anchor="middle">{escape(world)}</text>')
    return parts


def _axis(metric: str, means: Sequence[float]) -> tuple[float, float, float]:
    """Compute the ends of a panel's axis and the step of its ticks.

    A method that is off by several ranges would flatten all others: the axis ends at twice the median where a mean is beyond that and
    120 %, such a bar is cut, and its number is written on it.
    """
    top = min(max([*means, 1e-9]), max(120.0, 2 * float(np.median(means)))) if "%" in metric else max([1.0, *means])
    bottom = min([0.0, *means])
    rough = (top - bottom) / 4
    size = 10.0 ** np.floor(np.log10(rough))
    step = float(next(s * size for s in (1.0, 2.0, 2.5, 5.0, 10.0) if s * size >= rough))
    return step * float(np.floor(bottom / step)), step * float(np.ceil(top / step)), step


CURVES, MARGIN, ABOVE, BELOW, HIGH, LEGEND = 300, 60, 46, 50, 260, 170
Point = tuple[float, float, float]
"""Mean, and the ends of its interval."""


def draw_curves(panels: Mapping[str, Mapping[str, Sequence[Point]]], across: str) -> str:
    """Draw the figure: title -> arm -> one point per visit, shares from 0 to 1; `across` names the axis below."""
    arms = list(dict.fromkeys(arm for curves in panels.values() for arm in curves))
    width = MARGIN + len(panels) * (CURVES + MARGIN) + LEGEND
    height = ABOVE + HIGH + BELOW
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="sans-serif" font-size="12">',
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
    ]
    for k, (title, curves) in enumerate(panels.items()):
        parts += _curves_panel(title, curves, arms, MARGIN + k * (CURVES + MARGIN), across)
    for k, arm in enumerate(arms):
        y = ABOVE + 18 * k
        parts.append(f'<rect x="{width - LEGEND}" y="{y}" width="11" height="11" fill="{COLORS[k % len(COLORS)]}"/>')
        parts.append(f'<text x="{width - LEGEND + 17}" y="{y + 10}">{escape(arm)}</text>')
    return "\n".join([*parts, "</svg>\n"])


def _curves_panel(title: str, curves: Mapping[str, Sequence[Point]], arms: Sequence[str], left: float, across: str) -> list[str]:
    visits = max(len(points) for points in curves.values())

    def x(visit: float) -> float:
        return left + CURVES * (visit + 0.5) / visits

    def y(share: float) -> float:
        return ABOVE + HIGH * (1 - min(max(share, 0.0), 1.0))

    parts = [f'<text x="{left}" y="{ABOVE - 16}" font-weight="bold">{escape(title)}</text>']
    for tick in (0.0, 0.25, 0.5, 0.75, 1.0):
        parts.append(f'<line x1="{left}" x2="{left + CURVES}" y1="{y(tick):.1f}" y2="{y(tick):.1f}" stroke="#dddddd"/>')
        parts.append(f'<text x="{left - 8}" y="{y(tick) + 4:.1f}" text-anchor="end">{tick:g}</text>')
    for visit in range(visits):
        parts.append(f'<text x="{x(visit):.1f}" y="{ABOVE + HIGH + 18}" text-anchor="middle">{visit + 1}</text>')
    parts.append(f'<text x="{left + CURVES / 2:.1f}" y="{ABOVE + HIGH + 38}" text-anchor="middle">{escape(across)}</text>')
    for arm, points in curves.items():
        k = arms.index(arm)
        color, aside = COLORS[k % len(COLORS)], 0.03 * (k - (len(arms) - 1) / 2)
        path = " ".join(f"{x(i + aside):.1f},{y(mean):.1f}" for i, (mean, _, _) in enumerate(points))
        parts.append(f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="2"/>')
        for i, (mean, low, high) in enumerate(points):
            at = x(i + aside)
            parts.append(f'<line x1="{at:.1f}" x2="{at:.1f}" y1="{y(low):.1f}" y2="{y(high):.1f}" stroke="{color}"/>')
            said = escape(f"{arm}: {mean:.2f} ({low:.2f} to {high:.2f})")
            parts.append(f'<circle cx="{at:.1f}" cy="{y(mean):.1f}" r="4" fill="{color}"><title>{said}</title></circle>')
    return parts
