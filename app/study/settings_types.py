"""API types of a participant's settings, and the bounds of what may be set."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import AfterValidator, ConfigDict, Field, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from app.platform.web.schemas import Bool, Int, Model, Number, Text
from app.study.outcome_fields import SURE
from ml.outcomes import END_WEIGHTS


def _one_spelling(unit: str) -> str:
    """Write micro signs as `u` and a raised two as `2`, as in decoded traces, so that one unit has one name."""
    return " ".join(unit.translate({0xB5: "u", 0x3BC: "u", 0xB2: "2"}).split())


Unit = Annotated[Text, AfterValidator(_one_spelling)]
BetaMeasure = Literal["rms", "power"]
BetaSource = Literal["time_domain", "device_power", "percept_lfp", "table"]


class Bound(NamedTuple):
    """Range of a number: from `low` to `high` in `unit`, both allowed; where it is not 0, its magnitude is `least` at the least."""

    low: float
    high: float
    unit: str = ""
    least: float = 0.0

    def check(self, value: float) -> float:
        """Return the value. Raises PydanticCustomError outside the bounds; a form and the interface show its text unchanged."""
        if self.low <= value <= self.high and (value == 0 or abs(value) >= self.least):
            return value
        words = f"must lie between {self.low:g} and {self.high:g} {self.unit}".rstrip()
        if self.low <= value <= self.high:
            words = f"must be 0, or at least {self.least:g} {self.unit} in magnitude".replace("  ", " ")
        raise PydanticCustomError("out_of_bounds", "{value} {words}", {"value": f"{value:g}", "words": words})


CDBS_MA = Bound(0.1, 25.5, "mA")
"""25.5 mA is the most that a stimulator like RC+S or Percept gives, and 0.1 mA its smallest step."""
SETTING_BOUNDS = {
    "xi_beta": Bound(-1e9, 1e9, "in the unit of beta", 1e-12),
    "window": Bound(1, 500, "steps"),
    "period_s": Bound(0.1, 600, "s"),
    "r_a": Bound(-1e6, 1e6, "", 1e-6),
    "r_b": Bound(-1e6, 1e6, "", 1e-6),
    "c1": Bound(0, 1e6, "", 1e-6),
    "c2": Bound(0, 1e6, "", 1e-6),
    "c3": Bound(0, 1e6, "", 1e-6),
    "c4": Bound(0, 1e6, "", 1e-6),
    "gamma": Bound(0, 0.9999, "per step", 1e-6),
    "lower_bound": Bound(0.01, 0.99, "of the cDBS amplitude"),
    "cdbs_amplitude_ma": CDBS_MA,
    "beta_low_hz": Bound(1, 500, "Hz"),
    "beta_high_hz": Bound(1, 500, "Hz"),
    "min_valid_fraction": Bound(0.01, 1),
    "most_imputed": Bound(0, 10, "steps"),
    "early_visits": Bound(1, 20, "visits"),
}
"""Clinical bounds of what may be set from now on; older versions may be outside of them, and are shown unchanged."""


def published(bounds: Mapping[str, Bound]) -> Callable[[dict[str, Any]], None]:
    """Return a function that puts the bounds of a model's fields into its JSON schema."""

    def publish(schema: dict[str, Any]) -> None:
        for name, bound in bounds.items():
            schema["properties"][name] |= {"minimum": bound.low, "maximum": bound.high}

    return publish


class SettingsFields(Model):
    """Settings of a participant."""

    xi_beta: Number | None = Field(None, description="Beta threshold in the unit of the beta trace; jobs need it.")
    beta_unit: Unit | None = Field(None, min_length=1, max_length=40, description="Unit of the beta trace, e.g. uV or 'device units'.")
    beta_source: BetaSource | None = Field(None, description="Where beta comes from; sources are never mixed.")
    window: Int = Field(10, description="W, beta amplitudes in a state.")
    period_s: Number = Field(2.0, description="m, seconds per step.")
    r_a: Number = Field(0.0, description="Reward below the threshold.")
    r_b: Number = Field(-1.0, description="Reward at or above the threshold.")
    c1: Number = Field(0.3, description="Price of amplitude, C1.")
    c2: Number = Field(10.0, description=END_WEIGHTS["c2"].description)
    c3: Number = Field(10.0, description=END_WEIGHTS["c3"].description)
    c4: Number = Field(10.0, description=END_WEIGHTS["c4"].description)
    gamma: Number = Field(0.99, description="Discount per step.")
    lower_bound: Number = Field(0.3, description="B, lowest fraction of the random controller; never bounds a policy.")
    tremor_as_fraction: Bool = Field(True, description="Tremor enters r_end as 0-1 instead of per cent.")
    cdbs_amplitude_ma: Number | None = Field(None, description="cDBS amplitude where a visit states none, mA.")
    beta_low_hz: Number = Field(13.0, description="Lower edge of the beta band, Hz.")
    beta_high_hz: Number = Field(35.0, description="Upper edge of the beta band, Hz.")
    min_valid_fraction: Number = Field(0.7, description="Coverage: share of its samples that a 2 s window needs to be valid.")
    most_imputed: Int = Field(
        2,
        description="Imputed beta amplitudes that a state may hold, in learning and on the tablet, never as its newest; "
        "0 in older settings.",
    )
    beta_measure: BetaMeasure = Field(
        "rms", description="Beta from time-domain LFP: 'rms' amplitude (in its unit) or 'power' (unit squared)."
    )
    design: Literal["stratified", "paper"] = Field(
        "stratified",
        description="How random sessions try amplitudes: 'stratified' levels with draws of 10-60 s, or 'paper', a new uniform draw every "
        "step. Settings of older versions have 'paper'.",
    )
    design_ladder: Bool = Field(False, description="Stratified design: the first random session of a visit is a titration ladder.")
    early_visits: Int = Field(3, description="Stratified design: visits over which the levels of random sessions are spread.")
    pool_programmings: Bool = Field(
        False, description="Sessions under other contacts, pulse widths or rates than the newest enter buffers too, as another dose."
    )
    pool_shapes: Bool = Field(
        False,
        description="Rankings also use the site's other participants for the shape of an outcome's answer to the dose, where leaving each "
        "participant out shows that it helps. They never use its size, sign or level.",
    )


class SettingsIn(SettingsFields):
    """Settings of a participant; omitted ones keep their present value (for a new participant: its default)."""

    model_config = ConfigDict(json_schema_extra=published(SETTING_BOUNDS))

    @field_validator(*SETTING_BOUNDS)
    @classmethod
    def _within_bounds(cls, value: float | None, info: ValidationInfo) -> float | None:
        return value if value is None else SETTING_BOUNDS[str(info.field_name)].check(value)


class SettingsOut(SettingsFields):
    """A settings version."""

    version: int
    created_at: datetime
    created_by: str
    reason: str | None


class SettingsChange(Model):
    """New settings and why."""

    settings: SettingsIn
    reason: Text | None = Field(None, max_length=1000)
    sure: list[Literal["cdbs_amplitude_ma"]] | None = Field(None, max_length=1, description=SURE)
