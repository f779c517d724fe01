"""Bars with error bars as plain SVG: one row per metric, one group per world, one bar per method, like the paper's."""

from __future__ import annotations

from xml.sax.saxutils import escape

import numpy as np

COLORS = ("#1f5a96", "#c8702a", "#3d8b57", "#8a5aa5", "#b5464c", "#6b6f76", "#caa12f", "#3aa0a8", "#94603d")
PANEL, LEFT, TOP, GAP, GROUP_GAP, BAR = 170, 70, 40, 46, 26, 13


def draw(found: dict[str, dict[str, dict[str, list[float]]]], metrics: tuple[str, ...]) -> str:
    """The figure. `found`: world -> method -> metric -> one number per seed; bars are means, error bars standard deviations."""
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
    rows = [table[m][metric] for table in found.values() for m in methods if m in table]
    means = [float(np.mean(r)) for r in rows] or [1.0, 1.0]
    # A method that is off by several ranges would flatten all others: its bar is cut, and its number stands on it.
    high, low = (1.0, -1.0) if "%" not in metric else (min(max([*means, 1e-9]) * 1.1, 120.0), 0.0)

    def y(value: float) -> float:
        return top + PANEL * (high - min(max(value, low), high)) / (high - low)

    right = LEFT + len(found) * group
    parts = [f'<text x="{LEFT}" y="{top - 8}" font-weight="bold">{escape(metric)}</text>']
    for tick in np.linspace(low, high, 5):
        parts.append(f'<line x1="{LEFT}" x2="{right}" y1="{y(tick):.1f}" y2="{y(tick):.1f}" stroke="#dddddd"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y(tick) + 4:.1f}" text-anchor="end">{tick:.3g}</text>')
    for g, (world, table) in enumerate(found.items()):
        for k, method in enumerate(methods):
            if method not in table:
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
