"""Hyper-parameters that every training has, and how a configuration describes and checks itself."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields
from typing import Any, ClassVar, Self

import torch

from ml.rl.kernels.networks import TEACHER_HIDDEN

DEVICES = ("auto", "cpu", "cuda")
AIMS = ("steps", "return")


def setting(default: Any, doc: str, *, low: float | None = None, above: float | None = None, high: float = math.inf) -> Any:
    """Declare a hyper-parameter: its default, its meaning, and its range (`low` is part of it, `above` is not, `high` is)."""
    return field(default=default, metadata={"doc": doc, "low": low, "above": above, "high": high})


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Hyper-parameters of one training; with the data and the start they settle the result. `field_docs` says what each one means.

    Raises:
        ValueError: a value outside its range; the message names it.
    """

    algorithm: ClassVar[str] = ""
    per_member: ClassVar[tuple[str, ...]] = ("actor_lr", "seed")
    """Hyper-parameters that may differ between policies trained side by side."""

    actor_lr: float = setting(
        1e-4, "Adam's learning rate of the policy. The paper: 1e-5 to 1e-3 from scratch, 1e-7 to 1e-5 for fine-tuning.", above=0, high=1
    )
    batch: int = setting(64, "Transitions per update (Lillicrap's 64).", low=1)
    updates: int = setting(10_000, "Gradient steps.", low=1)
    hidden: tuple[int, ...] = field(
        default=TEACHER_HIDDEN,
        metadata={"doc": "Units of the hidden layers of all networks (the paper's 400 and 300); two layers or more."},
    )
    seed: int = setting(0, "Seed of the initial weights, the batches and the noise.", low=0)
    record_every: int = setting(100, "Updates between two points of the learning curves.", low=1)
    checkpoint_every: int = setting(1000, "Updates between two checkpoints.", low=1)
    aim: str = field(
        default="steps",
        metadata={
            "doc": "What the critics sum: `steps`, the step rewards (the paper's remark 1), or `return`, each step's share of r_end "
            "besides, where enough sessions have one and the model of outcomes predicts it (`ml.rl.end_reward`)."
        },
    )
    device: str = field(default="cpu", metadata={"doc": "`cpu`, `cuda`, or `auto`: CUDA where there is one."})

    def __post_init__(self) -> None:
        for name, described in self.__dataclass_fields__.items():
            if "high" in described.metadata:
                _check_range(name, getattr(self, name), described.metadata)
        if len(self.hidden) < 2 or min(self.hidden) < 1:
            raise ValueError(f"hidden must name two layers or more, each of 1 unit or more, not {self.hidden}")
        if self.aim not in AIMS:
            raise ValueError(f"aim must be one of {', '.join(AIMS)}, not {self.aim!r}")
        if self.device not in DEVICES:
            raise ValueError(f"device must be one of {', '.join(DEVICES)}, not {self.device!r}")

    @classmethod
    def field_docs(cls) -> dict[str, str]:
        """Return the meaning of each hyper-parameter, by name."""
        return {described.name: described.metadata["doc"] for described in fields(cls)}

    def to_json(self) -> dict[str, Any]:
        """Return all hyper-parameters, by name."""
        return asdict(self) | {"hidden": list(self.hidden)}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Self:
        """Read what `to_json` wrote; missing names take their default. Raises ValueError for an unknown name."""
        known = cls.__dataclass_fields__
        unknown = sorted(set(values) - {described.name for described in fields(cls)})
        if unknown:
            raise ValueError(f"{cls.algorithm} has no hyper-parameter {', '.join(unknown)}; it has {', '.join(known)}")
        return cls(**(values | ({"hidden": tuple(values["hidden"])} if "hidden" in values else {})))

    def resolved_device(self) -> str:
        """Choose `cpu` or `cuda`. Raises ValueError when CUDA is requested and there is none."""
        if self.device == "auto":
            return "cuda" if torch.cuda.is_available() else "cpu"
        if self.device == "cuda" and not torch.cuda.is_available():
            raise ValueError("device is cuda, and this machine has no CUDA device; use auto or cpu")
        return self.device


@dataclass(frozen=True, kw_only=True)
class CriticConfig(TrainConfig):
    """Hyper-parameters of algorithms with a critic and targets."""

    per_member: ClassVar[tuple[str, ...]] = ("actor_lr", "critic_lr", "seed")

    critic_lr: float = setting(1e-3, "Adam's learning rate of the critics (Lillicrap's 1e-3).", above=0, high=1)
    tau: float = setting(
        5e-3,
        "Share of the online weights that the targets take per update. Lillicrap's 1e-3 needs some 1e5 updates at gamma 0.99.",
        above=0,
        high=1,
    )
    critic_weight_decay: float = setting(
        0.0,
        "L2 penalty on the critics' weights inside Adam's gradient. Lillicrap has 1e-2; ours is 0: on simulated sessions that penalty left "
        "four times the temporal-difference error.",
        low=0,
    )
    critic_warmup: int = setting(
        0,
        "Updates during which only the critics learn: a policy fine-tuned without its critic is evaluated before it is changed.",
        low=0,
    )
    critic_memory: bool = field(
        default=False,
        metadata={
            "doc": "Whether the critics see means of past amplitudes besides the beta window (`ml.rl.memory`); the policy never does."
        },
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.critic_warmup > self.updates:
            raise ValueError(f"critic_warmup must lie between 0 and updates ({self.updates}), not {self.critic_warmup}")


def _check_range(name: str, value: Any, bounds: Any) -> None:
    low, above, high = bounds["low"], bounds["above"], bounds["high"]
    if math.isfinite(value) and (low is None or value >= low) and (above is None or value > above) and value <= high:
        return
    lower = f"{low:g} or more" if above is None else f"above {above:g}"
    upper = "" if high == math.inf else f" and at most {high:g}"
    raise ValueError(f"{name} must be {lower}{upper}, not {value}")
