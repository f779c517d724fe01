"""Figures as SVG files, for papers and slides: no script, one font, the colours of the pages."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape

from app.platform.numbers import stated
from app.platform.web.charts import side_by_side
from app.platform.web.csv_files import safe_cell

COLOURS = {"cdbs": "#0067a8", "rl": "#c24e00", "distilled": "#9b3f86", "no_dbs": "#5d6770", "random": "#00795a", "other": "#7a6200"}
PANEL_W, PANEL_H, LEFT, TOP, BOTTOM, GAP, EMPTY_W = 250, 190, 52, 44, 52, 18, 1000
SYNTHETIC = "Synthetic: a simulation and no person."
"""Begins the note of figures about simulations."""
CHARACTER_W = 6.3
"""Of the figures' font, px, on average."""
DOT = 2.4
"""Radius of a session's point, px."""


@dataclass(frozen=True)
class Box:
    """One box of a panel: a label (a participant or controller), its values, and the text above it."""

    label: str
    colour: str
    values: tuple[float, ...]
    above: str


@dataclass(frozen=True)
class Panel:
    """One metric."""

    title: str
    unit: str
    boxes: tuple[Box, ...]


def boxes_svg(panels: Sequence[Panel], title: str, note: str) -> str:
    """Draw boxes (quartiles, whiskers to the extremes) with every session as a point, a panel per metric."""
    widths = [max(PANEL_W, _place_width(p) * len(p.boxes) + 40) for p in panels]
    width = LEFT + sum(widths) + (GAP + LEFT) * (len(panels) - 1) + 16 if panels else EMPTY_W
    height = TOP + PANEL_H + BOTTOM + 40
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height}" width="{width:.0f}" height="{height}" '
        'font-family="system-ui, sans-serif" font-size="11" fill="#1f2937">',
        f"<title>{escape(title)}</title>",
        f'<rect width="{width:.0f}" height="{height}" fill="#ffffff"/>',
    ]
    x = float(LEFT)
    for panel, w in zip(panels, widths, strict=True):
        parts += _panel(panel, x, float(w))
        x += w + GAP + LEFT
    parts += [f'<text x="{LEFT}" y="{height - 12}" fill="#6b7280">{escape(note)}</text>', "</svg>"]
    return "\n".join(parts)


def _place_width(panel: Panel) -> float:
    """Return the width of one box: wide enough for the longest line of a label, so that labels do not overlap."""
    lines = [line for b in panel.boxes for line in (*b.label.split("\n"), b.above)]
    return max(36.0, CHARACTER_W * max(map(len, lines), default=0) + 6)


def _panel(panel: Panel, x: float, w: float) -> list[str]:
    values = [v for b in panel.boxes for v in b.values]
    low, high = (min(0.0, min(values)), max(values)) if values else (0.0, 1.0)
    high = high if high > low else low + 1.0
    bottom = TOP + PANEL_H

    def y(value: float) -> float:
        return bottom - (value - low) / (high - low) * PANEL_H * 0.94

    parts = [
        f'<text x="{x:.0f}" y="16" font-size="13" font-weight="600">{escape(panel.title)}</text>',
        f'<text x="{x:.0f}" y="30" fill="#6b7280">{escape(panel.unit)}</text>',
        f'<line x1="{x:.1f}" y1="{bottom}" x2="{x + w:.1f}" y2="{bottom}" stroke="#9ca3af"/>',
    ]
    for i in range(5):
        at = low + (high - low) * i / 4
        parts.append(f'<line x1="{x:.1f}" y1="{y(at):.1f}" x2="{x + w:.1f}" y2="{y(at):.1f}" stroke="#e5e7eb"/>')
        parts.append(f'<text x="{x - 6:.1f}" y="{y(at) + 4:.1f}" text-anchor="end" fill="#6b7280">{stated(at, 3)}</text>')
    step, scale = w / max(1, len(panel.boxes)), PANEL_H * 0.94 / (high - low)
    for i, box in enumerate(panel.boxes):
        parts += _box(box, x + step * (i + 0.5), min(26.0, step * 0.6), y, bottom, scale)
    return parts


def _box(box: Box, x: float, w: float, y: Callable[[float], float], bottom: float, scale: float) -> list[str]:
    # `scale`: px of one unit of the values
    parts = [
        f'<text x="{x:.1f}" y="{bottom + 14 + 13 * k}" text-anchor="middle">{escape(line)}</text>'
        for k, line in enumerate(box.label.split("\n"))
    ]
    if box.values:
        ordered = sorted(box.values)
        q1, middle, q3 = (_quantile(ordered, q) for q in (0.25, 0.5, 0.75))
        c = box.colour
        parts += [
            f'<line x1="{x:.1f}" y1="{y(ordered[0]):.1f}" x2="{x:.1f}" y2="{y(ordered[-1]):.1f}" stroke="{c}"/>',
            f'<rect x="{x - w / 2:.1f}" y="{y(q3):.1f}" width="{w:.1f}" height="{max(1.0, y(q1) - y(q3)):.1f}" '
            f'fill="#ffffff" stroke="{c}"/>',
            f'<line x1="{x - w / 2:.1f}" y1="{y(middle):.1f}" x2="{x + w / 2:.1f}" y2="{y(middle):.1f}" stroke="{c}" stroke-width="2"/>',
        ]
        for sideways, value in zip(side_by_side(box.values, 2 * DOT / scale, 0.55 * w, 2 * DOT + 0.4), box.values, strict=True):
            parts.append(f'<circle cx="{x + sideways:.1f}" cy="{y(value):.1f}" r="{DOT}" fill="{c}" stroke="#ffffff" stroke-width="0.6"/>')
    parts.append(f'<text x="{x:.1f}" y="{TOP - 2}" text-anchor="middle">{escape(box.above)}</text>')
    return parts


def _quantile(ordered: Sequence[float], q: float) -> float:
    at = q * (len(ordered) - 1)
    i = int(at)
    return ordered[i] if i + 1 == len(ordered) else ordered[i] + (at - i) * (ordered[i + 1] - ordered[i])


# Tables of the analyses as CSV.


def csv_of(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Write a CSV with its header; missing values are empty."""
    sink = io.StringIO()
    out = csv.writer(sink, lineterminator="\n")
    out.writerow(columns)
    out.writerows([safe_cell(cell) for cell in row] for row in rows)
    return sink.getvalue()
