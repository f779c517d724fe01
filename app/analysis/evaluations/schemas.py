"""API types of methods by seed."""

from __future__ import annotations

from pydantic import Field

from app.platform.web.schemas import Model


class SeedRowOut(Model):
    """One method of evaluation under one seed."""

    method: str
    name: str
    seed: int
    evaluation_id: int
    policies: int
    mae: float = Field(description="Mean absolute error, reward.")
    mae_of_range: float | None
    rank_correlation: float | None = Field(description="Spearman's.")
    regret_of_range: float | None = Field(description="Regret@1 over the range of the returns.")


class BySeedOut(Model):
    """Methods by seed on one snapshot, against the returns of the sessions recorded after it."""

    participant: str
    snapshot_id: int | None
    seeds: list[int]
    policies: int = Field(description="Policies estimated under every seed that ran afterwards.")
    rows: list[SeedRowOut]
    text: str = Field(description="What is missing; empty where nothing is.")
