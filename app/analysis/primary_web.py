"""HTML pages of the primary analyses."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse

from app.accounts.deps import CurrentCaller
from app.analysis import primary, primary_words
from app.analysis.facts import HIGHER_IS_BETTER, METRICS
from app.analysis.primary_results import Comparison, Tested
from app.analysis.primary_schemas import PrimaryOut, primary_csv, primary_out, unit_of
from app.platform.database import Db
from app.platform.errors import NotFound
from app.platform.numbers import counted, hover, number
from app.platform.web.charts import MUTED, TEXT, Cell, Chart, axis, figure, horizontal, marker, written
from app.platform.web.schemas import problems
from app.platform.web.templates import Part, make_part, render
from app.study.deps import CurrentParticipant
from app.tables.sessions import LEARNED
from ml.statistics.within_visits.contrasts import Average

# The contrast of every visit, and the average over visits with its interval.


def by_visit(tested: Tested, found: Comparison, unit: str) -> Chart:
    """Plot contrasts by visit as points and their average over visits; `unit` is the one that pages show."""
    rows = [r for r in found.rows if r.contrast is not None]
    factor = primary_words.shown_factor(found.metric)
    name, title = primary_words.tested_name(tested), primary_words.TITLES[found.metric][0]
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


# REST routes of the primary analyses.

api = APIRouter(tags=["analysis"], responses=problems(401, 403, 404, 422))


@api.get(
    "/participants/{code}/analyses/primary",
    response_model=PrimaryOut,
    responses={200: {"content": {"text/csv": {"schema": {"type": "string"}}}}},
)
def read_primary(
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    format: Annotated[Literal["json", "csv"], Query(description="csv: one row per controller or policy and metric.")] = "json",
) -> PrimaryOut | Response:
    """Return each controller and policy against the same visit's cDBS, with the visit as the unit of evidence, and the verdicts on the
    margins.
    """
    found = primary.primary(db, participant, caller)
    standings = make_part(Part.STANDINGS, db, participant, caller)
    if format == "csv":
        return primary_csv(found, standings)
    return primary_out(found, participant.synthetic, primary.policies_judged(db, found.evidence, participant), standings)


pages = APIRouter()


@pages.get("/participants/{code}/analyses")
def primary_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show the results of the visits: verdicts, the primary comparisons, what they exclude."""
    found = primary.primary(db, participant, caller)
    page = render(
        request,
        "analysis/primary.html",
        participant=participant,
        found=found,
        policies=primary.policies_judged(db, found.evidence, participant),
        standings=make_part(Part.TESTED_STANDINGS, db, participant, caller),
        wording=primary_words,
        units=_units(found),
    )
    return HTMLResponse(page)


@pages.get("/participants/{code}/analyses.csv")
def primary_table(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> Response:
    """Download the primary comparisons as a table."""
    return primary_csv(primary.primary(db, participant, caller), make_part(Part.STANDINGS, db, participant, caller))


@pages.get("/participants/{code}/analyses/visits/{key}")
def visits_page(request: Request, key: str, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show one controller or policy visit by visit, with the sessions behind every number and what else could explain it."""
    found = primary.primary(db, participant, caller)
    result = primary.result_of(found, key)
    units = _units(found)
    charts = {c.metric: by_visit(result.tested, c, units[c.metric]) for c in result.comparisons}
    sessions = {s.session_id: s for s in found.sessions}
    page = render(
        request,
        "analysis/visits.html",
        participant=participant,
        result=result,
        charts=charts,
        units=units,
        sessions=sessions,
        wording=primary_words,
    )
    return HTMLResponse(page)


@pages.get("/participants/{code}/analyses/models/{key}")
def models_page(
    request: Request,
    key: str,
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    sessions: Annotated[int, Query(ge=1, le=20)] = 3,
) -> HTMLResponse:
    """Show mixed models of one controller, and what further visits would show; up to a second where the result is not cached."""
    found = primary.primary(db, participant, caller)
    result = primary.result_of(found, key)
    if result.tested.policy_id is not None:
        raise NotFound("Models are of controllers; their policies are inside.", "Choose a controller.")
    page = render(
        request,
        "analysis/models.html",
        participant=participant,
        result=result,
        models=primary.mixed_models(found, result.tested.controller),
        power=primary.next_visits(found, result.tested.controller, sessions),
        per_arm=sessions,
        names=primary.policy_names(db, participant),
        planned=result.tested.controller in LEARNED,
        units=_units(found),
        wording=primary_words,
    )
    return HTMLResponse(page)


def _units(found: primary.Primary) -> dict[str, str]:
    """Return the unit in which a page shows each metric."""
    return {m: written(primary_words.shown_unit(m, unit_of(m, found))) for m in METRICS}
