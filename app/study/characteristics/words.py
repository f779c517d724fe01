"""Words of characteristics."""

from __future__ import annotations

from app.study.characteristics.schemas import CharacteristicsFields, Symptom, Target
from app.study.doses.drugs import DRUGS

SYMPTOMS = {
    Symptom.TREMOR: "Tremor",
    Symptom.BRADYKINESIA: "Bradykinesia",
    Symptom.RIGIDITY: "Rigidity",
    Symptom.GAIT: "Gait",
    Symptom.DYSKINESIA: "Dyskinesia",
    Symptom.DYSTONIA: "Dystonia",
    Symptom.SPEECH: "Speech",
}


TARGETS = {Target.STN: "STN", Target.GPI: "GPi", Target.GPE: "GPe", Target.VIM: "Vim", Target.OTHER: "other"}


MEDICATION = "Medication of a visit day"


def characteristics_words(known: CharacteristicsFields) -> dict[str, str]:
    """Characteristics in words, by label; empty where nothing is stated."""
    leads = "; ".join(
        f"{lead.hemisphere} {TARGETS[lead.target]}"
        + (f", {lead.model}" if lead.model else "")
        + (f", sensing {lead.sensing}" if lead.sensing else "")
        + (f", stimulating {lead.stimulating}" if lead.stimulating else "")
        for lead in known.leads
    )
    medication = "; ".join(f"{d.at} {DRUGS[d.drug].name} {d.mg:g} mg" for d in known.medication)
    symptoms = ", ".join(SYMPTOMS[s].lower() for s in known.symptoms)
    return {"Leads": leads, "Symptoms": symptoms, "Hand of the grasp test": str(known.hand or ""), MEDICATION: medication}
