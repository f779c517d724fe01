"""API types of beta as a biomarker."""

from __future__ import annotations

from pydantic import Field

from app.platform.web.schemas import Model


class AssociationOut(Model):
    """A slope and a correlation, or why there is none."""

    slope: float | None
    low: float | None
    high: float | None
    p_value: float | None
    correlation: float | None
    correlation_low: float | None
    correlation_high: float | None
    visits: int
    sessions: int
    text: str


class PairingOut(Model):
    """One measurement against another."""

    x: str
    y: str
    within_visits: AssociationOut
    between_visits: AssociationOut = Field(description="Of the visits' means.")
    session_ids: list[int]


class BiomarkerOut(Model):
    """Beta against amplitude and QoCs; cDBS sessions over the months; everything against the time since the last dose."""

    participant: str
    beta_unit: str
    beta: list[PairingOut]
    progression: list[PairingOut]
    medication: list[PairingOut]
