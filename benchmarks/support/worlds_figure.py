"""Every world as a dot, one row per method and design: a mean alone hides the worlds in which a method fails."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from xml.sax.saxutils import escape

import numpy as np

LEFT, RIGHT, ROW, TOP, WIDTH = 190, 20, 30, 46, 760
DOT, MEAN = "#1f5a96", "#c8702a"


def draw_worlds(rows: Mapping[str, Sequence[float]], title: str) -> str:
    """Strip chart of values in [-1, 1] as plain SVG: label -> one value per world; long bar: their mean, short bar: the worst decile."""
    height = TOP + ROW * len(rows) + 40

    def x(value: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * (min(max(value, -1.0), 1.0) + 1) / 2

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}" '
        'font-family="sans-serif" font-size="13">',
        f'<rect width="{WIDTH}" height="{height}" fill="#ffffff"/>',
        f'<text x="{LEFT}" y="22" font-weight="bold">{escape(title)}</text>',
    ]
    bottom = TOP + ROW * len(rows)
    for tick in (-1.0, -0.5, 0.0, 0.5, 1.0):
        parts.append(f'<line x1="{x(tick):.1f}" x2="{x(tick):.1f}" y1="{TOP - 10}" y2="{bottom}" stroke="#dddddd"/>')
        parts.append(f'<text x="{x(tick):.1f}" y="{bottom + 18}" text-anchor="middle">{tick:g}</text>')
    for k, (label, values) in enumerate(rows.items()):
        y = TOP + ROW * k + ROW / 2
        mean, worst = float(np.mean(values)), float(np.quantile(values, 0.1))
        parts.append(f'<text x="{LEFT - 12}" y="{y + 4:.1f}" text-anchor="end">{escape(label)}</text>')
        parts += [f'<circle cx="{x(v):.1f}" cy="{y:.1f}" r="4.5" fill="{DOT}" fill-opacity="0.45"/>' for v in values]
        for at, reach in ((mean, 11), (worst, 5)):
            ends = f'x1="{x(at):.1f}" x2="{x(at):.1f}" y1="{y - reach:.1f}" y2="{y + reach:.1f}"'
            parts.append(f'<line {ends} stroke="{MEAN}" stroke-width="3"/>')
    return "\n".join([*parts, "</svg>\n"])
