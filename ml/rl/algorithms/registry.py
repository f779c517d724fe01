"""Every learning algorithm by name: its hyper-parameters and its trainer, so that pages, jobs and tests go over them alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from ml.progress import Report, silent
from ml.rl.algorithms.cloning import CloningLearner
from ml.rl.algorithms.constrained import RebracLearner, Td3BcLearner
from ml.rl.algorithms.ddpg import DdpgLearner
from ml.rl.algorithms.iql import IqlLearner
from ml.rl.algorithms.learners import StackedLearner
from ml.rl.configs import TrainConfig
from ml.rl.held_out import HeldOut
from ml.rl.trainer import Start, TrainedPolicy, train_members
from ml.trajectories import ReplayBuffer


@dataclass(frozen=True)
class Algorithm:
    """One algorithm.

    Attributes:
        title: its name for people. summary: one sentence on what it does with logged data.
        source: where it was published. learner: its gradient steps.
    """

    title: str
    summary: str
    source: str
    learner: type[StackedLearner[Any]]

    @property
    def name(self) -> str:
        """Its key in `ALGORITHMS`."""
        return self.config.algorithm

    @property
    def config(self) -> type[TrainConfig]:
        """Its hyper-parameters: a frozen dataclass with `to_json`, `from_json` and `field_docs`."""
        return self.learner.config_type

    def train(
        self,
        buffer: ReplayBuffer,
        config: TrainConfig,
        report: Report = silent,
        checkpoint: Path | None = None,
        initial: Start = None,
        held_out: HeldOut | None = None,
    ) -> TrainedPolicy:
        """Train one policy; arguments and errors as in `ml.rl.trainer.train_members`."""
        return self.train_many(buffer, [config], report, checkpoint, initial, held_out)[0]

    def train_many(
        self,
        buffer: ReplayBuffer,
        configs: Sequence[TrainConfig],
        report: Report = silent,
        checkpoint: Path | None = None,
        initial: Start = None,
        held_out: HeldOut | None = None,
    ) -> list[TrainedPolicy]:
        """Train K policies side by side; arguments and errors as in `ml.rl.trainer.train_members`."""
        return train_members(self.learner, buffer, configs, report, checkpoint, initial, held_out)


_ALL = (
    Algorithm(
        "DDPG",
        "Climbs the critic without a bond to the logged actions, as in the paper; with little data its values climb too.",
        "Lillicrap et al. 2016; Gao et al. 2023",
        DdpgLearner,
    ),
    Algorithm(
        "TD3+BC", "Two critics, the smaller one counts; the actor is held near the logged actions.", "Fujimoto and Gu 2021", Td3BcLearner
    ),
    Algorithm(
        "ReBRAC", "As TD3+BC, with penalties in actor and critic apart and normalised critics.", "Tarasov et al. 2023", RebracLearner
    ),
    Algorithm(
        "IQL",
        "Never asks for the value of an action that was not logged; imitates the better logged actions.",
        "Kostrikov et al. 2022",
        IqlLearner,
    ),
    Algorithm("Behaviour cloning", "Imitates the logged amplitudes and knows no rewards: a yardstick.", "Pomerleau 1989", CloningLearner),
)
ALGORITHMS: Final[Mapping[str, Algorithm]] = MappingProxyType({item.name: item for item in _ALL})


def algorithm(name: str) -> Algorithm:
    """An algorithm by name. Raises ValueError for a name that is none."""
    if name not in ALGORITHMS:
        raise ValueError(f"there is no algorithm {name!r}; there are {', '.join(ALGORITHMS)}")
    return ALGORITHMS[name]
