"""Words of doses."""

from __future__ import annotations

from collections.abc import Iterable

from app.study.doses.drugs import DRUGS
from app.tables.visits import Dose, Drug

DRUG_NAMES = {drug.value: facts.name for drug, facts in DRUGS.items()}


def doses_words(doses: Iterable[Dose]) -> str:
    """Doses that were taken, by time."""
    return "; ".join(f"{d.taken_at:%Y-%m-%d %H:%M} {DRUGS[Drug(d.drug)].name} {d.mg:g} mg" for d in doses)
