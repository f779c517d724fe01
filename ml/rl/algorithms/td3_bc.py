"""TD3 with behaviour cloning (TD3+BC): an actor that climbs the critic and stays near an amplitude. Source: Fujimoto and Gu 2021.

One update on a batch (s, a, r, s'):

1. critics: least squares of Q_1, Q_2 towards r + gamma min Q'(s', a~), a~ = pi'(s') + clipped noise;
2. every second update, actor: down the mean of (pi(s) - a)^2 / alpha - Q_1(s, pi(s)) / mean |Q_1(s, pi(s))|, then the targets follow.

`anchor` says which a the actor stays near; see `_td3`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from ml.rl.algorithms._learner import Networks
from ml.rl.algorithms._td3 import Td3Config, Td3Learner
from ml.rl.configs import CriticConfig, setting
from ml.rl.kernels.batches import RewardScale, TransitionBatch


@dataclass(frozen=True, kw_only=True)
class Td3BcConfig(Td3Config):
    """Hyper-parameters of TD3+BC; `field_docs` says what each one means."""

    algorithm: ClassVar[str] = "td3_bc"
    per_member: ClassVar[tuple[str, ...]] = (*CriticConfig.per_member, "alpha", "anchor_amplitude")

    alpha: float = setting(2.5, "Weight of the value against staying near the logged actions; larger trusts the critic more.", above=0)


class Td3BcLearner(Td3Learner):
    """Actor, two critics and the targets of all three."""

    config_type = Td3BcConfig

    def __init__(self, starts: Sequence[Networks], configs: Sequence[Any], scale: RewardScale, device: str = "cpu") -> None:
        super().__init__(starts, configs, scale, device)
        self._penalty = 1.0 / self.member_setting("alpha")

    def update(self, batch: TransitionBatch) -> None:
        """Run one update, in the order of the module's text."""
        self._critic_steps(batch, self._smaller_target_value(batch.next_critic_states, self._smoothed_target_actions(batch)))
        if self._actors_turn:
            if self._warm:
                actions = self.policy_stack.act(batch.states)
                critic = self.stacks["critic"]
                values = critic.forward(batch.critic_states, actions).clone()
                self._actor_step(batch, actions, self._penalty, critic.action_gradient(self._ones), values)
            self._follow()
        self._count_update()
