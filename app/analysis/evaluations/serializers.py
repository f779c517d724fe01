"""Methods by seed as API types."""

from __future__ import annotations

from dataclasses import asdict

from app.analysis.evaluations.schemas import BySeedOut, SeedRowOut
from app.analysis.evaluations.service import LEAST_POLICIES, WANTED_SEEDS, BySeed

CSV_COLUMNS = (
    "participant", "snapshot_id", "method", "name", "seed", "evaluation_id", "policies", "mae", "mae_of_range", "rank_correlation",
    "regret_of_range",
)  # fmt: skip


def by_seed_out(found: BySeed) -> BySeedOut:
    """Everything of the page."""
    return BySeedOut(
        participant=found.participant,
        snapshot_id=found.snapshot_id,
        seeds=list(found.seeds),
        policies=found.policies,
        rows=[SeedRowOut(**asdict(r)) for r in found.rows],
        text=missing(found),
    )


def missing(found: BySeed) -> str:
    """What the figure lacks, in words."""
    if found.snapshot_id is None:
        return "No evaluation has been made yet."
    if found.policies < LEAST_POLICIES:
        return (
            f"{found.policies} of the policies estimated under every seed on snapshot {found.snapshot_id} ran after it with a known "
            f"return; it takes {LEAST_POLICIES}. Sessions inside the snapshot were there to be fitted and prove nothing."
        )
    if len(found.seeds) < WANTED_SEEDS:
        return f"Snapshot {found.snapshot_id} was evaluated under {len(found.seeds)} of {WANTED_SEEDS} seeds."
    return ""


def csv_rows(found: BySeed) -> list[tuple[object, ...]]:
    """One row per method and seed."""
    return [(found.participant, found.snapshot_id, *asdict(r).values()) for r in found.rows]
