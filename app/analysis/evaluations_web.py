"""HTML page of methods by seed."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse
from pydantic import Field

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.analysis import evaluations
from app.analysis.evaluations import LEAST_POLICIES, WANTED_SEEDS, BySeed, SeedRow
from app.analysis.figures import SYNTHETIC, Box, Panel, boxes_svg, csv_of
from app.platform.database import Db
from app.platform.numbers import counted, hover
from app.platform.web.charts import TEXT, Cell, Chart, axis, figure, side_by_side
from app.platform.web.csv_files import download
from app.platform.web.schemas import Model, problems
from app.platform.web.templates import render
from app.study.access import may
from app.study.deps import CurrentParticipant

# API types of methods by seed.


class SeedRowOut(Model):
    """One method of evaluation under one seed."""

    method: str
    name: str
    seed: int
    evaluation_id: int
    policies: int
    mae: float = Field(description="Mean absolute error, reward.")
    mae_of_range: float | None
    rank_correlation: float | None = Field(description="Spearman's.")
    regret_of_range: float | None = Field(description="Regret@1 over the range of the returns.")


class BySeedOut(Model):
    """Methods by seed on one snapshot, against the returns of the sessions recorded after it."""

    participant: str
    snapshot_id: int | None
    seeds: list[int]
    policies: int = Field(description="Policies estimated under every seed that ran afterwards.")
    rows: list[SeedRowOut]
    text: str = Field(description="What is missing; empty where nothing is.")


# Methods by seed as API types.

CSV_COLUMNS = (
    "participant", "snapshot_id", "method", "name", "seed", "evaluation_id", "policies", "mae", "mae_of_range", "rank_correlation",
    "regret_of_range",
)  # fmt: skip


def by_seed_out(found: BySeed) -> BySeedOut:
    """Convert the comparison by seed to the page's schema."""
    return BySeedOut(
        participant=found.participant,
        snapshot_id=found.snapshot_id,
        seeds=list(found.seeds),
        policies=found.policies,
        rows=[SeedRowOut(**asdict(r)) for r in found.rows],
        text=missing(found),
    )


def missing(found: BySeed) -> str:
    """Say in words what the figure lacks."""
    if found.snapshot_id is None:
        return "No evaluation has been made yet."
    if found.policies < LEAST_POLICIES:
        return (
            f"{found.policies} of the policies estimated under every seed on snapshot {found.snapshot_id} ran after it with a known "
            f"return; it takes {LEAST_POLICIES}. Sessions inside the snapshot were there to be fitted and prove nothing."
        )
    if len(found.seeds) < WANTED_SEEDS:
        return f"Snapshot {found.snapshot_id} was evaluated under {len(found.seeds)} of {WANTED_SEEDS} seeds."
    return ""


def csv_rows(found: BySeed) -> list[tuple[object, ...]]:
    """List one row per method and seed."""
    return [(found.participant, found.snapshot_id, *asdict(r).values()) for r in found.rows]


# Methods by seed: a panel per metric, a point per seed, a bar at their mean. As a chart and as an SVG.

METRICS = {
    "mae": ("Mean absolute error", "reward, lower is better"),
    "rank_correlation": ("Rank correlation", "Spearman, higher is better"),
    "regret_of_range": ("Regret@1", "share of the range, lower is better"),
}


def charts(found: BySeed) -> list[Chart]:
    """Plot one chart per metric that some method has."""
    return [c for c in (_chart(found, name) for name in METRICS) if c.rows]


def panels(found: BySeed) -> list[Panel]:
    """Build the panels of the SVG, one per metric."""
    made = []
    for name, (title, unit) in METRICS.items():
        by_method = _by_method(found, name)
        boxes = []
        for rows in by_method.values():
            boxes.append(Box(rows[0].name, "#0b6e99", tuple(v for _, v in _values(rows, name)), f"n = {len(rows)}"))
        made.append(Panel(title, unit, tuple(boxes)))
    return made


def _by_method(found: BySeed, metric: str) -> dict[str, list[SeedRow]]:
    grouped: dict[str, list[SeedRow]] = {}
    for row in found.rows:
        if getattr(row, metric) is not None:
            grouped.setdefault(row.method, []).append(row)
    return grouped


def _values(rows: list[SeedRow], metric: str) -> list[tuple[int, float]]:
    return [(r.seed, float(getattr(r, metric))) for r in rows]


def _chart(found: BySeed, metric: str) -> Chart:
    title, unit = METRICS[metric]
    grouped = _by_method(found, metric)
    names = [rows[0].name for rows in grouped.values()]
    means = [sum(v for _, v in _values(rows, metric)) / len(rows) for rows in grouped.values()]
    points = [p for rows in grouped.values() for p in _values(rows, metric)]
    height = max((abs(v) for _, v in points), default=0.0)
    x = [i + s for i, own in enumerate(grouped.values()) for s in side_by_side([v for _, v in _values(own, metric)], height / 24, 0.3, 0.1)]
    data = [
        {"type": "bar", "x": list(range(len(names))), "y": means, "marker": {"color": "token:accent/0.3"}, "name": "mean"},
        {
            "type": "scatter", "mode": "markers", "x": x, "y": [v for _, v in points], "marker": {"size": 9, "color": TEXT}, "name": "seed",
            "text": [f"seed {s}" for s, _ in points], "hovertemplate": f"%{{text}}: {hover()}<extra></extra>",
        },
    ]  # fmt: skip
    layout = {
        "xaxis": {"tickvals": list(range(len(names))), "ticktext": names, "showgrid": False, "zeroline": False},
        "yaxis": axis(unit),
        "dragmode": False,
    }
    rows: list[list[Cell]] = [[r.name, r.seed, r.policies, getattr(r, metric)] for own in grouped.values() for r in own]
    subtitle = f"{unit} \u00b7 {counted(len(found.seeds), 'seed')} · {counted(found.policies, 'policy', 'policies')}"
    return Chart(
        f"seed-{metric.replace('_', '-')}", title, subtitle, figure(data, **layout), ("Method", "Seed", "Policies", title), rows, height=280
    )


# Methods by seed as a table and as a figure.


def table_of(found: BySeed) -> Response:
    """Serve a table with one row per method and seed."""
    return download(csv_of(CSV_COLUMNS, csv_rows(found)), f"{found.participant}-methods-by-seed.csv")


def figure_of(found: BySeed, *, synthetic: bool) -> Response:
    """Serve the figure: a panel per metric, a point per seed."""
    note = f"Snapshot {found.snapshot_id}, seeds {', '.join(map(str, found.seeds))}; against sessions recorded after the snapshot."
    note = f"{SYNTHETIC} {note}" if synthetic else note
    shown = panels(found) if found.rows else []
    content = boxes_svg(shown, f"Methods of evaluation, {found.participant}", note if shown else missing(found))
    return Response(content, media_type="image/svg+xml")


# REST routes of methods by seed.

api = APIRouter(tags=["analysis"], responses=problems(401, 403, 404, 422))


@api.get(
    "/participants/{code}/analyses/evaluations",
    response_model=BySeedOut,
    responses={200: {"content": {"text/csv": {"schema": {"type": "string"}}, "image/svg+xml": {"schema": {"type": "string"}}}}},
)
def read_by_seed(
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    format: Annotated[Literal["json", "csv", "svg"], Query()] = "json",
) -> BySeedOut | Response:
    """Return every method of evaluation over seeds on one snapshot, against the returns of the sessions recorded after it."""
    found = evaluations.by_seed(db, participant, caller)
    if format != "json":
        return table_of(found) if format == "csv" else figure_of(found, synthetic=participant.synthetic)
    return by_seed_out(found)


pages = APIRouter()


@pages.get("/participants/{code}/analyses/evaluations")
def by_seed_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show how well each method did on one snapshot, by seed."""
    found = evaluations.by_seed(db, participant, caller)
    page = render(
        request,
        "analysis/evaluations.html",
        participant=participant,
        found=found,
        charts=charts(found),
        missing=missing(found),
        wanted=evaluations.WANTED_SEEDS,
        may_run=may(caller, can.RUN_JOBS, participant),
    )
    return HTMLResponse(page)


@pages.get("/participants/{code}/analyses/evaluations.csv")
def by_seed_table(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> Response:
    """Download methods by seed as a table."""
    return table_of(evaluations.by_seed(db, participant, caller))


@pages.get("/participants/{code}/analyses/evaluations.svg")
def by_seed_figure(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> Response:
    """Download methods by seed as a figure."""
    return figure_of(evaluations.by_seed(db, participant, caller), synthetic=participant.synthetic)
