"""One measurement against another, every session a point, coloured by visit."""

from __future__ import annotations

from app.analysis.biomarker.service import Pairing
from app.platform.web.charts import Cell, Chart, axis, figure

NAMES = {
    "mean_beta": "Mean beta amplitude", "amplitude": "Mean amplitude", "medication_h": "Time since the last dose", "months": "Months",
    "grasp": "Grasp frequency", "rating": "Rating", "tremor": "Tremor", "energy": "Stimulation energy",
}  # fmt: skip
UNITS = {
    "amplitude": "cDBS = 1", "medication_h": "h", "months": "since the first visit", "grasp": "Hz", "rating": "1\u201310",
    "tremor": "% of session",
}  # fmt: skip

SCALE = ((0.0, "token:cdbs"), (1.0, "token:rl"))
"""Early visits to late ones, in colours that either theme shows on its ground."""


def unit(name: str, beta_unit: str) -> str:
    """The unit of an axis."""
    return beta_unit if name == "mean_beta" else UNITS.get(name, "")


def _some(visits: list[int]) -> list[int]:
    """At most seven visits, the first and the last among them."""
    step = max(1, -(-(len(visits) - 1) // 6))
    return [*visits[:-1:step], visits[-1]] if visits else []


def scatter(pair: Pairing, beta_unit: str) -> Chart:
    """All sessions that have both."""
    visits = [p[1] for p in pair.points]
    bar = {"title": {"text": "Visit"}, "thickness": 10, "tickvals": _some(sorted(set(visits)))}
    data = [
        {
            "type": "scatter", "mode": "markers", "x": [p[2] for p in pair.points], "y": [p[3] for p in pair.points],
            "marker": {"size": 8, "color": visits, "colorscale": SCALE, "showscale": len(set(visits)) > 1, "colorbar": bar},
            "customdata": [p[0] for p in pair.points], "meta": "/sessions/",
            "text": [f"Session {p[0]}, visit {p[1]}" for p in pair.points], "hovertemplate": "%{text}<br>%{x:.3g}, %{y:.3g}<extra></extra>",
        }
    ]  # fmt: skip
    layout = {
        "xaxis": axis(NAMES[pair.x], unit(pair.x, beta_unit)), "yaxis": axis(NAMES[pair.y], unit(pair.y, beta_unit)), "showlegend": False,
        "dragmode": False,
    }  # fmt: skip
    rows: list[list[Cell]] = [[f"session {i}", v, x, y] for i, v, x, y in pair.points]
    columns = ("Session", "Visit", f"{NAMES[pair.x]} ({unit(pair.x, beta_unit)})", f"{NAMES[pair.y]} ({unit(pair.y, beta_unit)})")
    subtitle = f"n = {len(pair.points)} sessions"
    name, title = f"{pair.x}-{pair.y}".replace("_", "-"), f"{NAMES[pair.y]} against {NAMES[pair.x].lower()}"
    return Chart(name, title, subtitle, figure(data, **layout), columns, rows, height=260)
