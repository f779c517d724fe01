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
        implementation: its learner, as `module:class`; imported when it is first asked for.
    """

    name: str
    title: str
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
    Algorithm("ddpg", "DDPG", "ml.rl.algorithms.ddpg:DdpgLearner"),
    Algorithm("td3_bc", "TD3+BC", "ml.rl.algorithms.td3_bc:Td3BcLearner"),
    Algorithm("rebrac", "ReBRAC", "ml.rl.algorithms.rebrac:RebracLearner"),
    Algorithm("iql", "IQL", "ml.rl.algorithms.iql:IqlLearner"),
    Algorithm("cloning", "behaviour cloning", "ml.rl.algorithms.bc:CloningLearner"),
)
ALGORITHMS: Final[Mapping[str, Algorithm]] = MappingProxyType({item.name: item for item in _TABLE})


def algorithm(name: str) -> Algorithm:
    """Find an algorithm by name. Raises ValueError for an unknown name."""
    if name not in ALGORITHMS:
        raise ValueError(f"there is no algorithm {name!r}; there are {', '.join(ALGORITHMS)}")
    return ALGORITHMS[name]
