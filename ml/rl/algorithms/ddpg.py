"""Deep deterministic policy gradient (DDPG), offline. Source: Gao et al. 2023, section 2.2 and appendix C.1, after Lillicrap et al. 2016.

One update, in this order, on a batch of the replay buffer:

1. critic: least squares of Q(s, a) towards y = r + gamma Q'(s', pi'(s')), with target networks Q', pi';
2. actor: one step up the mean of Q(s, pi(s)) (eq:ac_objective);
3. targets: theta' <- (1 - tau) theta' + tau theta.

There are no terminal flags. A session ends because the clinic's time is over, not because the participant reached a final state. Cutting
the bootstrap there would teach the critic that stopping the clock stops the pathology. There is no exploration noise (the data are logged)
and no term but the above. Nothing keeps the actor near the logged actions, so read `action_distance` and `mean_q` of the learning curves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch

from ml.rl.algorithms._learner import CriticLearner, Networks, fresh_critic
from ml.rl.configs import CriticConfig
from ml.rl.kernels.batches import RewardScale, TransitionBatch
from ml.rl.kernels.networks import MlpPolicy


@dataclass(frozen=True, kw_only=True)
class DdpgConfig(CriticConfig):
    """Hyper-parameters of DDPG; `field_docs` says what each one means."""

    algorithm: ClassVar[str] = "ddpg"


class DdpgLearner(CriticLearner[DdpgConfig]):
    """Actor, critic and their targets."""

    config_type = DdpgConfig
    targets = ("policy", "critic")

    def __init__(self, starts: Sequence[Networks], configs: Sequence[DdpgConfig], scale: RewardScale, device: str = "cpu") -> None:
        super().__init__(starts, configs, scale, device)
        self._uphill = torch.full((self.members, self.config.batch, 1), -1.0 / self.config.batch, device=device)

    @classmethod
    def networks(cls, config: DdpgConfig, policy: MlpPolicy, seeds: Sequence[int]) -> dict[str, Any]:
        return {"policy": policy, "critic": fresh_critic(config, policy, seeds[0])}

    def update(self, batch: TransitionBatch) -> None:
        """Run one DDPG update, in the order of the module's text."""
        critic, actor = self.stacks["critic"], self.policy_stack
        next_values = self.target_stacks["critic"].forward(batch.next_critic_states, self.target_actor.act(batch.next_states))
        self._descend_on_target("critic", batch, torch.add(batch.rewards, next_values, alpha=self.scale.gamma))
        if self._warm:
            actions = actor.act(batch.states)
            critic.forward(batch.critic_states, actions)
            actor.backward_from_actions(critic.action_gradient(self._uphill), actions)
            self.adams["policy"].step()
        self._follow()
        self._count_update()
