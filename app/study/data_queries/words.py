"""Words of the values that a query is about."""

from __future__ import annotations

from app.study.settings.form import LABELS as SETTING_LABELS
from ml.outcomes import OUTCOMES

QUERIED_FIELDS = {
    **{o.field: o.label for o in OUTCOMES},
    "controller": "Controller",
    "started_at": "Start",
    "hemisphere": "Hemisphere",
    "medication_h": "Time since the last dose",
    "stopped_reason": "Early stop",
    "file": "Uploaded file",
    "date": "Date",
    "cdbs_left": "cDBS amplitude, left",
    "cdbs_right": "cDBS amplitude, right",
    "note": "Note",
    "drug": "Drug",
    "mg": "Dose",
    "taken_at": "Time it was taken",
    "kind": "What happened",
    "severity": "Severity",
    "serious": "Whether it is serious",
    "occurred_at": "When it happened",
    "leads": "Leads",
    "symptoms": "Symptoms",
    "hand": "Hand of the grasp test",
    "medication": "Medication of a visit day",
    **SETTING_LABELS,
    "other": "Something else",
}
"""Values that a data query may be about, by the name of their field."""


ASKED_ABOUT = {name: said[:1].lower() + said[1:] if said[:2] not in ("cD", "r_") else said for name, said in QUERIED_FIELDS.items()}
"""The same within a sentence."""
