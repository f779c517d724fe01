"""API types of the study."""

from __future__ import annotations

import datetime as dt
from datetime import datetime
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, StringConstraints

from app.platform.web.schemas import Bool, Int, Model, Number, Text
from app.study.models import Controller, Hemisphere


def _one_spelling(unit: str) -> str:
    """Micro signs are `u` and a raised two is `2`, as in decoded traces, so that one unit has one name."""
    return " ".join(unit.translate({0xB5: "u", 0x3BC: "u", 0xB2: "2"}).split())


Unit = Annotated[Text, AfterValidator(_one_spelling)]
BetaMeasure = Literal["rms", "power"]
BetaSource = Literal["time_domain", "device_power", "percept_lfp", "table"]
Code = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,39}$")]


class SettingsIn(Model):
    """Settings of a participant; what is left out keeps its present value (for a new participant: its default)."""

    xi_beta: Number | None = Field(None, ge=-1e9, le=1e9, description="Beta threshold in the unit of the beta trace; jobs need it.")
    beta_unit: Unit | None = Field(None, min_length=1, max_length=40, description="Unit of the beta trace, e.g. uV or 'device units'.")
    beta_source: BetaSource | None = Field(None, description="Where beta comes from; sources are never mixed.")
    window: Int = Field(10, ge=1, le=500, description="W, beta amplitudes in a state.")
    period_s: Number = Field(2.0, ge=0.1, le=600, description="m, seconds per step.")
    r_a: Number = Field(0.0, ge=-1e6, le=1e6, description="Reward below the threshold.")
    r_b: Number = Field(-1.0, ge=-1e6, le=1e6, description="Reward at or above the threshold.")
    c1: Number = Field(0.3, ge=0, le=1e6, description="Price of amplitude, C1.")
    c2: Number = Field(10.0, ge=0, le=1e6, description="Weight of the grasp frequency in r_end, C2; 0 drops it.")
    c3: Number = Field(10.0, ge=0, le=1e6, description="Weight of the rating, C3; 0 drops it.")
    c4: Number = Field(10.0, ge=0, le=1e6, description="Weight of tremor, C4; 0 drops it.")
    gamma: Number = Field(0.99, ge=0, lt=1, description="Discount per step.")
    lower_bound: Number = Field(0.3, ge=0, lt=1, description="B, lowest fraction of the random controller; never bounds a policy.")
    tremor_as_fraction: Bool = Field(True, description="Tremor enters r_end as 0-1 instead of per cent.")
    cdbs_amplitude_ma: Number | None = Field(None, gt=0, le=25.5, description="cDBS amplitude where a visit states none, mA.")
    beta_low_hz: Number = Field(13.0, gt=0, description="Lower edge of the beta band, Hz.")
    beta_high_hz: Number = Field(35.0, gt=0, description="Upper edge of the beta band, Hz.")
    min_valid_fraction: Number = Field(0.7, gt=0, le=1, description="Share of its samples that a 2 s window needs to be valid.")
    beta_measure: BetaMeasure = Field(
        "rms", description="Beta from time-domain LFP: 'rms' amplitude (in its unit) or 'power' (unit squared)."
    )


class SettingsOut(SettingsIn):
    """A settings version."""

    version: int
    created_at: datetime
    created_by: str
    reason: str | None


class SettingsChange(Model):
    """New settings and why."""

    settings: SettingsIn
    reason: Text | None = Field(None, max_length=1000)


class ParticipantIn(Model):
    """A participant to enrol."""

    code: Code
    site: Text | None = Field(None, max_length=40, description="Code of the site; needed when there are several.")
    settings: SettingsIn = Field(default_factory=SettingsIn)


class ParticipantOut(Model):
    """A participant."""

    code: str
    status: str
    site: str
    created_at: datetime
    settings: SettingsOut


class CdbsAmplitudeModel(Model):
    """cDBS amplitude in force at a visit."""

    hemisphere: Hemisphere
    program: Int = Field(0, ge=0, le=3)
    amplitude_ma: Number = Field(gt=0, le=25.5)


class VisitIn(Model):
    """A visit to make."""

    number: Int = Field(ge=1, le=10_000)
    date: dt.date | None = None
    note: Text = Field("", max_length=4000)
    cdbs_amplitudes: list[CdbsAmplitudeModel] = Field(default_factory=list, max_length=8)


class VisitChange(Model):
    """What a person may correct of a visit; what is left out stays. A list of amplitudes replaces the whole list."""

    date: dt.date | None = None
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
    cdbs_amplitudes: list[CdbsAmplitudeModel]


class QocIn(Model):
    """End-of-session QoCs; a value left out keeps what is known, null takes it back."""

    grasp_hz: Number | None = Field(None, ge=0, lt=20, description="Grasp frequency, Hz.")
    rating: Int | None = Field(None, ge=1, le=10, description="The participant's rating, 1-10.")
    tremor_percent: Number | None = Field(None, ge=0, le=100, description="Share of the session with mild or worse tremor, %.")
    reason: Text | None = Field(None, max_length=1000, description="Why, when values are corrected.")


class QocOut(Model):
    """Newest revision of a session's QoCs."""

    grasp_hz: float | None
    rating: int | None
    tremor_percent: float | None
    derived: list[str] = Field(description="Members that were derived from uploaded files and not typed.")
    revision: int
    entered_by: str
    created_at: datetime


class DerivedChoice(Model):
    """A derived QoC that shall replace what a person typed; `value` is the one that was shown."""

    name: Literal["grasp_hz", "tremor_percent"]
    value: Number = Field(ge=0, le=100)


class OutcomeOut(Model):
    """A QoC as uploaded files give it; null where they do not suffice, for the reason in `basis`."""

    name: Literal["grasp_hz", "tremor_percent"]
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
    controller: Controller | None = Field(description="Null only of a proposal whose controller nobody has stated yet.")
    policy_id: int | None
    hemisphere: Hemisphere | None
    status: str
    started_at: datetime | None
    duration_s: float
    control_channel: str | None
    excluded_reason: str | None
    recordings: list[int]
    qoc: QocOut | None


class SessionChange(Model):
    """What a person may correct of a session; what is left out stays."""

    controller: Controller | None = None
    policy_id: Int | None = None
    hemisphere: Hemisphere | None = None
    control_stream: Text | None = Field(None, max_length=40)
    control_channel: Text | None = Field(None, max_length=80)
    excluded_reason: Text | None = Field(None, max_length=1000, description="Keeps it out of buffers and analyses; null takes that back.")
    reason: Text | None = Field(None, max_length=1000)


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
