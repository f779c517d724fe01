"""ReBRAC: TD3 with penalties in actor and critic apart, and normalised critics. Source: Tarasov et al. 2023.

One update on a batch (s, a, r, s', a'), where a' is the action logged after a:

1. critics: least squares of Q_1, Q_2 towards r + gamma (min Q'(s', a~) - c (a~ - a')^2), a~ = pi'(s') + clipped noise;
2. every second update, actor: down the mean of b (pi(s) - a)^2 - Q(s, pi(s)) / mean |Q(s, pi(s))|, Q = min(Q_1, Q_2), then the targets
   follow.

Its third hidden layer is omitted: the actor keeps the paper's shape. `anchor` says which a the actor stays near; see `_td3`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch

from ml.rl.algorithms._learner import Networks
from ml.rl.algorithms._td3 import Td3Config, Td3Learner
from ml.rl.configs import CriticConfig, setting
from ml.rl.kernels.batches import RewardScale, TransitionBatch


@dataclass(frozen=True, kw_only=True)
class RebracConfig(Td3Config):
    """Hyper-parameters of ReBRAC; `field_docs` says what each one means."""

    algorithm: ClassVar[str] = "rebrac"
    per_member: ClassVar[tuple[str, ...]] = (*CriticConfig.per_member, "actor_penalty", "critic_penalty", "anchor_amplitude")

    actor_penalty: float = setting(0.05, "b: price of the actor's squared distance from the logged action, in actions of [-1, 1].", low=0)
    critic_penalty: float = setting(
        0.01, "c: price of the next action's squared distance from the logged one in the critic's target.", low=0
    )


class RebracLearner(Td3Learner):
    """Actor, two normalised critics and the targets of all three."""

    config_type = RebracConfig
    normalised_critics = True

    def __init__(self, starts: Sequence[Networks], configs: Sequence[Any], scale: RewardScale, device: str = "cpu") -> None:
        super().__init__(starts, configs, scale, device)
        self._penalty, self._critic_penalty = self.member_setting("actor_penalty"), self.member_setting("critic_penalty")

    def update(self, batch: TransitionBatch) -> None:
        """Run one update, in the order of the module's text."""
        next_actions = self._smoothed_target_actions(batch)
        values = self._smaller_target_value(batch.next_critic_states, next_actions)
        values.sub_((next_actions - batch.next_actions).square_().mul_(batch.next_known).mul_(4.0 * self._critic_penalty))
        self._critic_steps(batch, values)
        if self._actors_turn:
            if self._warm:
                actions = self.policy_stack.act(batch.states)
                self._actor_step(batch, actions, self._penalty, *self._smaller_value_slope(batch.critic_states, actions))
            self._follow()
        self._count_update()

    def _smaller_value_slope(self, states: Any, actions: Any) -> tuple[Any, Any]:
        """Compute the slope by the action of min(Q_1, Q_2), and its value, both [K, B, 1]."""
        first, second = self.stacks["critic"], self.stacks["critic_2"]
        values = first.forward(states, actions).clone()
        slope = first.action_gradient(self._ones)
        others = second.forward(states, actions)
        slope = torch.where(others < values, second.action_gradient(self._ones), slope)
        return slope, torch.minimum(values, others)
