"""HTML page of beta as a biomarker."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse
from pydantic import Field

from app.accounts.deps import CurrentCaller
from app.analysis import biomarker, primary_words
from app.analysis.biomarker import Biomarker, Pairing
from app.platform.database import Db
from app.platform.numbers import counted, number
from app.platform.web.charts import Cell, Chart, Link, apart_where_equal, axis, figure
from app.platform.web.schemas import Model, problems
from app.platform.web.templates import render
from app.study.deps import CurrentParticipant
from ml.outcomes import OUTCOMES
from ml.statistics.association import Association
from ml.statistics.within_visits.contrasts import Unavailable

# API types of beta as a biomarker.


class AssociationOut(Model):
    """A slope and a correlation, or why there is none."""

    slope: float | None
    low: float | None
    high: float | None
    p_value: float | None
    correlation: float | None
    correlation_low: float | None
    correlation_high: float | None
    visits: int
    sessions: int
    text: str


class PairingOut(Model):
    """One measurement against another."""

    x: str
    y: str
    within_visits: AssociationOut
    between_visits: AssociationOut = Field(description="Of the visits' means.")
    session_ids: list[int]


class BiomarkerOut(Model):
    """Beta against amplitude and QoCs; cDBS sessions over the months; everything against the time since the last dose."""

    participant: str
    beta_unit: str
    beta: list[PairingOut]
    progression: list[PairingOut]
    medication: list[PairingOut]


# Associations as API types.

_NUMBERS = ("slope", "low", "high", "p_value", "correlation", "correlation_low", "correlation_high")


def biomarker_out(found: Biomarker) -> BiomarkerOut:
    """Convert the associations to the page's schema."""
    parts = {name: [_pairing(p) for p in getattr(found, name)] for name in ("beta", "progression", "medication")}
    return BiomarkerOut(participant=found.participant, beta_unit=found.beta_unit, **parts)


def _pairing(p: Pairing) -> PairingOut:
    ids = [point[0] for point in p.points]
    return PairingOut(x=p.x, y=p.y, within_visits=_association(p.within), between_visits=_association(p.between), session_ids=ids)


def _association(found: Association | Unavailable) -> AssociationOut:
    if isinstance(found, Unavailable):
        empty = dict.fromkeys(_NUMBERS)
        return AssociationOut.model_validate({**empty, "visits": found.found, "sessions": 0, "text": primary_words.no_association(found)})
    return AssociationOut.model_validate({n: getattr(found, n) for n in (*_NUMBERS, "visits", "sessions")} | {"text": ""})


# One measurement against another, every session a point, coloured by visit.

NAMES = {
    "mean_beta": "Mean beta amplitude", "amplitude": "Mean amplitude", "medication_h": "Time since the last dose", "months": "Months",
    **{o.key: o.label for o in OUTCOMES}, "energy": "Stimulation energy",
}  # fmt: skip
UNITS = {
    "amplitude": "% of cDBS", "medication_h": "h", "months": "since the first visit", **{o.key: o.unit for o in OUTCOMES},
}  # fmt: skip

FACTORS = {"amplitude": 100.0}
"""Factors of quantities that are stored in the unit that is shown; 1 for a quantity without an entry."""

SCALE = ((0.0, "token:cdbs"), (1.0, "token:rl"))
"""Early visits to late ones, in colours that either theme shows on its ground."""

_STEP = 0.022
"""Between dots of equal values, of the width of the axis."""


def unit(name: str, beta_unit: str) -> str:
    """Return the unit of an axis."""
    return beta_unit if name == "mean_beta" else UNITS.get(name, "")


def _some(visits: list[int]) -> list[int]:
    """Choose at most seven visits, the first and the last among them."""
    step = max(1, -(-(len(visits) - 1) // 6))
    return [*visits[:-1:step], visits[-1]] if visits else []


def _round(value: float) -> float:
    """Round to what a screen can show: pages of several hundred sessions stay small."""
    return float(f"{value:.5g}")


def scatter(pair: Pairing, beta_unit: str) -> Chart:
    """Plot all sessions that have both measurements, in the units of the axes."""
    points = [(i, v, x * FACTORS.get(pair.x, 1.0), y * FACTORS.get(pair.y, 1.0)) for i, v, x, y in pair.points]
    visits, across = [p[1] for p in points], [p[2] for p in points]
    width = (max(across) - min(across)) or abs(across[0]) or 1.0 if across else 1.0
    places = apart_where_equal([(p[2], p[3]) for p in points], _STEP * width)
    bar = {"title": {"text": "Visit", "font": {"size": 12}}, "thickness": 10, "tickvals": _some(sorted(set(visits)))}
    data = [
        {
            "type": "scatter", "mode": "markers", "x": [_round(x) for x in places], "y": [_round(p[3]) for p in points],
            "marker": {"size": 8, "color": visits, "colorscale": SCALE, "showscale": len(set(visits)) > 1, "colorbar": bar},
            "customdata": [p[0] for p in points], "meta": "/sessions/",
            # a dot may be apart from its value, so that x is given once more
            "text": [number(p[2]) for p in points],
            "hovertemplate": "Session %{customdata}, visit %{marker.color}<br>%{text}, %{y:.4~g}<extra></extra>",
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


# REST routes of beta as a biomarker.

api = APIRouter(tags=["analysis"], responses=problems(401, 403, 404, 422))


@api.get("/participants/{code}/analyses/beta")
def read_biomarker(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> BiomarkerOut:
    """Return beta against amplitude and each QoC, cDBS sessions over the months, and the course after a dose; within and between visits."""
    return biomarker_out(biomarker.biomarker(db, participant, caller))


pages = APIRouter()


@pages.get("/participants/{code}/analyses/beta")
def biomarker_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show whether beta is a biomarker here, how the months went, and what a dose does."""
    found = biomarker.biomarker(db, participant, caller)
    pairs = [*found.beta, *found.progression, *found.medication]
    page = render(
        request,
        "analysis/beta.html",
        participant=participant,
        found=found,
        charts={(p.x, p.y): scatter(p, found.beta_unit) for p in pairs if p.points},
        names=NAMES,
        unit=lambda name: unit(name, found.beta_unit),
        wording=primary_words,
    )
    return HTMLResponse(page)
