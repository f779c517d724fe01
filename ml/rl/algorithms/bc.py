"""Behaviour cloning: the policy that imitates the logged amplitudes. One that does not beat it has learnt nothing of rewards.

Source: Pomerleau 1989. Its stored key is `cloning`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from ml.rl.algorithms._learner import StackedLearner
from ml.rl.configs import TrainConfig
from ml.rl.kernels.batches import TransitionBatch
from ml.rl.kernels.networks import MlpPolicy


@dataclass(frozen=True, kw_only=True)
class CloningConfig(TrainConfig):
    """Hyper-parameters of behaviour cloning; `field_docs` says what each one means."""

    algorithm: ClassVar[str] = "cloning"


class CloningLearner(StackedLearner[CloningConfig]):
    """The actor alone: least squares of pi(s) towards the logged a. Of a random controller that is its mean amplitude."""

    config_type = CloningConfig

    @classmethod
    def networks(cls, config: CloningConfig, policy: MlpPolicy, seeds: Sequence[int]) -> dict[str, Any]:
        return {"policy": policy}

    def update(self, batch: TransitionBatch) -> None:
        """Take one step of least squares."""
        actions = self.policy_stack.act(batch.states)
        error = actions - batch.actions
        self._note("cloning_loss", error.square())
        self.policy_stack.backward_from_actions(error.mul_(2.0 / self.config.batch), actions)
        self.adams["policy"].step()
        self._count_update()
