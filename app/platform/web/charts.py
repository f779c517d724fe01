"""Charts of pages: a plain Plotly figure with its unit, its n and the table behind it. static/charts.js draws them, without the cloud.

Colours are tokens (`token:rl`, `token:rl/0.25`); the browser replaces them by the CSS variable `--c-rl` of the theme in use.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

CONTROLLERS = ("cdbs", "rl", "distilled", "no_dbs", "random", "other")
"""Order of controllers in every chart and table; cDBS is what the others are compared with."""

SYMBOLS = {"cdbs": "circle", "rl": "diamond", "distilled": "square", "no_dbs": "x", "random": "triangle-up", "other": "star"}
"""A shape with each colour, so that colour is never the only carrier."""

TEXT, MUTED, GRID, ACCENT, WARN, BAD = "token:text", "token:muted", "token:grid", "token:accent", "token:warn", "token:bad"


@dataclass(frozen=True)
class Link:
    """A cell that leads to a page of the service.

    Attributes:
        text: what it says, a number where it is one. url: a path of the service.
    """

    text: str | int
    url: str


Cell = str | float | int | None


@dataclass(frozen=True)
class Chart:
    """A figure for the `chart` macro.

    Attributes:
        id: HTML id, unique in its page.
        title: a short noun phrase.
        subtitle: units and n, e.g. "uV over 2 s · n = 300 steps".
        figure: `{"data": [...], "layout": {...}}`, JSON only; `figure()` makes one.
        columns, rows: the table behind the chart; a column names its unit.
        height: of the plot, CSS pixels.
        digits: significant digits of the table's numbers.
        zoom: charts of a page that share this name show the same stretch of their horizontal axis; empty for none.
        src: address of the figure, for a large one that does not travel with its page; empty where it does.
    """

    id: str
    title: str
    subtitle: str
    figure: dict[str, Any]
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell | Link]]
    height: int = 320
    digits: int = field(default=4)
    zoom: str = ""
    src: str = ""


def colour(controller: str, alpha: float | None = None) -> str:
    """Return the colour token of a controller."""
    name = controller if controller in CONTROLLERS else "other"
    return f"token:{name}" + (f"/{alpha:g}" if alpha is not None else "")


def marker(controller: str, size: float = 8, **more: Any) -> dict[str, Any]:
    """Make the Plotly marker of a controller: its colour and its shape."""
    name = controller if controller in CONTROLLERS else "other"
    return {"color": colour(name), "symbol": SYMBOLS[name], "size": size, **more}


def figure(data: Sequence[Mapping[str, Any]], **layout: Any) -> dict[str, Any]:
    """Make a Plotly figure in the style of all charts; `layout` members override or add. NaN becomes null: a gap, never a zero."""
    base: dict[str, Any] = {
        "margin": {"l": 56, "r": 16, "t": 12, "b": 44},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": TEXT},
        "hovermode": "closest",
        "hoverlabel": {"bgcolor": "token:surface", "bordercolor": GRID, "font": {"color": TEXT}},
        "showlegend": len(data) > 1,
        "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0},
        "dragmode": "pan",
    }
    full = base | layout
    for name in {"xaxis", "yaxis"} | {k for k in full if k.startswith(("xaxis", "yaxis"))}:
        full[name] = _AXIS | full.get(name, {})
    return {"data": [plain(dict(trace)) for trace in data], "layout": plain(full)}


def axis(title: str, unit: str = "", **more: Any) -> dict[str, Any]:
    """Make an axis with its unit in the title."""
    text = f"{title} ({unit})" if title and unit else title or unit
    return {"title": {"text": text, "font": {"size": 13}}, **more}


def horizontal(
    at: float, name: str, colour_token: str = WARN, dash: str = "dash", yref: str = "y"
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Draw a labelled horizontal line over the whole width: its `shapes` and its `annotations` entry."""
    line = {
        "type": "line",
        "xref": "paper",
        "x0": 0,
        "x1": 1,
        "yref": yref,
        "y0": at,
        "y1": at,
        "line": {"color": colour_token, "width": 1.5, "dash": dash},
    }
    label = {
        "text": name, "xref": "paper", "x": 1, "xanchor": "right", "yref": yref, "y": at, "yanchor": "bottom", "showarrow": False,
        "font": {"color": colour_token, "size": 12},
    }  # fmt: skip
    return line, label


# dots of single sessions: as many sessions are as many dots, also where their values are equal
def side_by_side(values: Sequence[float], close: float, half: float, step: float) -> list[float]:
    """Compute sideways offsets of the dots of one box: those of about one height are spread evenly about its middle.

    Args:
        values: their heights. close: heights that are no further apart would hide each other; in the unit of the values.
        half: the furthest offset. step: between neighbours, where there is room.
    """
    rows: list[list[int]] = []
    for i in sorted(range(len(values)), key=lambda i: (values[i], i)):
        if rows and values[i] - values[rows[-1][0]] <= close:
            rows[-1].append(i)
        else:
            rows.append([i])
    places = [0.0] * len(values)
    for row in rows:
        apart = min(step, 2 * half / max(1, len(row) - 1))
        for k, i in enumerate(row):
            places[i] = apart * (k - (len(row) - 1) / 2)
    return places


def apart_where_equal(points: Sequence[tuple[float, float]], step: float) -> list[float]:
    """Compute horizontal places of points of a plane: equal ones are `step` apart about their own place, all others stay where they are."""
    same: defaultdict[tuple[float, float], list[int]] = defaultdict(list)
    for i, point in enumerate(points):
        same[point].append(i)
    places = [x for x, _ in points]
    for members in same.values():
        for k, i in enumerate(members):
            places[i] += step * (k - (len(members) - 1) / 2)
    return places


def written(text: str) -> str:
    """Write a text with units and contacts as people do. Device formats have `uV2` where a reader expects \u00b5V\u00b2, and `key 0 +2-0`
    or `ONE_THREE_RIGHT` for the channel between two contacts. Two channels may be between the same ones, so that the number stays."""
    text = _CONTACTS.sub("contacts +\\2\u2212\\3 (channel \\1)", text) if "key " in text else text
    text = _PAIR.sub(_pair, text) if "_" in text else text
    return _SQUARED.sub("\u00b5V\u00b2", _MICRO.sub("\u00b5\\1", text)) if "u" in text else text


def plain(value: Any) -> Any:
    """Copy a value for JSON: arrays become lists, numpy numbers Python's, what is not finite null; `_DIGITS` significant digits."""
    # numbers and lists of them first: they are nearly all that a figure holds
    if isinstance(value, float) and not isinstance(value, np.generic):
        return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, str):
        return written(value)
    if isinstance(value, np.ndarray):
        return _floats(value) if value.dtype.kind == "f" and value.ndim else plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, Mapping):
        return {k: plain(v) for k, v in value.items()}
    return value


def _floats(values: np.ndarray[Any, Any]) -> list[Any]:
    """Convert an array of floats as `plain` does: a spectrogram has forty thousand."""
    if values.ndim > 1:
        return [_floats(row) for row in values]
    known = math.isfinite
    return [float(f"{v:.{_DIGITS}g}") if known(v) else None for v in values.tolist()]


_MICRO = re.compile(r"\bu([VAs]2?)\b")
_NUMBERS = {"ZERO": 0, "ONE": 1, "TWO": 2, "THREE": 3}
_PAIR = re.compile(rf"\b({'|'.join(_NUMBERS)})_(?:AND_)?({'|'.join(_NUMBERS)})_(LEFT|RIGHT)\b")


def _pair(found: re.Match[str]) -> str:
    """Name a sensing channel of a Percept report: `ONE_THREE_RIGHT` is between contacts 1 and 3 of the right lead."""
    return f"contacts {_NUMBERS[found[1]]}\u2013{_NUMBERS[found[2]]} {found[3].lower()}"


_CONTACTS = re.compile(r"\bkey (\d+) \+(\w+)-(\w+)\b")
_SQUARED = re.compile("\u00b5V2\\b")

_DIGITS = 7
"""Of a number in a figure: as many as a 32-bit float holds, which is how traces are stored, and half the bytes of all."""

_AXIS: dict[str, Any] = {
    "gridcolor": GRID,
    "linecolor": GRID,
    "zerolinecolor": GRID,
    "automargin": True,
    "tickfont": {"color": MUTED},
    "ticks": "",
}
