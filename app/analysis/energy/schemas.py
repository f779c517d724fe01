"""API types of the energy."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from app.platform.web.schemas import Model, Text
from app.tables.sessions import Controller

Amount = Annotated[float, Field(allow_inf_nan=False)]


class MeasureOut(Model):
    """One measure of one controller."""

    measure: str = Field(description="mean_a, mean_a2, all_sides_a2, charge_uc_per_s or teed_uw.")
    title: str
    unit: str
    definition: str
    controller: Controller
    mean: float | None = Field(description="Over its sessions; null where no session has it.")
    saved_percent: float | None = Field(description="Against the mean of the cDBS sessions.")
    session_ids: list[int]


class EnergyOut(Model):
    """What stimulation took, by controller and measure."""

    participant: str
    rows: list[MeasureOut]
    unknown_sides: int = Field(description="Sides and programs of sessions whose amplitude in mA, width or rate is not known.")


class ImplantIn(Model):
    """Assumptions about an implant; no recording holds them."""

    capacity_low_mah: Amount = Field(gt=0, le=1e5)
    capacity_high_mah: Amount = Field(gt=0, le=1e5)
    voltage_v: Amount = Field(gt=0, le=100)
    other_drain_uw: Amount = Field(ge=0, le=1e6)
    impedance_ohm: Amount = Field(gt=0, le=1e5)
    supply_v: Amount = Field(gt=0, le=100)
    pulse_width_us: Amount = Field(gt=0, le=1000)
    rate_hz: Amount = Field(gt=0, le=1000)
    cdbs_ma: Amount = Field(gt=0, le=25.5)
    source: Text = Field(min_length=1, max_length=300)


class BatteryIn(ImplantIn):
    """The same as a query."""

    format: Literal["json", "csv"] = "json"


class BatteryRowOut(Model):
    """Days of one charge, or of a primary cell, if one controller ran all the time."""

    controller: Controller
    days_low: float
    days_high: float
    session_ids: list[int] = Field(description="Sessions whose amplitudes it goes by.")


class BatteryOut(Model):
    """A battery's life by controller under stated assumptions."""

    participant: str
    source: str = Field(description="Where the assumptions are from.")
    rows: list[BatteryRowOut]
