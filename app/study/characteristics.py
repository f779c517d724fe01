"""Characteristics of a participant as the paper's appendix lists them: leads, symptoms, hand, medication. Versioned; no identity."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Annotated

from pydantic import Field, StringConstraints, model_validator
from pydantic_core import PydanticCustomError
from sqlalchemy.orm import Session

from app.platform.web.schemas import Int, Model, Number, Text
from app.study import repository as study_repository
from app.study.doses import DRUGS
from app.tables.participants import CharacteristicsVersion, Hemisphere, Participant
from app.tables.visits import Drug

# API types of characteristics.

MOST_LEADS, MOST_DOSES = 4, 8
Contacts = Annotated[str, StringConstraints(pattern=r"^[0-9A-Ca-c+ ,;/()-]*$", max_length=40, strip_whitespace=True)]
"""Contacts with their signs, such as `0-2` or `C+2-`; no free text."""
LeadModel = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9 ./-]*$", max_length=20, strip_whitespace=True)]
ClockTime = Annotated[str, StringConstraints(pattern=r"^([01][0-9]|2[0-3]):[0-5][0-9]$")]


class Target(StrEnum):
    """Target structure of a lead."""

    STN = "stn"
    GPI = "gpi"
    GPE = "gpe"
    VIM = "vim"
    OTHER = "other"


class Symptom(StrEnum):
    """A symptom that stimulation is given for, or that it is watched for."""

    TREMOR = "tremor"
    BRADYKINESIA = "bradykinesia"
    RIGIDITY = "rigidity"
    GAIT = "gait"
    DYSKINESIA = "dyskinesia"
    DYSTONIA = "dystonia"
    SPEECH = "speech"


class Lead(Model):
    """One lead."""

    hemisphere: Hemisphere
    target: Target
    model: LeadModel = Field("", description="Type number of the maker; never a serial number.")
    sensing: Contacts = Field("", description="Contacts that are sensed between, such as `0-2`; empty: none.")
    stimulating: Contacts = Field("", description="Contacts that stimulate, such as `C+2-`; empty: none.")


class PlannedDose(Model):
    """A dose of an ordinary visit day."""

    drug: Drug
    mg: Number = Field(gt=0, le=5000)
    at: ClockTime = Field(description="Local time of day, HH:MM.")


class CharacteristicsFields(Model):
    """Characteristics of a participant, as a whole."""

    leads: list[Lead] = Field(default_factory=list, max_length=MOST_LEADS)
    symptoms: list[Symptom] = Field(default_factory=list, max_length=len(Symptom))
    hand: Hemisphere | None = Field(None, description="Hand that goes with the symptoms: its grasp test counts. Null: not stated.")
    medication: list[PlannedDose] = Field(default_factory=list, max_length=MOST_DOSES, description="Schedule of a visit day, by time.")

    @model_validator(mode="after")
    def _each_once(self) -> CharacteristicsFields:
        if len(set(self.symptoms)) < len(self.symptoms):
            raise PydanticCustomError("twice", "a symptom is twice in the list")
        if len({(d.drug, d.at) for d in self.medication}) < len(self.medication):
            raise PydanticCustomError("twice", "the same drug is listed twice at one time: give both together")
        return self


class CharacteristicsChange(Model):
    """New characteristics, and why."""

    version: Int = Field(ge=0, le=100_000, description="The one that the caller has read; 0 where there is none yet.")
    characteristics: CharacteristicsFields
    reason: Text = Field(min_length=1, max_length=1000, description="Kept with the version and in the audit trail.")


class CharacteristicsOut(CharacteristicsFields):
    """A version of a participant's characteristics."""

    version: int
    created_at: datetime
    created_by: str
    reason: str


# Words of characteristics.

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
    """Write characteristics in words, by label; empty where nothing is stated."""
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


# Queries of characteristics.


# Rules of characteristics. The caller commits.


def fields_of(row: CharacteristicsVersion | None) -> CharacteristicsFields:
    """Convert a version to fields; all empty where there is no version yet."""
    return CharacteristicsFields.model_validate({n: getattr(row, n) for n in CharacteristicsFields.model_fields} if row else {})


def suggested_hand(db: Session, participant: Participant) -> Hemisphere | None:
    """Suggest the hand contralateral to the stimulated hemisphere; None where that is not one hemisphere. A person decides."""
    sides = {Hemisphere(s.hemisphere) for s in study_repository.sessions_of_participant(db, participant.id) if s.hemisphere}
    if not sides:
        leads = fields_of(participant.current_characteristics).leads
        sides = {lead.hemisphere for lead in leads if lead.stimulating} or {lead.hemisphere for lead in leads}
    return sides.pop().opposite if len(sides) == 1 else None
