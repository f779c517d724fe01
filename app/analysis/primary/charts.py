"""The contrast of every visit, and the average over visits with its interval."""

from __future__ import annotations

from app.analysis import wording
from app.analysis.evidence.measurements import HIGHER_IS_BETTER
from app.analysis.primary.results import Comparison, Tested
from app.platform.web.charts import MUTED, TEXT, Cell, Chart, axis, counted, figure, horizontal, marker
from app.platform.web.numbers import hover, number
from ml.statistics.within_visits.contrasts import Average


def by_visit(tested: Tested, found: Comparison, unit: str) -> Chart:
    """Contrasts by visit as points, the average over visits beside them; `unit` is the one that pages show."""
    rows = [r for r in found.rows if r.contrast is not None]
    factor = wording.shown_factor(found.metric)
    name, title = wording.tested_name(tested), wording.TITLES[found.metric][0]
    places: list[float] = [float(i) for i in range(len(rows))]
    data = [
        {
            "type": "scatter", "mode": "markers", "x": places, "y": [factor * (r.contrast or 0.0) for r in rows],
            "marker": marker(tested.controller, 10),
            "text": [f"Visit {r.visit}: {len(r.tested)} against {counted(len(r.cdbs), 'session')}" for r in rows],
            "hovertemplate": f"%{{text}}<br>{hover()} {unit}<extra></extra>", "name": name,
        }
    ]  # fmt: skip
    ticks = [str(r.visit) for r in rows]
    if isinstance(found.result, Average):
        a = found.result
        estimate, low, high = (factor * v for v in (a.estimate, a.low, a.high))
        data.append(
            {
                "type": "scatter", "mode": "markers", "x": [len(rows) + 0.3], "y": [estimate], "name": "Average",
                "error_y": {
                    "type": "data", "symmetric": False, "array": [high - estimate], "arrayminus": [estimate - low], "width": 8,
                },
                "marker": {"symbol": "line-ew-open", "size": 18, "color": TEXT, "line": {"width": 3}}, "line": {"color": TEXT},
                "hovertemplate": f"Average {number(estimate)} ({number(low)} to {number(high)}) {unit}<extra></extra>",
            }
        )  # fmt: skip
        places, ticks = [*places, len(rows) + 0.3], [*ticks, "Average"]
    better = "higher is better" if HIGHER_IS_BETTER[found.metric] else "lower is better"
    layout = {
        "xaxis": axis("Visit", tickvals=places, ticktext=ticks, showgrid=False, zeroline=False, range=[-0.6, len(rows) + 0.9]),
        "yaxis": axis(f"{name} less cDBS", unit),
        "shapes": [horizontal(0.0, "", MUTED)[0]],
        "showlegend": False, "dragmode": False,
    }  # fmt: skip
    table: list[list[Cell]] = [[r.visit, factor * (r.contrast or 0.0), len(r.tested), len(r.cdbs)] for r in rows]
    sub = f"{unit} \u00b7 n = {counted(len(rows), 'visit')} \u00b7 {better}"
    columns = ("Visit", f"Contrast ({unit})", "Sessions", "cDBS sessions")
    return Chart(f"contrast-{tested.key}-{found.metric}", title, sub, figure(data, **layout), columns, table, height=260)
