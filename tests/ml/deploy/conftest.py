from __future__ import annotations

import numpy as np
import pytest
import torch

from ml.deploy.manifest import Approval, BundleManifest
from ml.rl import MlpPolicy


@pytest.fixture(scope="session")
def network() -> MlpPolicy:
    """A student whose answers spread over the range."""
    policy = MlpPolicy(10, (20, 10), mean=120.0, std=35.0, seed=3)
    with torch.no_grad():
        policy.layers[-1].weight.mul_(1000)
    return policy


@pytest.fixture(scope="session")
def manifest() -> BundleManifest:
    return BundleManifest(
        participant="P-07",
        policy_id=41,
        policy_name="visit 3, seed 2, distilled",
        window=10,
        beta_unit="uV",
        beta_source="time_domain",
        normalisation_mean=120.0,
        normalisation_std=35.0,
        min_ma=0.5,
        max_ma=3.2,
        cdbs_ma=3.0,
        ramp_ma_per_s=0.25,
        hemisphere="left",
        limits_stated_by="ada@clinic.example, 2026-03-01 08:55 UTC",
        device_min_ma=0.0,
        device_max_ma=3.4,
        teacher_name="rl-03",
        agreement_mean=0.0012,
        agreement_p99=0.0081,
        agreement_worst=0.0121,
        beta_max=900.0,
        level_low=30.0,
        level_high=400.0,
        frozen_after=5,
        most_imputed=2,
        carried_over=0.7,
        snapshot_sha256="ab" * 32,
        code_version="0.1.0",
        approvals=(Approval(name="A. Clinician", role="clinician", approved_at="2026-03-01T09:00:00+00:00", statement="limits checked"),),
    )


@pytest.fixture(scope="session")
def test_windows() -> np.ndarray:
    return np.abs(np.random.default_rng(0).normal(120.0, 40.0, (16, 10)))
