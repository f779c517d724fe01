"""Sentences of planning, made of typed values at the last moment; nothing reads them back."""

from __future__ import annotations

from ml.deploy.manifest import BundleManifest


def release_reason(manifest: BundleManifest) -> str:
    """Why a bundle's bytes were stored, for the audit trail."""
    side = f", {manifest.hemisphere}" if manifest.hemisphere else ""
    return (
        f"controller bundle of {manifest.participant}, policy {manifest.policy_id}{side}: {manifest.min_ma:g} to {manifest.max_ma:g} mA, "
        f"cDBS {manifest.cdbs_ma:g} mA, ramp {manifest.ramp_ma_per_s:g} mA/s"
    )
