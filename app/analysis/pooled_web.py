"""HTML pages of all participants together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.responses import HTMLResponse, JSONResponse
from pydantic import Field
from sqlalchemy.orm import Session

from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.analysis import metrics, metrics_charts, pooled, primary_words
from app.analysis.evidence import of_all
from app.analysis.facts import METRICS
from app.analysis.figures import csv_of
from app.analysis.metrics import FiveMetrics
from app.analysis.metrics_charts import SHORT, above, box, for_readers, points
from app.analysis.pooled import Pooled, StepTime, TrialTime, trial_time
from app.analysis.primary_schemas import AverageOut, VerdictOut, average_out, verdict_out
from app.platform.database import Db
from app.platform.errors import NotFound
from app.platform.kept import kept
from app.platform.numbers import counted
from app.platform.web.charts import TEXT, Cell, Chart, axis, figure
from app.platform.web.charts import figure as empty
from app.platform.web.csv_files import download
from app.platform.web.schemas import Model, PagingQuery, problems
from app.platform.web.templates import render
from app.study.access import withdrawn_codes
from app.tables.participants import Participant
from app.tables.sessions import Controller
from ml.statistics.pooling import Summary
from ml.statistics.within_visits.contrasts import Unavailable

# API types of all participants together.


class OfParticipantOut(Model):
    """One participant's own result."""

    participant: str
    result: AverageOut


class SummaryOut(Model):
    """Random-effects summary of the participants that have a result; it claims nothing about other people."""

    estimate: float | None
    low: float | None
    high: float | None
    between_sd: float | None
    predicted_low: float | None
    predicted_high: float | None
    participants: int
    smallest_sign_p: float | None = Field(description="The smallest two-sided p that a sign test of so many participants can have.")
    text: str


class PooledMetricOut(Model):
    """One metric of one controller."""

    controller: Controller
    metric: str
    each: list[OfParticipantOut]
    together: SummaryOut


class StepTimeOut(Model):
    """Time of one kind of compute step."""

    job: str
    step: str
    n: int
    median_s: float
    longest_s: float


class TimeTestedOut(Model):
    """Minutes of one controller in one participant."""

    participant: str
    controller: Controller
    sessions: int
    minutes: float


class ParticipantVerdictsOut(Model):
    """The verdicts of one participant."""

    participant: str
    verdicts: list[VerdictOut]


class PooledOut(Model):
    """All participants that the caller may read."""

    verdicts: list[ParticipantVerdictsOut]
    metrics: list[PooledMetricOut]
    trial_time: list[TimeTestedOut]
    computation_time: list[StepTimeOut]


# Results of all participants as API types.

Table = tuple[Sequence[str], Sequence[Sequence[object]]]
"""Columns and rows."""


def pooled_out(found: Pooled, times: Sequence[StepTime]) -> PooledOut:
    """Convert the pooled results to the page's schema."""
    return PooledOut(
        verdicts=[
            ParticipantVerdictsOut(participant=p.participant, verdicts=[verdict_out(v) for v in p.verdicts]) for p in found.participants
        ],
        metrics=[
            PooledMetricOut(
                controller=c.controller,
                metric=m.metric,
                each=[OfParticipantOut(participant=code, result=average_out(a)) for code, a in m.each],
                together=_summary(m.summary),
            )
            for c in found.controllers
            for m in c.metrics
        ],
        trial_time=[
            TimeTestedOut(participant=row.participant, controller=t.controller, sessions=t.sessions, minutes=t.minutes)
            for row in found.trial.rows
            for t in row.tested
        ],
        computation_time=[StepTimeOut(**asdict(t)) for t in times],
    )


def trial_table(found: TrialTime) -> Table:
    """Return columns and rows of the trial time, one row per participant and controller."""
    rows = [(row.participant, t.controller.value, t.sessions, t.minutes) for row in found.rows for t in row.tested]
    return tuple(TimeTestedOut.model_fields), rows


def computation_table(times: Sequence[StepTime]) -> Table:
    """Return columns and rows of the computation time, one row per job and step."""
    columns = tuple(StepTimeOut.model_fields)
    return columns, [tuple(asdict(t)[name] for name in columns) for t in times]


def _summary(found: Summary | Unavailable) -> SummaryOut:
    if isinstance(found, Unavailable):
        empty = dict.fromkeys(("estimate", "low", "high", "between_sd", "predicted_low", "predicted_high", "smallest_sign_p"))
        return SummaryOut.model_validate({**empty, "participants": found.found, "text": primary_words.not_pooled(found)})
    names = ("estimate", "low", "high", "between_sd", "predicted_low", "predicted_high", "participants", "smallest_sign_p")
    return SummaryOut.model_validate({n: getattr(found, n) for n in names} | {"text": primary_words.no_population_claim(found)})


# The results figure of several participants: a box and every session by participant and controller, a chart per metric.

MOST_WIDE = 8
"""Number of boxes whose names fit side by side on a tablet in letters of full size."""


def results(found: Sequence[FiveMetrics], which: str = "") -> list[Chart]:
    """Make a chart per metric that some session has; `which`: the end of their addresses, for some participants of all."""
    shown = [for_readers(one) for one in found]
    return [c for c in (_chart(shown, metric, which) for metric in METRICS) if c.rows]


def _chart(found: Sequence[FiveMetrics], metric: str, which: str) -> Chart:
    data: list[dict[str, Any]] = []
    names: list[str] = []
    notes: list[dict[str, Any]] = []
    rows: list[list[Cell]] = []
    units: list[str] = []
    for one in found:
        m = next(m for m in one.metrics if m.metric == metric)
        tests = {c.controller: c for c in m.comparisons}
        units += [m.unit] if m.n and m.unit not in units else []
        for g in m.groups:
            if not g.n:
                continue
            at, test = len(names), tests.get(g.controller)
            data += [box(at, g), points(at, g, m)]
            names.append(f"{one.participant}<br>{SHORT.get(g.controller, g.label)}<br>n = {g.n}")
            text = above(test, metric)
            place = {"x": at, "y": 1.0, "yref": "paper", "yanchor": "bottom", "showarrow": False}
            notes.append(place | {"text": text, "font": {"size": 11, "color": TEXT}})
            rows.append([one.participant, g.label, g.n, g.median, g.q1, g.q3, test.p_value if test else None])
    unit, places = ", ".join(units), list(range(len(names)))
    layout = {
        "xaxis": {
            "tickvals": places,
            "ticktext": names,
            "range": [-0.6, len(names) - 0.4],
            "tickangle": 0,
            "tickfont": {"size": 10 if len(names) > MOST_WIDE else 12},
            "showgrid": False,
            "zeroline": False,
        },
        "yaxis": axis(unit, rangemode="tozero", zeroline=False),
        "annotations": notes,
        "margin": {"l": 52, "r": 8, "t": 26, "b": 60},
        "showlegend": False,
        "dragmode": False,
    }
    sessions = sum(int(r[2] or 0) for r in rows)
    subtitle = f"{unit} \u00b7 n = {counted(sessions, 'session')}"
    columns = ("Participant", "Controller", "n", "Median", "Quartile 1", "Quartile 3", "p")
    return Chart(
        f"all-{metric}",
        primary_words.TITLES[metric][0],
        subtitle,
        figure(data, **layout),
        columns,
        rows,
        height=280,
        src=f"/analyses/figure?metric={metric}{which}",
    )


# Participants that are summed up.


def find_summed(request: Request, db: Db, caller: CurrentCaller) -> Sequence[Participant]:
    """Return the participants that are summed up; the answer says where they are simulations."""
    participants = pooled.readable(db, caller)
    if participants and all(p.synthetic for p in participants):
        request.state.synthetic = "Every participant here"
    return participants


Summed = Annotated[Sequence[Participant], Depends(find_summed)]


def _svg(comparisons: Sequence[metrics.FiveMetrics], participants: Sequence[Participant]) -> Response:
    return metrics_charts.svg(comparisons, "all", synthetic=any(p.synthetic for p in participants))


# REST routes of all participants together.

api = APIRouter(tags=["analysis"], responses=problems(401, 403, 422))


@api.get(
    "/analyses",
    response_model=PooledOut,
    responses={200: {"content": {"text/csv": {"schema": {"type": "string"}}, "image/svg+xml": {"schema": {"type": "string"}}}}},
)
def read_pooled(
    participants: Summed,
    db: Db,
    caller: CurrentCaller,
    format: Annotated[
        Literal["json", "csv", "svg"], Query(description="csv, svg: the paper's comparisons as a table, its results figure.")
    ] = "json",
    table: Annotated[
        Literal["comparisons", "trial_time", "computation_time"],
        Query(description="Which table the CSV is; the figure is always the results."),
    ] = "comparisons",
) -> PooledOut | Response:
    """Return every participant the caller may read, and all together: verdicts, random-effects summary, trial time, computation time."""
    if format == "csv" and table == "computation_time":
        return download(csv_of(*computation_table(pooled.computation_times(db, participants))), "computation-time.csv")
    if format != "json" and not (format == "csv" and table == "trial_time"):
        comparisons = pooled.paper(db, participants, caller)
        return metrics_charts.table(comparisons, "all") if format == "csv" else _svg(comparisons, participants)
    found = pooled.pooled(db, participants, caller)
    if format == "csv":
        return download(csv_of(*trial_table(found.trial)), "trial-time.csv")
    return pooled_out(found, pooled.computation_times(db, participants))


pages = APIRouter()


@pages.get("/analyses")
def pooled_page(request: Request, participants: Summed, db: Db, caller: CurrentCaller, paging: PagingQuery) -> HTMLResponse:
    """Show what the visits of all participants have shown: together, and each on its page of the list."""
    found = pooled.pooled(db, participants, caller)
    shown = slice(paging.offset, paging.offset + paging.limit)
    page = render(
        request,
        "analysis/pooled.html",
        found=found,
        shown=found.participants[shown],
        codes={o.participant for o in found.participants[shown]},
        charts=_charts(db, participants[shown], caller, f"&limit={paging.limit}&offset={paging.offset}"),
        trial=replace(found.trial, rows=found.trial.rows[shown]),
        paging=paging,
        withdrawn=withdrawn_codes(participants),
        times=pooled.computation_times(db, participants),
        wording=primary_words,
    )
    return HTMLResponse(page)


@pages.get("/analyses/figure")
def figure_page(participants: Summed, db: Db, caller: CurrentCaller, paging: PagingQuery, metric: str = METRICS[0]) -> JSONResponse:
    """Send the results figure's chart of one metric, which its page draws when it comes into view."""
    if metric not in METRICS:
        raise NotFound(f"There is no metric '{metric[:40]}'.", f"The metrics are {', '.join(METRICS)}.")
    shown = participants[paging.offset : paging.offset + paging.limit]
    charts = {c.id: c.figure for c in _charts(db, shown, caller)}
    return JSONResponse(charts.get(f"all-{metric}") or empty([]))


def _charts(db: Session, participants: Sequence[Participant], caller: Caller, which: str = "") -> list[Chart]:
    """Make the charts once for what the visits have shown; `which`: the end of their addresses."""
    held = of_all(db, participants, caller)
    key = ("results figure", which, tuple(one.key for one in held))
    return kept(key, lambda: results(metrics.of_all(db, participants, held), which))


@pages.get("/analyses/results.csv")
def results_table(participants: Summed, db: Db, caller: CurrentCaller) -> Response:
    """Download the paper's comparisons of all participants as a table."""
    return metrics_charts.table(pooled.paper(db, participants, caller), "all")


@pages.get("/analyses/results.svg")
def results_figure(participants: Summed, db: Db, caller: CurrentCaller) -> Response:
    """Download the results figure of all participants."""
    return _svg(pooled.paper(db, participants, caller), participants)


@pages.get("/trial-time")
def trial_time_page(request: Request, participants: Summed, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show minutes of every controller in every participant that the caller may read."""
    trial = trial_time(db, participants, caller)
    return HTMLResponse(render(request, "analysis/trial_time.html", trial=trial, withdrawn=withdrawn_codes(participants)))
