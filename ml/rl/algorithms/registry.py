"""Every learning algorithm by name, as a table that loads none of them: pages, jobs and tests go over it alike.

A new algorithm is a file here with its configuration and learner, and one record in `_TABLE`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from ml.rl.algorithms._learner import StackedLearner


@dataclass(frozen=True)
class Algorithm:
    """One algorithm.

    Attributes:
        name: its key, as stored with every policy. title: its name for people.
        summary: one sentence on what it does with logged data. source: where it was published.
        implementation: its learner, as `module:class`; imported when it is first asked for.
    """

    name: str
    title: str
    summary: str
    source: str
    implementation: str

    @property
    def learner(self) -> type[StackedLearner[Any]]:
        """Its gradient steps; loads torch."""
        module, _, name = self.implementation.partition(":")
        learner: type[StackedLearner[Any]] = getattr(import_module(module), name)
        return learner

    @property
    def config(self) -> type[Any]:
        """Its hyper-parameters: a frozen dataclass with `to_json`, `from_json` and `field_docs`."""
        return self.learner.config_type


_TABLE = (
    Algorithm(
        "ddpg",
        "DDPG",
        "Climbs the critic without a bond to the logged actions, as in the paper; with little data its values climb too.",
        "Lillicrap et al. 2016; Gao et al. 2023",
        "ml.rl.algorithms.ddpg:DdpgLearner",
    ),
    Algorithm(
        "td3_bc",
        "TD3+BC",
        "Two critics, the smaller one counts; the actor is held near the logged actions.",
        "Fujimoto and Gu 2021",
        "ml.rl.algorithms.td3_bc:Td3BcLearner",
    ),
    Algorithm(
        "rebrac",
        "ReBRAC",
        "As TD3+BC, with penalties in actor and critic apart and normalised critics.",
        "Tarasov et al. 2023",
        "ml.rl.algorithms.rebrac:RebracLearner",
    ),
    Algorithm(
        "iql",
        "IQL",
        "Never asks for the value of an action that was not logged; imitates the better logged actions.",
        "Kostrikov et al. 2022",
        "ml.rl.algorithms.iql:IqlLearner",
    ),
    Algorithm(
        "cloning",
        "Behaviour cloning",
        "Imitates the logged amplitudes and knows no rewards: what the others have to beat.",
        "Pomerleau 1989",
        "ml.rl.algorithms.bc:CloningLearner",
    ),
)
ALGORITHMS: Final[Mapping[str, Algorithm]] = MappingProxyType({item.name: item for item in _TABLE})


def algorithm(name: str) -> Algorithm:
    """An algorithm by name. Raises ValueError for a name that is none."""
    if name not in ALGORITHMS:
        raise ValueError(f"there is no algorithm {name!r}; there are {', '.join(ALGORITHMS)}")
    return ALGORITHMS[name]
