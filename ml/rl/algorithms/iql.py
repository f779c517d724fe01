"""Implicit Q-learning (IQL): values without ever asking the critic about an action that was not logged. Source: Kostrikov et al. 2022.

One update on a batch (s, a, r, s'):

1. V: expectile regression towards Q'(s, a) = min(Q'_1, Q'_2): errors above V weigh `expectile`, below it 1 - `expectile`;
2. actor: regression on the logged actions, each weighted by exp(temperature (Q'(s, a) - V(s))), at most 100;
3. critics: least squares of Q_1, Q_2 towards r + gamma V(s');
4. the critics' targets follow.

With a Gaussian policy of fixed width, step 2 is the paper's advantage-weighted regression; the deterministic policy here is its mean.
Rewards are scaled to returns of deviation 1, which is the unit of the temperature.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch

from ml.rl.algorithms._learner import CriticLearner, critic_inputs, fresh_critic
from ml.rl.configs import CriticConfig, setting
from ml.rl.kernels.batches import TransitionBatch
from ml.rl.kernels.networks import MlpPolicy, Value

_LARGEST_WEIGHT = 100.0


@dataclass(frozen=True, kw_only=True)
class IqlConfig(CriticConfig):
    """Hyper-parameters of IQL; `field_docs` says what each one means."""

    algorithm: ClassVar[str] = "iql"
    per_member: ClassVar[tuple[str, ...]] = (*CriticConfig.per_member, "expectile", "temperature")

    expectile: float = setting(0.7, "Expectile of V over the logged actions; 0.5 is their mean, towards 1 their best.", above=0, high=0.999)
    temperature: float = setting(3.0, "How sharply the actor prefers logged actions of larger advantage; 0 clones them all.", low=0)


class IqlLearner(CriticLearner[IqlConfig]):
    """Actor, V, two critics and their targets."""

    config_type = IqlConfig
    targets = ("critic", "critic_2")

    @classmethod
    def networks(cls, config: IqlConfig, policy: MlpPolicy, seeds: Sequence[int]) -> dict[str, Any]:
        return {
            "policy": policy,
            "critic": fresh_critic(config, policy, seeds[0]),
            "critic_2": fresh_critic(config, policy, seeds[1]),
            "value": Value(critic_inputs(config, policy), config.hidden, seed=seeds[2]),
        }

    def update(self, batch: TransitionBatch) -> None:
        """Run one update, in the order of the module's text."""
        logged = self.target_stacks["critic"].forward(batch.critic_states, batch.actions).clone()
        logged = torch.minimum(logged, self.target_stacks["critic_2"].forward(batch.critic_states, batch.actions))
        value = self.stacks["value"]
        next_values = value.forward(batch.next_critic_states).clone()
        advantage = logged - value.forward(batch.critic_states)
        expectile = self.member_setting("expectile")
        weight = torch.where(advantage > 0, expectile, 1.0 - expectile)
        self._note("value_loss", weight * advantage.square())
        value.backward((weight * advantage).mul_(-2.0 / self.config.batch))
        if self._warm:
            self._clone_the_better(batch, advantage)
        self.adams["value"].step()
        targets = torch.add(batch.rewards, next_values, alpha=self.scale.gamma)
        for name in ("critic", "critic_2"):
            self._descend_on_target(name, batch, targets)
        self._follow()
        self._count_update()

    def _clone_the_better(self, batch: TransitionBatch, advantage: Any) -> None:
        weight = torch.exp(advantage * self.member_setting("temperature")).clamp_(max=_LARGEST_WEIGHT)
        actions = self.policy_stack.act(batch.states)
        error = actions - batch.actions
        # Half the weighted squared error of actions in [-1, 1]: the log-density of a Gaussian of deviation 1.
        self.policy_stack.backward_from_actions((weight * error).mul_(4.0 / self.config.batch), actions)
        self.adams["policy"].step()
