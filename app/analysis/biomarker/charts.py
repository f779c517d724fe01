"""One measurement against another, every session a point, coloured by visit."""

from __future__ import annotations

from app.analysis.biomarker.service import Pairing
from app.platform.web.charts import Cell, Chart, Link, apart_where_equal, axis, counted, figure
from app.platform.web.numbers import number
from ml.outcomes import OUTCOMES

NAMES = {
    "mean_beta": "Mean beta amplitude", "amplitude": "Mean amplitude", "medication_h": "Time since the last dose", "months": "Months",
    **{o.key: o.label for o in OUTCOMES}, "energy": "Stimulation energy",
}  # fmt: skip
UNITS = {
    "amplitude": "% of cDBS", "medication_h": "h", "months": "since the first visit", **{o.key: o.unit for o in OUTCOMES},
}  # fmt: skip

FACTORS = {"amplitude": 100.0}
"""Of what is stored in the unit that is shown; 1 where nothing stands here."""

SCALE = ((0.0, "token:cdbs"), (1.0, "token:rl"))
"""Early visits to late ones, in colours that either theme shows on its ground."""

_STEP = 0.022
"""Between dots of equal values, of the width of the axis."""


def unit(name: str, beta_unit: str) -> str:
    """The unit of an axis."""
    return beta_unit if name == "mean_beta" else UNITS.get(name, "")


def _some(visits: list[int]) -> list[int]:
    """At most seven visits, the first and the last among them."""
    step = max(1, -(-(len(visits) - 1) // 6))
    return [*visits[:-1:step], visits[-1]] if visits else []


def scatter(pair: Pairing, beta_unit: str) -> Chart:
    """All sessions that have both, in the units of the axes."""
    points = [(i, v, x * FACTORS.get(pair.x, 1.0), y * FACTORS.get(pair.y, 1.0)) for i, v, x, y in pair.points]
    visits, across = [p[1] for p in points], [p[2] for p in points]
    width = (max(across) - min(across)) or abs(across[0]) or 1.0 if across else 1.0
    places = apart_where_equal([(p[2], p[3]) for p in points], _STEP * width)
    bar = {"title": {"text": "Visit", "font": {"size": 12}}, "thickness": 10, "tickvals": _some(sorted(set(visits)))}
    data = [
        {
            "type": "scatter", "mode": "markers", "x": places, "y": [p[3] for p in points],
            "marker": {"size": 8, "color": visits, "colorscale": SCALE, "showscale": len(set(visits)) > 1, "colorbar": bar},
            "customdata": [p[0] for p in points], "meta": "/sessions/",
            "text": [f"Session {p[0]}, visit {p[1]}<br>{number(p[2])}, {number(p[3])}" for p in points],
            "hovertemplate": "%{text}<extra></extra>",
        }
    ]  # fmt: skip
    layout = {
        "xaxis": axis(NAMES[pair.x], unit(pair.x, beta_unit)), "yaxis": axis(NAMES[pair.y], unit(pair.y, beta_unit)), "showlegend": False,
        "dragmode": False,
    }  # fmt: skip
    rows: list[list[Cell | Link]] = [[Link(f"session {i}", f"/sessions/{i}"), v, x, y] for i, v, x, y in points]
    columns = ("Session", "Visit", f"{NAMES[pair.x]} ({unit(pair.x, beta_unit)})", f"{NAMES[pair.y]} ({unit(pair.y, beta_unit)})")
    subtitle = f"n = {counted(len(points), 'session')}"
    name, title = f"{pair.x}-{pair.y}".replace("_", "-"), f"{NAMES[pair.y]} against {NAMES[pair.x].lower()}"
    return Chart(name, title, subtitle, figure(data, **layout), columns, rows, height=260)
