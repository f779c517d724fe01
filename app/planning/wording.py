"""Sentences of planning, made of typed values at the last moment; nothing reads them back."""

from __future__ import annotations

from app.evaluation.wording import amplitude
from ml.deploy.manifest import BundleManifest


def release_reason(manifest: BundleManifest) -> str:
    """Why a bundle's bytes were stored, for the audit trail."""
    side = f", {manifest.hemisphere}" if manifest.hemisphere else ""
    return (
        f"controller bundle of {manifest.participant}, policy {manifest.policy_id}{side}: {manifest.min_ma:g} to {manifest.max_ma:g} mA, "
        f"cDBS {manifest.cdbs_ma:g} mA, ramp {manifest.ramp_ma_per_s:g} mA/s"
    )


def of_item(policy: str, min_fraction: float | None, override_reason: str | None, cdbs_ma: float | None) -> list[str]:
    """What whoever runs a session must know of its policy: its lowest amplitude, and that it is unsafe and planned all the same."""
    found = []
    if min_fraction is not None:
        lowest = amplitude(min_fraction, None if cdbs_ma is None else min_fraction * cdbs_ma)
        found.append(f"Policy '{policy}' may not go below {lowest}.")
    if override_reason:
        found.append(f"Policy '{policy}' is unsafe and planned all the same: {override_reason}.")
    return found
