"""Associations as API types."""

from __future__ import annotations

from app.analysis import wording
from app.analysis.biomarker.schemas import AssociationOut, BiomarkerOut, PairingOut
from app.analysis.biomarker.service import Biomarker, Pairing
from ml.statistics.association import Association
from ml.statistics.within_visits.contrasts import Unavailable

_NUMBERS = ("slope", "low", "high", "p_value", "correlation", "correlation_low", "correlation_high")


def biomarker_out(found: Biomarker) -> BiomarkerOut:
    """Everything of the page."""
    parts = {name: [_pairing(p) for p in getattr(found, name)] for name in ("beta", "progression", "medication")}
    return BiomarkerOut(participant=found.participant, beta_unit=found.beta_unit, **parts)


def _pairing(p: Pairing) -> PairingOut:
    ids = [point[0] for point in p.points]
    return PairingOut(x=p.x, y=p.y, within_visits=_association(p.within), between_visits=_association(p.between), session_ids=ids)


def _association(found: Association | Unavailable) -> AssociationOut:
    if isinstance(found, Unavailable):
        empty = dict.fromkeys(_NUMBERS)
        return AssociationOut.model_validate({**empty, "visits": found.found, "sessions": 0, "text": wording.no_association(found)})
    return AssociationOut.model_validate({n: getattr(found, n) for n in (*_NUMBERS, "visits", "sessions")} | {"text": ""})
