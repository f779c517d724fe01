"""API types of the study."""

from __future__ import annotations

import datetime as dt
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, StringConstraints, field_validator
from pydantic_core import PydanticCustomError

from app.platform.audit.signatures import SignatureOut, SignatureState, Signing
from app.platform.web.schemas import Bool, Day, Int, Model, Number, Text
from app.study.outcome_fields import SURE, DerivedField, EnteredOutcomes, OutcomeField, StoredOutcomes
from app.study.settings_types import CDBS_MA, SettingsOut
from app.tables.participants import Hemisphere
from app.tables.sessions import Activity, Controller
from ml.designs import SessionDesign
from ml.outcomes import OUTCOMES

Code = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,39}$")]


class ParticipantOut(Model):
    """A participant."""

    code: str
    status: str
    synthetic: bool = Field(description="A simulation and no person: what ran is evidence of no patient.")
    site: str
    created_at: datetime
    settings: SettingsOut


class CdbsAmplitudeOut(Model):
    """cDBS amplitude in force at a visit."""

    hemisphere: Hemisphere
    program: Int = Field(0, ge=0, le=3)
    amplitude_ma: Number


class CdbsAmplitudeModel(CdbsAmplitudeOut):
    """cDBS amplitude to state for a visit."""

    amplitude_ma: Annotated[
        Number, AfterValidator(CDBS_MA.check), Field(json_schema_extra={"minimum": CDBS_MA.low, "maximum": CDBS_MA.high})
    ]
    sure: Bool | None = Field(
        None, description="True: a person has looked at an amplitude outside the usual. False: ask about one (422). Omitted: keep it."
    )


class VisitIn(Model):
    """A visit to make."""

    number: Int = Field(ge=1, le=10_000)
    date: Day | None = None
    note: Text = Field("", max_length=4000)
    cdbs_amplitudes: list[CdbsAmplitudeModel] = Field(default_factory=list, max_length=8)


class VisitChange(Model):
    """Correction of a visit; omitted fields stay. A list of amplitudes replaces the whole list."""

    date: Day | None = None
    note: Text | None = Field(None, max_length=4000)
    cdbs_amplitudes: list[CdbsAmplitudeModel] | None = Field(None, max_length=8)
    reason: Text = Field(min_length=1, max_length=1000, description="Why; kept in the audit trail.")


class VisitOut(Model):
    """A visit."""

    id: int
    participant: str
    number: int
    date: dt.date | None
    note: str
    cdbs_amplitudes: list[CdbsAmplitudeOut]


class QocIn(EnteredOutcomes):
    """End-of-session QoCs; an omitted value keeps what is known, null takes it back."""

    reason: Text | None = Field(None, max_length=1000, description="Why, when values are corrected.")
    sure: list[OutcomeField] | None = Field(None, max_length=len(OUTCOMES), description=SURE)


class QocOut(StoredOutcomes):
    """Newest revision of a session's QoCs."""

    derived: list[str] = Field(description="Members that were derived from uploaded files and not typed.")
    revision: int
    entered_by: str
    created_at: datetime


class DerivedChoice(Model):
    """A derived QoC that shall replace what a person typed; `value` is the one that was shown."""

    name: DerivedField
    value: Number = Field(ge=0, le=100)


class OutcomeOut(Model):
    """A QoC as uploaded files give it; null where they do not suffice, for the reason in `basis`."""

    name: DerivedField
    value: float | None
    unit: str
    basis: str
    conflicts: bool


class SessionOut(Model):
    """A session."""

    id: int
    visit_id: int
    visit: int
    participant: str
    ordinal: int
    controller: Controller | None = Field(
        description="Null of a proposal without a stated controller, and where it is hidden: from a blinded assessor, and from all "
        "while the key of the visit's blinded plan is sealed."
    )
    policy_id: int | None
    letter: str | None = Field(description="What the visit's blinded plan calls it; null of sessions of no blinded plan.")
    hemisphere: Hemisphere | None
    status: str
    started_at: datetime | None
    duration_s: float
    control_channel: str | None
    control_program: int | None = Field(description="Program whose amplitude the controller set; null: the control recording's first.")
    excluded_reason: str | None
    stopped_reason: str | None = Field(description="Why it was stopped for the patient's sake; null: it was not.")
    medication_h: float | None = Field(description="Hours from the last dose to the start, where a person stated them.")
    hours_since_dose: float | None = Field(description="What counts: as stated, else by the doses of the visit; null: neither is known.")
    activity: Activity | None = Field(description="Before the session; null: not stated.")
    recordings: list[int]
    qoc: QocOut | None


class SessionChange(Model):
    """Correction of a session; omitted fields stay."""

    controller: Controller | None = None
    policy_id: Int | None = None
    hemisphere: Hemisphere | None = None
    control_stream: Text | None = Field(None, max_length=40)
    control_channel: Text | None = Field(None, max_length=80)
    control_program: Int | None = Field(None, ge=0, le=15, description="Program whose amplitude the controller set.")
    excluded_reason: Text | None = Field(None, max_length=1000, description="Keeps it out of buffers and analyses; null takes that back.")
    stopped_reason: Text | None = Field(None, max_length=1000, description="Why it was stopped for the patient's sake; null: it was not.")
    medication_h: Number | None = Field(None, ge=0, le=72, description="Hours from the last dose to the start; null: by the visit's doses.")
    activity: Activity | None = Field(None, description="What the participant did in the half hour before; null: not stated.")
    reason: Text | None = Field(None, max_length=1000)


class VisitUnlockIn(Model):
    """Reason why a visit is unlocked."""

    reason: Text = Field(min_length=1, max_length=1000, description="Kept with the lock and in the audit trail.")


class VisitLockIn(Signing):
    """Reason why a visit is locked, and the signature that its data are complete and reviewed."""

    reason: Text = Field(min_length=1, max_length=1000, description="Kept with the lock and in the audit trail.")


class VisitLockOut(Model):
    """One lock or unlock of a visit."""

    locked: bool
    reason: str
    created_at: datetime
    created_by: str
    signature: SignatureOut | None
    signature_state: SignatureState = Field(
        description="`broken`: changed since. `ended`: the visit was unlocked since. `not_kept`: locked by an earlier version."
    )


class HoldModel(Model):
    """Amplitude that a design kept for some steps."""

    start: Int = Field(ge=0, le=1_000_000, description="First step.")
    steps: Int = Field(ge=1, le=1_000_000)
    amplitude: Number = Field(ge=0, le=1, description="Fraction of the cDBS amplitude.")
    log_density: Number | None = Field(description="Of the amplitude given the level and the bound in force; null where nothing was drawn.")


class DesignParameters(Model):
    """Draws of a design for one session."""

    level: Number | None = Field(None, ge=0, le=1, description="Of the session, fraction of the cDBS amplitude; null where it has none.")
    holds: list[HoldModel] = Field(default_factory=list, max_length=10_000, description="In order, without gaps, the first from step 0.")

    @field_validator("holds")
    @classmethod
    def _without_gaps(cls, value: list[HoldModel]) -> list[HoldModel]:
        at = 0
        for number, hold in enumerate(value, start=1):
            if hold.start != at:
                words = {"number": number, "start": hold.start, "at": at}
                raise PydanticCustomError("gap", "hold {number} starts at step {start}; the one before ends at step {at}", words)
            at += hold.steps
        return value


class ProgramModel(Model):
    """One stimulation program as it was set; null or empty where it is not known."""

    hemisphere: Hemisphere | None = None
    group: Text | None = Field(None, max_length=10)
    program: Int = Field(0, ge=0, le=3)
    contacts: Text = Field("", max_length=200, description="With their signs, e.g. '+C-2'.")
    pulse_width_us: Number | None = Field(None, gt=0, le=1000)
    rate_hz: Number | None = Field(None, gt=0, le=1000)


class ConditionsFields(Model):
    """Conditions of a session."""

    lower_bound: Number = Field(description="B in force, fraction: random amplitudes were drawn from [B, 1].")
    window: Int = Field(description="W, beta amplitudes in a state.")
    period_s: Number = Field(description="Seconds per step.")
    xi_beta: Number | None = Field(description="Beta threshold, in the unit of the settings of the time.")
    min_ma: Number | None = Field(description="Lowest amplitude that limits allowed, mA.")
    max_ma: Number | None = Field(description="Highest amplitude that limits allowed, mA.")
    seed: Int | None = Field(description="Of the design.")
    design: SessionDesign | None = Field(description="Of a random session; null where none is stated.")
    design_parameters: DesignParameters
    lead_amplitude_ma: Number | None = Field(description="Amplitude in force just before the session, mA.")
    cdbs_amplitude_ma: Number | None = Field(description="cDBS amplitude when the session was confirmed, mA; for the record.")
    programming: list[ProgramModel] = Field(description="Programs that stimulated, on every side that was recorded.")


class ConditionsOut(ConditionsFields):
    """Newest revision of a session's conditions."""

    revision: int
    origin: Literal["stated", "settings", "assumed"] = Field(
        description="Source of B, W, period and threshold: a person or plan, the settings in force when the session ran, or neither."
    )
    entered_by: str
    reason: str | None
    created_at: datetime


class ConditionsChange(Model):
    """Statement of a session's conditions; omitted fields stay."""

    lower_bound: Number | None = Field(None, ge=0, lt=1)
    window: Int | None = Field(None, ge=1, le=500)
    period_s: Number | None = Field(None, gt=0, le=600)
    xi_beta: Number | None = None
    min_ma: Number | None = Field(None, ge=0, le=25.5)
    max_ma: Number | None = Field(None, ge=0, le=25.5)
    seed: Int | None = None
    design: SessionDesign | None = None
    design_parameters: DesignParameters | None = None
    lead_amplitude_ma: Number | None = Field(None, ge=0, le=25.5)
    cdbs_amplitude_ma: Number | None = Field(None, gt=0, le=25.5)
    programming: list[ProgramModel] | None = Field(None, max_length=16)
    reason: Text = Field(min_length=1, max_length=1000, description="Why; kept with the revision and in the audit trail.")


class TraceOut(Model):
    """Beta and amplitude of a session on its 2 s grid; null where a window is invalid or unknown."""

    session_id: int
    period_s: float
    beta_unit: str | None
    beta_source: str | None
    beta_channel: str | None
    decode_version: int | None
    cdbs_amplitude_ma: float | None
    xi_beta: float | None = Field(description="Null also where its unit and source were not stated, or are not those of this trace.")
    steps_above_cdbs: int
    t_s: list[float]
    beta: list[float | None]
    amplitude_ma: list[float | None]
    amplitude_fraction: list[float | None]


class RecordedTraceOut(Model):
    """One trace of one recording of a session, on its own rows; null where a row is invalid."""

    id: int
    recording_id: int
    hemisphere: Hemisphere | None
    stream: str
    channel: str
    unit: str
    source: str
    decode_version: int
    is_control: bool = Field(description="The trace that the controller is taken to have seen.")
    details: dict[str, Any] = Field(description="How the values were made.")
    t_s: list[float] = Field(description="End of each row, s from the session's start; rows with t_s <= 0 lie before it.")
    values: list[float | None]
