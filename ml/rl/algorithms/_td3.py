"""Common part of TD3+BC and ReBRAC: two critics, smoothed target actions, a delayed actor that stays near an amplitude.

Source: Fujimoto et al. 2018 (TD3). Actions in penalties and noise are 2a - 1 in [-1, 1], so that published coefficients keep their
meaning; rewards are scaled to returns of deviation 1.

Ours: with `anchor: constant` the actor's a is a constant amplitude instead of the logged one; the default is 1, the participant's cDBS.
Logged amplitudes of the random controller are draws without a preference: they pull to the middle of [B, 1], away from the standard of
care. An actor near cDBS instead departs from it where the critic shows a gain, in proportion to that gain. The critic's penalty stays with
the logged actions: it is about where values are known, not about what is good.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch

from ml.rl.algorithms._learner import CriticLearner, Networks, fresh_critic
from ml.rl.configs import CriticConfig, setting
from ml.rl.kernels.batches import RewardScale, TransitionBatch
from ml.rl.kernels.networks import MlpPolicy

ANCHORS = ("logged", "constant")

_TINY = 1e-6  # keeps the actor's step finite where every value is 0


@dataclass(frozen=True, kw_only=True)
class Td3Config(CriticConfig):
    """Hyper-parameters of both."""

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


class Td3Learner(CriticLearner[Any]):
    """Actor, two critics, the targets of all three, and the pieces that both updates are made of."""

    targets = ("policy", "critic", "critic_2")
    uses_noise = True
    normalised_critics: ClassVar[bool] = False

    def __init__(self, starts: Sequence[Networks], configs: Sequence[Any], scale: RewardScale, device: str = "cpu") -> None:
        super().__init__(starts, configs, scale, device)
        self._ones = torch.ones((self.members, self.config.batch, 1), device=device)

    @classmethod
    def networks(cls, config: Any, policy: MlpPolicy, seeds: Sequence[int]) -> dict[str, Any]:
        norm = cls.normalised_critics
        return {"policy": policy} | {
            name: fresh_critic(config, policy, seed, layer_norm=norm) for name, seed in zip(("critic", "critic_2"), seeds, strict=False)
        }

    @property
    def _actors_turn(self) -> bool:
        return bool(self._updates % self.config.actor_every == 0)

    def _smoothed_target_actions(self, batch: TransitionBatch) -> Any:
        """Compute a~ = pi'(s') + clipped noise, [K, B, 1]."""
        c = self.config
        # Noise in [-1, 1] units is half as large on [0, 1].
        noise = torch.clamp(batch.noise * c.smoothing, -c.smoothing_clip, c.smoothing_clip).mul_(0.5)
        return self.target_actor.act(batch.next_states).add_(noise).clamp_(0.0, 1.0)

    def _smaller_target_value(self, states: Any, actions: Any) -> Any:
        """Compute min Q'(s', a~), [K, B, 1]."""
        values = self.target_stacks["critic"].forward(states, actions).clone()
        return torch.minimum(values, self.target_stacks["critic_2"].forward(states, actions))

    def _critic_steps(self, batch: TransitionBatch, next_values: Any) -> None:
        """Move both critics towards r + gamma times the next values."""
        targets = torch.add(batch.rewards, next_values, alpha=self.scale.gamma)
        for name in ("critic", "critic_2"):
            self._descend_on_target(name, batch, targets)

    def _actor_step(self, batch: TransitionBatch, actions: Any, penalty: Any, uphill: Any, values: Any) -> None:
        """Move the actor down the mean of b (pi(s) - a)^2 - Q / mean |Q|. `uphill` is the slope of Q by the action; `values` is
        overwritten."""
        size = values.abs_().mean(dim=(1, 2), keepdim=True)
        anchor = batch.actions if self.config.anchor == "logged" else self.member_setting("anchor_amplitude")
        # b (2 pi - 2 a)^2 - Q / mean |Q|, its slope by pi averaged over the batch; mean |Q| counts as a constant.
        slope = (8.0 * penalty) * (actions - anchor) - uphill / size.clamp_(min=_TINY)
        self.policy_stack.backward_from_actions(slope.div_(self.config.batch), actions)
        self.adams["policy"].step()
