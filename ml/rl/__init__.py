"""Offline reinforcement learning of stimulation policies. Source: Gao et al. 2023, section 4.

This module names what other packages may use; everything else is internal (contracts in `pyproject.toml`). A name is imported at its first
use, so that the table of algorithms can be read without loading torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ml.rl.algorithms._learner import SATURATION_MARGIN
    from ml.rl.algorithms.registry import ALGORITHMS, Algorithm, algorithm
    from ml.rl.configs import CriticConfig, TrainConfig
    from ml.rl.distillation import DistilConfig, distil
    from ml.rl.end_reward import fit_end_reward
    from ml.rl.held_out import HeldOutSessions, split_sessions
    from ml.rl.kernels.networks import STUDENT_HIDDEN, TEACHER_HIDDEN, MlpPolicy
    from ml.rl.loop import CheckpointError, TrainingDiverged
    from ml.rl.training import TrainedPolicy, train, train_many

_HOMES = {
    "ALGORITHMS": "algorithms.registry",
    "Algorithm": "algorithms.registry",
    "CheckpointError": "loop",
    "CriticConfig": "configs",
    "DistilConfig": "distillation",
    "HeldOutSessions": "held_out",
    "MlpPolicy": "kernels.networks",
    "SATURATION_MARGIN": "algorithms._learner",
    "STUDENT_HIDDEN": "kernels.networks",
    "TEACHER_HIDDEN": "kernels.networks",
    "TrainConfig": "configs",
    "TrainedPolicy": "training",
    "TrainingDiverged": "loop",
    "algorithm": "algorithms.registry",
    "distil": "distillation",
    "fit_end_reward": "end_reward",
    "split_sessions": "held_out",
    "train": "training",
    "train_many": "training",
}

__all__ = [
    "ALGORITHMS",
    "SATURATION_MARGIN",
    "STUDENT_HIDDEN",
    "TEACHER_HIDDEN",
    "Algorithm",
    "CheckpointError",
    "CriticConfig",
    "DistilConfig",
    "HeldOutSessions",
    "MlpPolicy",
    "TrainConfig",
    "TrainedPolicy",
    "TrainingDiverged",
    "algorithm",
    "distil",
    "fit_end_reward",
    "split_sessions",
    "train",
    "train_many",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
