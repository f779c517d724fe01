"""The drugs that can be named: a fixed list, so that no free text of a prescription enters.

Levodopa equivalents per mg: Tomlinson et al. 2010 (Movement Disorders 25, 2649), where they give one. What Jost et al. 2023 (Movement
Disorders 38, 1236) propose for drugs that came later, safinamide among them, is not taken up: such a drug has no equivalent here. A form
that these names leave out (prolonged-release agonists, whose effect hardly wanes within a visit; selegiline under the tongue, which counts
eight times as much; tolcapone; levodopa gel) is `other`: no equivalent, and no time since it, rather than those of another form.
"""

from __future__ import annotations

from dataclasses import dataclass

from app.tables.visits import Drug


@dataclass(frozen=True)
class DrugFacts:
    """What is known of a drug.

    Attributes:
        name: as pages show it.
        equivalent: mg of levodopa that 1 mg counts as; None where none is stated.
        within_hours: its effect on symptoms rises and wanes within hours of a dose, so that the time since that dose says something.
    """

    name: str
    equivalent: float | None
    within_hours: bool


DRUGS: dict[Drug, DrugFacts] = {
    Drug.LEVODOPA: DrugFacts("Levodopa (carbidopa, benserazide)", 1.0, True),
    Drug.LEVODOPA_CR: DrugFacts("Levodopa, controlled release", 0.75, True),
    Drug.LEVODOPA_COMT: DrugFacts("Levodopa with entacapone", 1.33, True),
    Drug.LEVODOPA_EQUIVALENT: DrugFacts("All of a time together, as levodopa equivalent", 1.0, True),
    Drug.APOMORPHINE: DrugFacts("Apomorphine", 10.0, True),
    Drug.PRAMIPEXOLE: DrugFacts("Pramipexole (salt), immediate release", 100.0, True),
    Drug.ROPINIROLE: DrugFacts("Ropinirole, immediate release", 20.0, True),
    Drug.ROTIGOTINE: DrugFacts("Rotigotine, mg per 24 h", 30.0, False),  # a patch: its level hardly changes over a visit
    Drug.SELEGILINE: DrugFacts("Selegiline, swallowed tablet", 10.0, False),
    Drug.RASAGILINE: DrugFacts("Rasagiline", 100.0, False),
    Drug.SAFINAMIDE: DrugFacts("Safinamide", None, False),
    Drug.AMANTADINE: DrugFacts("Amantadine", 1.0, False),
    Drug.ANTICHOLINERGIC: DrugFacts("Anticholinergic", None, False),
    Drug.MUSCLE_RELAXANT: DrugFacts("Muscle relaxant", None, False),
    Drug.OTHER: DrugFacts("Other", None, False),
}


def levodopa_equivalent_mg(drug: Drug, mg: float) -> float | None:
    """What a dose counts as, mg of levodopa; None where no equivalent is stated."""
    factor = DRUGS[drug].equivalent
    return None if factor is None else factor * mg
