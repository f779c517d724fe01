"""Settings of a DLSM fit; the paper gives none of the sizes.

Sizes, training and objective were compared by held-out free-running prediction alone. `expert` is what a job's DLSM is: its features were
measured together on part A of the virtual population (docs/evaluation.md).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from ml.ope.registry import Size


@dataclass(frozen=True, kw_only=True)
class DlsmConfig:
    """Settings by which a DLSM is built, trained and rolled out.

    Attributes:
        latent, hidden, heads: size of z, units of both LSTMs, hidden layers of the heads.
        objective: `posterior` (Theorem 1), or its `sum` with free runs (Algorithm 1 to the letter).
        state_terms: `window` reconstructs every beta of s_t (paper), `newest` only the one that s_{t-1} does not hold.
        action_emission: heads of steps see a_{t-1} next to z_t, so that beta and reward answer to the action.
        end_features: outcomes from z_T (`final`, paper) or from z_T and the mean of z (`pooled`).
        start: roll-outs from `observed` s_0 through q(z_0 | s_0), or from the `prior` (paper).
        skip: a linear path from z_{t-1} and the inputs to the mean of z_t past the LSTM; without it z_t is drawn given h_t alone (paper).
        qoc_terms: the QoCs shape the latent state as r_end does; without it they are only read from it (paper).
        residual: the head of beta predicts what a linear one-step prediction from window and recent amplitudes leaves. It starts at zero.
            The untrained model is one of the checks.
        reward_terms: a Gaussian density of the reward in the objective (paper); without it the reward is the known one of sampled beta.
        free_bits: KL of a step that costs nothing, nats.
        overshoot: free runs of the objective start from posterior states at a multiple of so many steps, drawn again at every gradient
            step. At 0 they start from the first step alone.
        members: ensemble size, one seed each.
        steps: gradient steps at most. batch: sessions per step. learning_rate: of Adam, falling to a tenth along a half cosine.
        clip_norm: largest norm of the gradient. weight_decay: decoupled.
        check_every: steps between held-out checks; `patience`: checks without improvement before stopping.
        keep: the weights of the `best` held-out check, or of the `last` step, whatever the checks say (paper).
        held_out: share of the sessions that a member does not learn from.
        bootstrap: a member learns from as many sessions as there are, drawn with replacement; those not drawn are its held-out ones.
        dose_contrast: held-out checks also ask how beta moves with the dose within sessions.
        discard: leave out members whose answer to a lasting dose is null or wrong-signed against that within sessions.
        replay_draws: free runs per held-out session in a check.
        rollouts: trajectories per policy and member. block: trajectories advanced together.
        reward_source: step return from the learnt reward `head`, from the `known` reward on sampled beta, or whichever predicts
            `held_out` sessions better.
        end_source: r_end and QoCs from the `latent` state (paper), or from the `summaries` of its minutes as in other methods
            (`ml.ope.outcomes`). `held_out`: whichever predicts r_end of held-out sessions better.
        decode_all_window: draw all W betas of s_t again instead of shifting the window (paper; needs `window`).
        seed: first seed.

    Raises:
        ValueError: a value outside its range; the message names it.
    """

    latent: int = 8
    hidden: int = 24
    heads: tuple[int, ...] = (24,)
    objective: Literal["posterior", "sum"] = "sum"
    state_terms: Literal["window", "newest"] = "newest"
    action_emission: bool = True
    end_features: Literal["final", "pooled"] = "pooled"
    start: Literal["observed", "prior"] = "observed"
    skip: bool = True
    qoc_terms: bool = True
    residual: bool = False
    reward_terms: bool = True
    free_bits: float = 0.0
    overshoot: int = 0
    members: int = 5
    steps: int = 150
    batch: int = 32
    learning_rate: float = 6e-3
    clip_norm: float = 1.0
    weight_decay: float = 1e-3
    check_every: int = 25
    patience: int = 4
    keep: Literal["best", "last"] = "best"
    held_out: float = 0.2
    bootstrap: bool = False
    dose_contrast: bool = False
    discard: bool = False
    replay_draws: int = 16
    rollouts: int = 256
    block: int = 1024
    reward_source: Literal["head", "known", "held_out"] = "held_out"
    end_source: Literal["latent", "summaries", "held_out"] = "held_out"
    decode_all_window: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("latent", "hidden", "members", "steps", "batch", "check_every", "patience", "replay_draws", "rollouts", "block"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} of a DLSM must be at least 1, not {getattr(self, name)}")
        for name in ("learning_rate", "clip_norm"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} of a DLSM must be above 0, not {getattr(self, name)}")
        if not 0 < self.held_out < 1:
            raise ValueError(f"held_out must be a share between 0 and 1, not {self.held_out}")
        if self.free_bits < 0 or self.overshoot < 0:
            raise ValueError(f"free_bits and overshoot of a DLSM must be at least 0, not {self.free_bits} and {self.overshoot}")
        if self.residual and self.state_terms != "newest":
            raise ValueError("residual needs state_terms='newest': the linear part predicts the newest beta alone")
        if not self.reward_terms and self.reward_source == "head":
            raise ValueError("reward_source='head' needs reward_terms: without them no reward head is learnt")
        if self.decode_all_window and self.state_terms != "window":
            raise ValueError("decode_all_window needs state_terms='window': a head of the newest beta cannot draw the others")

    @classmethod
    def demo(cls, seed: int = 0) -> DlsmConfig:
        """Give settings that are small and quick: about twenty sessions of 300 steps in well under a minute of one core."""
        return cls(members=2, rollouts=128, seed=seed)

    @classmethod
    def of_size(cls, size: Size, seed: int = 0) -> DlsmConfig:
        """Give the settings of a size of `ml.ope.registry`."""
        return cls.demo(seed) if size == "demo" else cls(seed=seed)

    @classmethod
    def expert(cls, size: Size = "full", seed: int = 0) -> DlsmConfig:
        """Give the settings of a job's DLSM, with every feature."""
        return replace(
            cls.of_size(size, seed),
            residual=True,
            reward_terms=False,
            learning_rate=2e-3,
            overshoot=60,
            free_bits=0.1,
            bootstrap=True,
            dose_contrast=True,
            discard=True,
        )

    @classmethod
    def paper(cls, size: Size = "full", seed: int = 0) -> DlsmConfig:
        """Give the plain form: theorem 5.1 as the objective, eq:encoder and eq:decoder without additions, roll-outs by the decoder alone.

        Every roll-out starts from z_0 ~ N(0, I), draws all of s_t from z_t, takes rewards from the reward head and r_end from z_T;
        training runs to its last step. Sizes and rates, of which the paper says nothing, are those of `of_size`.
        """
        return replace(
            cls.of_size(size, seed),
            objective="posterior",
            state_terms="window",
            action_emission=False,
            end_features="final",
            start="prior",
            skip=False,
            qoc_terms=False,
            weight_decay=0.0,
            keep="last",
            reward_source="head",
            end_source="latent",
            decode_all_window=True,
        )

    def to_json(self) -> dict[str, Any]:
        """Return all settings, by name."""
        return asdict(self)
