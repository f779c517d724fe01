"""The estimators of the ranking page, by their keys."""

from __future__ import annotations

from ml.ope.dlsm import Dlsm
from ml.ope.dlsm_config import DlsmConfig
from ml.ope.estimate import Estimator
from ml.ope.importance import ImportanceSampling
from ml.ope.linear import LinearConfig, LinearModel


def estimators(seed: int = 0, *, demo: bool = False) -> dict[str, Estimator]:
    """Every estimator at its default settings, or at settings for a quick demonstration."""
    config = DlsmConfig.demo(seed) if demo else DlsmConfig(seed=seed)
    return {
        "dlsm": Dlsm(config),
        "linear": LinearModel(LinearConfig(seed=seed)),
        "wis": ImportanceSampling("wis", seed=seed),
        "pdis": ImportanceSampling("pdis", seed=seed),
    }
