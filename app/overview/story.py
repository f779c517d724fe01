"""A participant's months on one axis: what every session brought, every dated visit, the next one, and when settings changed."""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from app.analysis.evidence import Evidence
from app.analysis.facts import Facts
from app.platform.numbers import counted, hover
from app.platform.web.charts import ACCENT, GRID, MUTED, SYMBOLS, TEXT, WARN, Cell, Chart, Link, colour, figure, marker
from app.study.blinding import CONTROLLER_NAMES
from app.tables.participants import SettingsVersion
from app.tables.visits import Visit
from ml.outcomes import OUTCOMES

_GAP = 0.022
_SHARE = 0.7
"""Of the shortest time between two visits that the sessions of a visit may take on the axis."""
_TICKS = 8
"""Days that find room below the axis, on a tablet too."""
_AIR = 0.03
"""Of what the axis shows, left and right of it."""
_APART = dt.timedelta(minutes=20)
"""Time between sessions of a visit whose times are not stated, so that they are drawn side by side in their order."""


def story_chart(held: Evidence, visits: Sequence[Visit], versions: Sequence[SettingsVersion], today: dt.date) -> Chart | None:
    """Plot every session that counts and that the reader may know of, as a dot in a panel per quantity, and every dated visit. None with
    neither on a known day.

    Args:
        `held`: sessions as the caller may know them. visits: with their dates. versions: of the settings, by number.
        today: the first visit from then on is marked as the next one.
    """
    days = {v.id: v.date for v in visits}
    dated = [(moment, s) for s in held.sessions if (moment := _moment(s, days)) is not None]
    if not dated and not any(v.date is not None for v in visits):
        return None
    panels = [(name, unit, values) for name, unit, values in _quantities(held, [s for _, s in dated]) if any(v is not None for v in values)]
    places = _places(dated)
    data, layout = _panels(dated, places, panels)
    for controller in dict.fromkeys(s.controller for _, s in dated):
        shown = marker(controller.value, 8)
        data.append({"type": "scatter", "mode": "markers", "name": CONTROLLER_NAMES[controller], "x": [None], "y": [None], "marker": shown})
    stands = _visits(dated, places, visits, today)
    layout["shapes"], layout["annotations"] = _marks(stands, versions)
    layout["xaxis"] |= _days(stands) | {"range": _range(places, stands, versions)}
    columns = ("Start", "Visit", "Session", "Controller", *(f"{name} ({unit})" for name, unit, _ in panels))
    rows: list[list[Cell | Link]] = [
        [f"{moment:%Y-%m-%d %H:%M}", s.visit, Link(s.session_id, f"/sessions/{s.session_id}"), CONTROLLER_NAMES[s.controller],
         *(values[i] for _, _, values in panels)]
        for i, (moment, s) in enumerate(dated)
    ]  # fmt: skip
    nothing: list[Cell | Link] = [None] * (2 + len(panels))
    rows += [
        [f"{v.day}{' (next visit)' if v.is_next else ''}", Link(v.number, f"/visits/{v.visit_id}"), *nothing] for v in stands if v.empty
    ]
    visits_seen = len({s.visit_id for _, s in dated})
    n = f"{counted(len(dated), 'session')} in {counted(visits_seen, 'visit')}"
    subtitle = f"n = {n}, those of a day side by side \u00b7 press a dot for its session, or take it from the table"
    if not dated:
        subtitle = f"n = 0 sessions \u00b7 {counted(len(stands), 'visit')} with a date"
    return Chart("story", "All months", subtitle, figure(data, **layout), columns, rows, height=82 + 82 * max(1, len(panels)))


def _moment(session: Facts, days: Mapping[int, dt.date | None]) -> dt.datetime | None:
    """Return when a session began; its place within the visit's day where no time is stated."""
    if session.started_at is not None:
        return session.started_at
    day = days.get(session.visit_id)
    return dt.datetime.combine(day, dt.time(9), dt.UTC) + session.ordinal * _APART if day is not None else None


def _places(dated: Sequence[tuple[dt.datetime, Facts]]) -> list[dt.datetime]:
    """Place sessions on the axis: those of a visit side by side in their order about the visit's day, for months hide hours."""
    by_visit: dict[int, list[int]] = {}
    for i, (_, s) in sorted(enumerate(dated), key=lambda row: (row[1][0], row[1][1].ordinal)):
        by_visit.setdefault(s.visit_id, []).append(i)
    days = {visit: min(dated[i][0] for i in members) for visit, members in by_visit.items()}
    ordered = sorted(days.values())
    least = min((b - a for a, b in pairwise(ordered) if b > a), default=dt.timedelta(days=1))
    step = _SHARE * least / max((len(members) for members in by_visit.values()), default=1)
    found = [moment for moment, _ in dated]
    for visit, members in by_visit.items():
        for k, i in enumerate(members):
            found[i] = days[visit] + (k - (len(members) - 1) / 2) * step
    return found


def _quantities(held: Evidence, sessions: Sequence[Facts]) -> list[tuple[str, str, list[float | None]]]:
    def of(metric: str) -> list[float | None]:
        return [s.values.get(metric) for s in sessions]

    own = [next((side.milliamperes for side in s.sides if side.is_control), None) for s in sessions]
    beta = [s.values.get("mean_beta") if s.beta_kind and s.beta_kind.unit == held.beta_unit else None for s in sessions]
    return [
        ("Beta", held.beta_unit or "", beta),
        ("Amplitude", "mA", own),
        ("Energy", "% of cDBS", [None if v is None else 100 * v for v in of("energy")]),
        *((o.short, o.unit, of(o.key)) for o in OUTCOMES),
        ("Last dose", "h before", [s.medication_h for s in sessions]),
    ]


def _panels(
    dated: Sequence[tuple[dt.datetime, Facts]], places: Sequence[dt.datetime], panels: Sequence[tuple[str, str, list[float | None]]]
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Build a trace and an axis per quantity, the first one on top; one empty axis without any quantity."""
    x, began = [place.isoformat() for place in places], [f"{moment:%Y-%m-%d %H:%M}" for moment, _ in dated]
    colours, shapes = [colour(s.controller.value) for _, s in dated], [SYMBOLS[s.controller.value] for _, s in dated]
    pages = [f"/sessions/{s.session_id}" for _, s in dated]
    height = 1 / max(1, len(panels))
    data: list[dict[str, Any]] = []
    layout: dict[str, Any] = {
        "xaxis": {"type": "date", "anchor": "free", "position": 0, "zeroline": False, "showgrid": False},
        "margin": {"l": 78, "r": 16, "t": 30, "b": 48},
        "legend": {"orientation": "h", "y": 1.01, "yanchor": "bottom", "x": 0},
        "showlegend": True,
    }
    if not panels:  # days alone: an empty panel without a scale
        layout["yaxis"] = {"visible": False, "range": [0, 1]}
    for i, (name, unit, values) in enumerate(panels):
        suffix = "" if i == 0 else str(i + 1)
        top = 1 - i * height
        layout[f"yaxis{suffix}"] = {
            "domain": [max(0.0, top - height + _GAP), top],
            "zeroline": False,
            "nticks": 4,
            "title": _title(name, unit),
        }
        data.append(
            {
                "type": "scatter", "mode": "markers", "x": x, "y": values, "yaxis": f"y{suffix}", "showlegend": False, "name": name,
                "marker": {"size": 7, "color": colours, "symbol": shapes, "opacity": 0.85}, "customdata": pages, "text": began,
                "hovertemplate": f"%{{text}}<br>{name} {hover()} {unit}<extra></extra>",
            }
        )  # fmt: skip
    return data, layout


@dataclass(frozen=True)
class _Stand:
    """A dated visit on the axis.

    Attributes:
        at: in the middle of its sessions, or on its day. line: left of its first session. day: of its first session, or its own.
        empty: whether no session of it is shown. is_next: whether it is the first one from today on.
    """

    at: dt.datetime
    line: dt.datetime
    day: dt.date
    visit_id: int
    number: int
    empty: bool
    is_next: bool


def _visits(
    dated: Sequence[tuple[dt.datetime, Facts]], places: Sequence[dt.datetime], visits: Sequence[Visit], today: dt.date
) -> list[_Stand]:
    """List every visit that has a day, from its own row or from its sessions, in the order of the axis."""
    spans: dict[int, list[tuple[dt.datetime, dt.datetime]]] = {}
    for (moment, s), place in zip(dated, places, strict=True):
        spans.setdefault(s.visit_id, []).append((place, moment))
    coming = min((v for v in visits if v.date is not None and v.date >= today), key=lambda v: (v.date, v.number), default=None)
    found = []
    for visit in visits:
        held = spans.get(visit.id)
        if held:
            first, last = min(held)[0], max(held)[0]
            at, line, day = first + (last - first) / 2, first, min(m for _, m in held).date()
        elif visit.date is not None:
            at = line = dt.datetime.combine(visit.date, dt.time(12), dt.UTC)
            day = visit.date
        else:
            continue
        found.append(_Stand(at, line, day, visit.id, visit.number, not held, visit is coming))
    return sorted(found, key=lambda v: (v.at, v.number))


def _range(places: Sequence[dt.datetime], stands: Sequence[_Stand], versions: Sequence[SettingsVersion]) -> list[str]:
    """Return the range of the axis: every dot and every line, which the library would not look at, with some air."""
    moments = [*places, *(v.at for v in stands), *(v.created_at for v in versions if v.version > 1)]
    air = max((max(moments) - min(moments)) * _AIR, dt.timedelta(hours=1))
    return [(min(moments) - air).isoformat(), (max(moments) + air).isoformat()]


def _days(stands: Sequence[_Stand]) -> dict[str, Any]:
    """Place ticks at visits, with their days: a calendar's ticks would give another day to sessions drawn next to their visit's day."""
    step = -(-len(stands) // _TICKS)
    # counted from the last, so that the newest has its day, and the next one whatever its place
    shown = [v for i, v in enumerate(reversed(stands)) if i % step == 0][::-1]
    words = [f"visit {v.number}<br>{v.day:%Y-%m-%d}" for v in shown]
    return {"tickvals": [v.at.isoformat() for v in shown], "ticktext": words}


def _title(name: str, unit: str) -> dict[str, Any]:
    return {"text": f"{name}<br>{unit}", "font": {"size": 12}, "standoff": 10}


def _marks(stands: Sequence[_Stand], versions: Sequence[SettingsVersion]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Draw a line per visit, the next one's in colour with its words, and a dashed one with its words where settings were changed."""
    lines, labels = [], []
    for text, at, ink, dash, width in (
        *((f"next visit: {v.number}" if v.is_next else "", v.line, ACCENT if v.is_next else GRID, "solid", 1 + v.is_next) for v in stands),
        *((f"settings {v.version}", v.created_at, WARN, "dash", 1) for v in versions if v.version > 1),
    ):
        where = {"xref": "x", "yref": "paper"}
        line = {"color": ink, "width": width, "dash": dash}
        lines.append(
            {"type": "line", **where, "x0": at.isoformat(), "x1": at.isoformat(), "y0": 0, "y1": 1, "line": line, "layer": "below"}
        )
        if not text:
            continue
        labels.append(
            {"text": text, **where, "x": at.isoformat(), "y": 0, "yanchor": "bottom", "xanchor": "right" if ink == ACCENT else "left",
             "showarrow": False, "textangle": -90, "font": {"size": 11, "color": TEXT if ink == ACCENT else MUTED}}
        )  # fmt: skip
    return lines, labels
