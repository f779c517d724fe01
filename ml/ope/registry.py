"""The estimators of the ranking page, by their keys."""

from __future__ import annotations

from ml.ope.dlmm import Dlmm, DlmmConfig
from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.estimator import Dlsm
from ml.ope.doubly_robust import DoublyRobust
from ml.ope.dual_dice import DiceConfig, DualDice
from ml.ope.estimate import Estimator
from ml.ope.fqe.estimator import Fqe, FqeConfig
from ml.ope.importance import ImportanceSampling
from ml.ope.linear.estimator import LinearConfig, LinearModel


def estimators(seed: int = 0, *, demo: bool = False) -> dict[str, Estimator]:
    """Every estimator at its default settings, or at settings for a quick demonstration."""
    config = DlsmConfig.demo(seed) if demo else DlsmConfig(seed=seed)
    return {
        "dlsm": Dlsm(config),
        "linear": LinearModel(LinearConfig(seed=seed)),
        "dlmm": Dlmm(DlmmConfig(members=1, updates=800, rollouts=64, seed=seed) if demo else DlmmConfig(seed=seed)),
        "fqe": Fqe(FqeConfig(seed=seed, members=1, refits=30) if demo else FqeConfig(seed=seed)),
        "wdr": DoublyRobust(FqeConfig(seed=seed, members=1 if demo else 3, refits=20 if demo else 30)),
        "dual_dice": DualDice(DiceConfig(seed=seed, members=1, updates=300) if demo else DiceConfig(seed=seed)),
        "wis": ImportanceSampling("wis", seed=seed),
        "pdis": ImportanceSampling("pdis", seed=seed),
        "cwpdis": ImportanceSampling("cwpdis", seed=seed),
    }


def quick_estimators(seed: int = 0) -> dict[str, Estimator]:
    """The methods that are fitted within seconds, at settings for `skill.choose_default`, which fits each once per controller."""
    return {
        "linear": LinearModel(LinearConfig(seed=seed, draws=20)),
        "fqe": Fqe(FqeConfig(seed=seed, refits=25)),
        "wdr": DoublyRobust(FqeConfig(seed=seed, members=1, refits=25)),
        "wis": ImportanceSampling("wis", seed=seed, draws=100),
        "cwpdis": ImportanceSampling("cwpdis", seed=seed, draws=100),
    }
