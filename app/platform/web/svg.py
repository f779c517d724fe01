"""Small figures that need no script: SVG inside the page, in the colours of its theme, printed with it.

Coordinates are those of the `viewBox`; the page scales the whole figure. Every figure carries its words (`title`, `desc`) for readers who
do not see it, and the page puts a table behind it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

from markupsafe import Markup

from app.platform.numbers import stated

LABEL = 12.0
"""Height of a line of text."""


def token(name: str) -> str:
    """Name a colour of the page's theme, e.g. "accent"."""
    return f"var(--c-{name})"


def nice_ticks(low: float, high: float, wanted: int = 5) -> list[float]:
    """Round numbers from `low` to `high`, about `wanted` of them; both ends alone where the range is empty."""
    if not high > low:
        return [low]
    step = 10.0 ** math.floor(math.log10((high - low) / wanted))
    step *= next(m for m in (1, 2, 5, 10) if (high - low) / (m * step) <= wanted)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 12) for k in range(first, math.floor(high / step + 1e-9) + 1)]


@dataclass
class Plane:
    """A rectangle of the figure with its axes: data coordinates go in, SVG comes out.

    Attributes:
        left, top, width, height: of the rectangle, in the figure's units.
        x, y: lowest and highest value of the axes.
        parts: what has been drawn.
    """

    left: float
    top: float
    width: float
    height: float
    x: tuple[float, float]
    y: tuple[float, float]
    parts: list[str] = field(default_factory=list)

    def at_x(self, value: float) -> float:
        """Compute the place of a value of the horizontal axis."""
        return self.left + (value - self.x[0]) / ((self.x[1] - self.x[0]) or 1.0) * self.width

    def at_y(self, value: float) -> float:
        """Compute the place of a value of the vertical axis; beyond the axis at its end."""
        share = (value - self.y[0]) / ((self.y[1] - self.y[0]) or 1.0)
        return self.top + self.height * (1 - min(max(share, 0.0), 1.0))

    def axes(self, x_title: str, y_title: str, x_ticks: int = 5, y_ticks: int = 5) -> None:
        """Draw grid lines, tick numbers and titles."""
        bottom = self.top + self.height
        for value in nice_ticks(*self.y, y_ticks):
            y = self.at_y(value)
            self.parts.append(_line(self.left, y, self.left + self.width, y, token("grid")))
            self.text(self.left - 6, y + 4, stated(value), "end", "muted")
        for value in nice_ticks(*self.x, x_ticks):
            self.text(self.at_x(value), bottom + 16, stated(value), "middle", "muted")
        self.parts.append(_line(self.left, bottom, self.left + self.width, bottom, token("border")))
        self.text(self.left + self.width / 2, bottom + 33, x_title, "middle")
        self.text(self.left - 36 if y_ticks else self.left, self.top - 10, y_title, "start")

    def cell(self, x0: float, x1: float, y0: float, y1: float, colour: str, opacity: float) -> None:
        """Draw a filled rectangle."""
        left, top = self.at_x(x0), self.at_y(y1)
        self.parts.append(
            f'<rect x="{left:.1f}" y="{top:.1f}" width="{self.at_x(x1) - left:.1f}" height="{self.at_y(y0) - top:.1f}" '
            f'fill="{token(colour)}" fill-opacity="{opacity:.2f}" shape-rendering="crispEdges"/>'
        )

    def line(
        self,
        points: Sequence[tuple[float, float | None]],
        colour: str,
        width: float = 2.0,
        dash: str = "",
        step: bool = False,
        words: str = "",
    ) -> None:
        """Draw a line through (x, y); it breaks where y is None. `step` keeps each value until the next x; `words` are shown at a
        pointer."""
        drawn: list[str] = []
        down, last = False, 0.0
        for x, y in points:
            if y is None:
                down = False
                continue
            px, py = self.at_x(x), self.at_y(y)
            if down and step:
                drawn.append(f"L{px:.1f} {last:.1f}")
            drawn.append(f"{'L' if down else 'M'}{px:.1f} {py:.1f}")
            down, last = True, py
        if drawn:
            dashed = f' stroke-dasharray="{dash}"' if dash else ""
            look = f'fill="none" stroke="{token(colour)}" stroke-width="{width:g}" stroke-linejoin="round"{dashed}'
            end = f"><title>{escape(words)}</title></path>" if words else "/>"
            self.parts.append(f'<path d="{"".join(drawn)}" {look}{end}')

    def level(self, value: float, words: str, colour: str, dash: str = "5 4") -> None:
        """Draw a horizontal line over the whole width, with its words above its left end."""
        y = self.at_y(value)
        self.parts.append(_line(self.left, y, self.left + self.width, y, token(colour), dash))
        self.text(self.left + 4, y - 4, words, "start", colour)

    def interval(self, x: float, low: float, high: float, colour: str) -> None:
        """Draw a vertical line from `low` to `high`."""
        self.parts.append(_line(self.at_x(x), self.at_y(low), self.at_x(x), self.at_y(high), token(colour), width=1.5))

    def dot(self, x: float, y: float, colour: str, shape: str = "circle", words: str = "", radius: float = 5) -> None:
        """Draw a mark at a value; see `mark`."""
        self.mark(self.at_x(x), self.at_y(y), colour, shape, words, radius)

    def mark(self, px: float, py: float, colour: str, shape: str = "circle", words: str = "", radius: float = 5) -> None:
        """Draw a mark at a place of the figure; `shape` is circle, square, diamond, up, down or ring. `words` are its tooltip, `radius` is
        of circles and rings."""
        paint = token(colour)
        title = f"<title>{escape(words)}</title>" if words else ""
        if shape == "square":
            self.parts.append(f'<rect x="{px - 4.5:.1f}" y="{py - 4.5:.1f}" width="9" height="9" fill="{paint}">{title}</rect>')
        elif shape == "diamond":
            self.parts.append(f'<path d="M{px:.1f} {py - 6:.1f}l6 6l-6 6l-6 -6z" fill="{paint}">{title}</path>')
        elif shape in ("up", "down"):
            way = 1 if shape == "up" else -1
            self.parts.append(f'<path d="M{px:.1f} {py - 6 * way:.1f}l6 {10 * way}h-12z" fill="{paint}">{title}</path>')
        else:
            fill = token("surface") if shape == "ring" else paint
            self.parts.append(
                f'<circle cx="{px:.1f}" cy="{py:.1f}" r="{radius:g}" fill="{fill}" stroke="{paint}" stroke-width="1.5">{title}</circle>'
            )

    def text(self, x: float, y: float, words: str, anchor: str = "start", colour: str = "text", weight: int = 400) -> None:
        """Write words at a place of the figure, not of the axes."""
        bold = f' font-weight="{weight}"' if weight != 400 else ""
        look = f'text-anchor="{anchor}" fill="{token(colour)}" font-size="{LABEL:g}"{bold}'
        halo = f'paint-order="stroke" stroke="{token("surface")}" stroke-width="3"'  # words stay readable over cells and lines
        self.parts.append(f'<text x="{x:.1f}" y="{y:.1f}" {look} {halo}>{escape(words)}</text>')


def apart(wanted: Sequence[float], gap: float = LABEL + 2, low: float = -math.inf, high: float = math.inf) -> list[float]:
    """Choose places near the wanted ones that keep a gap from each other, in the given order; within [low, high] where they fit."""
    order = sorted(range(len(wanted)), key=lambda i: wanted[i])
    placed = [0.0] * len(wanted)
    last = low - gap
    for i in order:
        last = placed[i] = max(wanted[i], last + gap)
    limit = high
    for i in reversed(order):
        placed[i] = min(placed[i], limit)
        limit = placed[i] - gap
    return placed


def drawing(width: float, height: float, title: str, description: str, planes: Sequence[Plane]) -> Markup:
    """Draw the figure.

    Args:
        width, height: of the `viewBox`. title: a short noun phrase. description: what there is to see. planes: what was drawn.
    """
    body = "".join(part for plane in planes for part in plane.parts)
    # every part escapes the words that it is given
    told = f"{escape(title)}. {escape(description)}"
    return Markup(f'<svg class="drawing" viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{told}">{body}</svg>')  # noqa: S704


def glyph(plane: Plane) -> Markup:
    """Draw a small figure inside a line of text that has its numbers; programs that read a page aloud leave it out."""
    width, height = 2 * plane.left + plane.width, 2 * plane.top + plane.height
    body = "".join(plane.parts)
    # as in `drawing`, every part escapes the words that it is given
    return Markup(f'<svg class="glyph" viewBox="0 0 {width:g} {height:g}" width="{width:g}" aria-hidden="true">{body}</svg>')  # noqa: S704


def _line(x0: float, y0: float, x1: float, y1: float, paint: str, dash: str = "", width: float = 1.0) -> str:
    dashed = f' stroke-dasharray="{dash}"' if dash else ""
    return f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="{paint}" stroke-width="{width:g}"{dashed}/>'
