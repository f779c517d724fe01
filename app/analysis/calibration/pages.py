"""HTML page of the calibration."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, Response

from app.accounts.deps import CurrentCaller
from app.analysis.calibration import charts as calibration_charts
from app.analysis.calibration.export import calibration_csv_of
from app.analysis.calibration.service import calibration
from app.analysis.calibration.wording import in_sentences
from app.evaluation import repository
from app.evaluation.estimates.methods import names
from app.platform.database import Db
from app.platform.errors import Invalid
from app.platform.web.templates import render
from app.study.deps import CurrentParticipant

router = APIRouter()


@router.get("/participants/{code}/calibration")
def calibration_page(
    request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, method: str | None = None
) -> HTMLResponse:
    """Predicted against actual, by one method on top and by every method in the tables."""
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


@router.get("/participants/{code}/calibration.csv")
def calibration_csv(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> Response:
    """The calibration as CSV."""
    return calibration_csv_of(calibration(db, participant, caller))
