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
    "algorithms.registry": ("ALGORITHMS", "Algorithm", "algorithm"),
    "loop": ("CheckpointError", "TrainingDiverged"),
    "configs": ("CriticConfig", "TrainConfig"),
    "distillation": ("DistilConfig", "distil"),
    "held_out": ("HeldOutSessions", "split_sessions"),
    "kernels.networks": ("MlpPolicy", "STUDENT_HIDDEN", "TEACHER_HIDDEN"),
    "algorithms._learner": ("SATURATION_MARGIN",),
    "training": ("TrainedPolicy", "train", "train_many"),
    "end_reward": ("fit_end_reward",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

# fmt: off
__all__ = [
    "ALGORITHMS", "SATURATION_MARGIN", "STUDENT_HIDDEN", "TEACHER_HIDDEN", "Algorithm", "CheckpointError", "CriticConfig",
    "DistilConfig", "HeldOutSessions", "MlpPolicy", "TrainConfig", "TrainedPolicy", "TrainingDiverged", "algorithm", "distil",
    "fit_end_reward", "split_sessions", "train", "train_many",
]
# fmt: on


def __getattr__(name: str) -> Any:
    """Import a public name from its module. Raises AttributeError for any other name."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
