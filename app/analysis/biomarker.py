"""Is beta a biomarker in this participant, how things went over the months, and after a dose of medication."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.analysis.evidence import evidence
from app.analysis.facts import METRICS, Facts, comparable_beta, with_comparable_beta
from app.platform.kept import kept
from app.study import repository as study
from app.tables.participants import Participant
from app.tables.sessions import Controller
from ml.outcomes import KEYS
from ml.statistics.association import Association, between_visits, within_visits
from ml.statistics.within_visits.contrasts import Unavailable

# Beta against each QoC and against amplitude, within and between visits; progression of cDBS sessions; the course after a dose.

DAYS_A_MONTH = 30.4375


@dataclass(frozen=True)
class Pairing:
    """One measurement against another: within visits, and between their means.

    Attributes:
        x, y: names (`mean_beta`, `amplitude`, `medication_h`, `months` or a metric). points: session, visit, x, y.
    """

    x: str
    y: str
    within: Association | Unavailable
    between: Association | Unavailable
    points: tuple[tuple[int, int, float, float], ...]


@dataclass(frozen=True)
class Biomarker:
    """Everything of the page; `beta_unit` of what is compared, empty without beta."""

    participant: str
    beta_unit: str
    beta: tuple[Pairing, ...]
    progression: tuple[Pairing, ...]
    medication: tuple[Pairing, ...]
    undated_visits: tuple[int, ...]


def biomarker(db: Session, participant: Participant, caller: Caller) -> Biomarker:
    """Compute the associations of one participant over the sessions that count."""
    held = evidence(db, participant, caller)
    visits, _ = study.visits(db, participant.id, 1000, 0)
    days = {v.number: v.date.toordinal() for v in visits if v.date is not None}

    def compute() -> Biomarker:
        kind = comparable_beta(held.sessions, held.beta_unit, held.beta_source)
        sessions = with_comparable_beta(held.sessions, kind)
        cdbs = [s for s in sessions if s.controller is Controller.CDBS]
        first = min(days.values(), default=0)
        months = {v: (d - first) / DAYS_A_MONTH for v, d in days.items()}
        return Biomarker(
            held.participant,
            kind.unit if kind else "",
            tuple(_pair(sessions, "mean_beta", y) for y in ("amplitude", *KEYS)),
            tuple(_pair(cdbs, "months", y, months) for y in METRICS if y != "energy"),
            tuple(_pair(sessions, "medication_h", y) for y in METRICS if y != "energy"),
            tuple(sorted({s.visit for s in sessions} - days.keys())),
        )

    return kept(("biomarker", held.key, tuple(sorted(days.items()))), compute)


def _pair(sessions: Sequence[Facts], x: str, y: str, months: dict[int, float] | None = None) -> Pairing:
    a = np.array([_value(s, x, months) for s in sessions], dtype=np.float64)
    b = np.array([_value(s, y, months) for s in sessions], dtype=np.float64)
    visit = np.array([s.visit for s in sessions], dtype=np.int64)
    points = tuple((s.session_id, s.visit, float(p), float(q)) for s, p, q in zip(sessions, a, b, strict=True) if p == p and q == q)
    return Pairing(x, y, within_visits(a, b, visit), between_visits(a, b, visit), points)


def _value(session: Facts, name: str, months: dict[int, float] | None) -> float:
    if name == "amplitude":
        return float("nan") if session.mean_fraction is None else session.mean_fraction
    if name == "medication_h":
        return float("nan") if session.medication_h is None else session.medication_h
    if name == "months":
        return (months or {}).get(session.visit, float("nan"))
    return session.values.get(name, float("nan"))
