"""HTML page of the calibration."""

from __future__ import annotations

import csv
import io
from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse

from app.accounts.deps import CurrentCaller
from app.analysis import calibration as calibration_rules
from app.analysis import calibration_charts
from app.analysis.calibration import calibration, in_sentences
from app.analysis.calibration_accuracy import CalibrationOut
from app.evaluation import repository
from app.evaluation.methods import names
from app.evaluation.ranking.assessment import QUANTITIES
from app.platform.database import Db
from app.platform.errors import Invalid
from app.platform.web.csv_files import download, safe_cell
from app.platform.web.schemas import problems
from app.platform.web.templates import render
from app.study.deps import CurrentParticipant

# The calibration as a table for other programs.

_OF_POLICY_AT_VISIT = (
    "visit", "visit_date", "evaluation_id", "evaluated_at", "policy_id", "name", "kind", "reference", "horizon_steps", "gamma"
)  # fmt: skip


_OF_PREDICTION = ("method", "supported", "parts", "predicted", "low", "high", "level", "actual", "actual_low", "actual_high", "sessions")


def calibration_to_csv(found: CalibrationOut) -> str:
    """Write one row per visit, policy and method: the prediction, and the result of the sessions."""
    sink = io.StringIO()
    out = csv.writer(sink, lineterminator="\n")
    shown = [f"{name}_{part}" for name in QUANTITIES for part in ("predicted", "actual")]
    out.writerow(["participant", *_OF_POLICY_AT_VISIT, *_OF_PREDICTION, "session_returns", "beta_unit", *shown])
    for p in found.policies:
        whole = [found.participant, *(getattr(p, n) for n in _OF_POLICY_AT_VISIT)]
        for q in p.predictions:
            returns = " ".join(f"{value:.6g}" for value in q.session_returns)
            known = {v.name: (v.predicted, v.actual) for v in q.quantities}
            values = [value for name in QUANTITIES for value in known.get(name, (None, None))]
            cells = (*whole, *(getattr(q, n) for n in _OF_PREDICTION), returns, found.beta_unit, *values)
            out.writerow([safe_cell(cell) for cell in cells])
    return sink.getvalue()


def calibration_csv_of(found: CalibrationOut) -> Response:
    """Serve a calibration as a CSV download."""
    return download(calibration_to_csv(found), f"{found.participant}-calibration.csv")


# REST routes of the calibration.

api = APIRouter(responses=problems(401, 403, 404, 422))


@api.get(
    "/participants/{code}/calibration",
    tags=["evaluation"],
    response_model=CalibrationOut,
    responses={200: {"content": {"text/csv": {"schema": {"type": "string"}}}}},
)
def read_calibration(
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    format: Annotated[Literal["json", "csv"], Query(description="csv: one row per visit, policy and method.")] = "json",
) -> CalibrationOut | Response:
    """Return estimates made before each visit against the results of the visit, and the metrics of every method."""
    found = calibration_rules.calibration(db, participant, caller)
    return calibration_csv_of(found) if format == "csv" else found


pages = APIRouter()


@pages.get("/participants/{code}/calibration")
def calibration_page(
    request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, method: str | None = None
) -> HTMLResponse:
    """Show predicted against actual results, by one method on top and by every method in the tables."""
    found = calibration(db, participant, caller)
    if method and method not in found.methods:
        known = f"Choose one of {', '.join(found.methods)}." if found.methods else "Nothing can be compared yet."
        raise Invalid(f"The calibration has no estimates by '{method}'.", known)
    newest = repository.newest_evaluation(db, participant.id)
    usual = newest.default_method if newest is not None else None
    chosen = method or (usual if usual in found.methods else next(iter(found.methods), None))
    page = render(
        request,
        "analysis/calibration.html",
        participant=participant,
        calibration=found,
        method=chosen,
        asked=method is not None,
        method_names=names(),
        sentences=in_sentences(found, chosen) if chosen else [],
        over_visits=calibration_charts.over_visits(found, chosen) if chosen else None,
        returns=calibration_charts.returns(found, chosen) if chosen else None,
        metrics=calibration_charts.metrics(found) if found.metrics else None,
        outcomes=calibration_charts.quantities(found, chosen) if chosen else [],
        quantity_names=calibration_charts.QUANTITY_NAMES,
    )
    return HTMLResponse(page)


@pages.get("/participants/{code}/calibration.csv")
def calibration_csv(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> Response:
    """Download the calibration as CSV."""
    return calibration_csv_of(calibration(db, participant, caller))
