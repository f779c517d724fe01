"""Actor-critics held near the logged actions: TD3+BC and ReBRAC. Ours beside the paper's DDPG.

Sources: Fujimoto et al. 2018 (TD3: two critics, smoothed target actions, delayed actor), Fujimoto and Gu 2021 (TD3+BC), Tarasov et al. 2023
(ReBRAC: penalties in actor and critic apart, layer normalisation in the critic).

One update on a batch (s, a, r, s', a'), where a' is the action logged after a:

1. critics: least squares of Q_1, Q_2 towards r + gamma (min Q'(s', a~) - c (a~ - a')^2), a~ = pi'(s') + clipped noise;
2. every second update, actor: down the mean of b (pi(s) - a)^2 - Q(s, pi(s)) / mean |Q(s, pi(s))|, then the targets follow.

TD3+BC has c = 0, b = 1 / alpha, Q = Q_1 and plain critics; ReBRAC has c and b of their own, Q = min(Q_1, Q_2) and normalised critics.
Actions in penalties and noise are 2a - 1 in [-1, 1], so that published coefficients keep their meaning; rewards are scaled to returns of
deviation 1. ReBRAC's third hidden layer is left out: the actor keeps the paper's shape.

Ours: with `anchor: constant` the actor's a is a constant amplitude, by default 1, the participant's cDBS, instead of the logged one. Logged
amplitudes of the random controller are draws that nobody prefers: their pull is one to the middle of [B, 1], away from the standard of
care. Held near cDBS instead, the policy departs from it where the critic says so, in proportion to what it says. The critic's penalty
stays with the logged actions: it is about where values are known, not about what is good.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch

from ml.rl.algorithms.learners import CriticLearner, Networks, fresh_critic
from ml.rl.batches import Batch, RewardScale
from ml.rl.configs import CriticConfig, setting
from ml.rl.networks import MlpPolicy

ANCHORS = ("logged", "constant")

_TINY = 1e-6  # keeps the actor's step finite where every value is 0


@dataclass(frozen=True, kw_only=True)
class _Td3Config(CriticConfig):
    smoothing: float = setting(0.2, "Standard deviation of the noise on target actions, in actions of [-1, 1].", low=0, high=2)
    smoothing_clip: float = setting(0.5, "Largest such noise.", low=0, high=2)
    actor_every: int = setting(2, "Critic updates per update of the actor and the targets.", low=1)
    anchor: str = field(
        default="logged",
        metadata={
            "doc": "What the actor is held near: `logged`, the logged action (the publications'), or `constant`, `anchor_amplitude` in "
            "every state, so that the policy leaves the standard of care only where the values speak for it (ours)."
        },
    )
    anchor_amplitude: float = setting(
        1.0, "Amplitude fraction that a `constant` anchor holds the actor near; 1 is cDBS, the standard of care.", low=0, high=1
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.anchor not in ANCHORS:
            raise ValueError(f"anchor must be one of {', '.join(ANCHORS)}, not {self.anchor!r}")


@dataclass(frozen=True, kw_only=True)
class Td3BcConfig(_Td3Config):
    """Hyper-parameters of TD3+BC; `field_docs` says what each one means."""

    algorithm: ClassVar[str] = "td3_bc"
    per_member: ClassVar[tuple[str, ...]] = (*CriticConfig.per_member, "alpha", "anchor_amplitude")

    alpha: float = setting(2.5, "Weight of the value against staying near the logged actions; larger trusts the critic more.", above=0)


@dataclass(frozen=True, kw_only=True)
class RebracConfig(_Td3Config):
    """Hyper-parameters of ReBRAC; `field_docs` says what each one means."""

    algorithm: ClassVar[str] = "rebrac"
    per_member: ClassVar[tuple[str, ...]] = (*CriticConfig.per_member, "actor_penalty", "critic_penalty", "anchor_amplitude")

    actor_penalty: float = setting(0.05, "b: price of the actor's squared distance from the logged action, in actions of [-1, 1].", low=0)
    critic_penalty: float = setting(
        0.01, "c: price of the next action's squared distance from the logged one in the critic's target.", low=0
    )


class _Td3Learner(CriticLearner[Any]):
    """What both share."""

    targets = ("policy", "critic", "critic_2")
    uses_noise = True
    constrains_critic: ClassVar[bool]
    """ReBRAC's side of the differences: layer normalisation, the critic's penalty, and the smaller value for the actor."""

    def __init__(self, starts: Sequence[Networks], configs: Sequence[Any], scale: RewardScale, device: str = "cpu") -> None:
        super().__init__(starts, configs, scale, device)
        if self.constrains_critic:
            self._actor_penalty, self._critic_penalty = self.member_setting("actor_penalty"), self.member_setting("critic_penalty")
        else:
            self._actor_penalty = 1.0 / self.member_setting("alpha")
        self._ones = torch.ones((self.members, self.config.batch, 1), device=device)

    @classmethod
    def networks(cls, config: Any, policy: MlpPolicy, seeds: Sequence[int]) -> dict[str, Any]:
        norm = cls.constrains_critic
        return {"policy": policy} | {
            name: fresh_critic(config, policy, seed, layer_norm=norm) for name, seed in zip(("critic", "critic_2"), seeds, strict=False)
        }

    def update(self, batch: Batch) -> None:
        """One update, in the order of the module's text."""
        targets = self._targets(batch)
        for name in ("critic", "critic_2"):
            self._descend_on_target(name, batch, targets)
        if self._updates % self.config.actor_every == 0:
            if self._warm:
                self._actor_step(batch)
            self._follow()
        self._counted()

    def _targets(self, batch: Batch) -> Any:
        c = self.config
        # Noise in [-1, 1] units is half as large on [0, 1].
        noise = torch.clamp(batch.noise * c.smoothing, -c.smoothing_clip, c.smoothing_clip).mul_(0.5)
        actions = self.target_actor.act(batch.next_states).add_(noise).clamp_(0.0, 1.0)
        values = self.target_stacks["critic"].forward(batch.next_states, actions).clone()
        values = torch.minimum(values, self.target_stacks["critic_2"].forward(batch.next_states, actions))
        if self.constrains_critic:
            values.sub_((actions - batch.next_actions).square_().mul_(batch.next_known).mul_(4.0 * self._critic_penalty))
        return torch.add(batch.rewards, values, alpha=self.scale.gamma)

    def _actor_step(self, batch: Batch) -> None:
        actions = self.policy_stack.act(batch.states)
        uphill, size = self._value_slope(batch.states, actions)
        anchor = batch.actions if self.config.anchor == "logged" else self.member_setting("anchor_amplitude")
        # b (2 pi - 2 a)^2 - Q / mean |Q|, its slope by pi averaged over the batch; mean |Q| counts as a constant.
        slope = (8.0 * self._actor_penalty) * (actions - anchor) - uphill / size.clamp_(min=_TINY)
        self.policy_stack.backward_from_actions(slope.div_(self.config.batch), actions)
        self.adams["policy"].step()

    def _value_slope(self, states: Any, actions: Any) -> tuple[Any, Any]:
        """Slope by the action of the value that the actor climbs, [K, B, 1], and its mean absolute value [K, 1, 1]."""
        first = self.stacks["critic"]
        values = first.forward(states, actions).clone()
        slope = first.action_gradient(self._ones)
        if self.constrains_critic:
            second = self.stacks["critic_2"]
            others = second.forward(states, actions)
            slope = torch.where(others < values, second.action_gradient(self._ones), slope)
            values = torch.minimum(values, others)
        return slope, values.abs_().mean(dim=(1, 2), keepdim=True)


class Td3BcLearner(_Td3Learner):
    """TD3 with behaviour cloning in the actor's loss."""

    config_type = Td3BcConfig
    constrains_critic = False


class RebracLearner(_Td3Learner):
    """TD3 with behaviour penalties in both losses and normalised critics."""

    config_type = RebracConfig
    constrains_critic = True
