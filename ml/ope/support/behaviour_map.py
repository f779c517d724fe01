"""Map of policies: their amplitude by level of beta, and where sessions have ever been. It is the data of one picture, small enough to be
stored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.ope.fqe.steps import usable_steps
from ml.policies.policy import Policy
from ml.trajectories import ReplayBuffer

COLUMNS = 24
"""Columns of beta, of equal width over the middle 98 % of the recorded windows; windows outside count in the outermost two."""

DOSES = 20
"""Rows of amplitude, 5 % of cDBS each."""

FEWEST = 5
"""Fewest windows of a column; one with fewer stays empty."""


@dataclass(frozen=True)
class Curve:
    """Amplitudes that a policy asks for, by column of beta, fractions of cDBS; None where a column has too few windows.

    Attributes:
        middle: median over the recorded windows of the column. low, high: 10th and 90th percentile.
    """

    middle: tuple[float | None, ...]
    low: tuple[float | None, ...]
    high: tuple[float | None, ...]


@dataclass(frozen=True)
class BehaviourMap:
    """Policies over the cloud of amplitudes that sessions had.

    Attributes:
        edges: of the columns, mean beta of a window, in its unit, [COLUMNS + 1].
        tried: recorded steps by column and row of amplitude, [COLUMNS][DOSES]; row i holds the fractions from i / DOSES on.
        policies: by name.
        apart: mean absolute difference of the amplitudes of two policies over the recorded windows, fraction of cDBS. Each pair is there
            once, under the name that comes first.
    """

    edges: tuple[float, ...]
    tried: tuple[tuple[int, ...], ...]
    policies: dict[str, Curve]
    apart: dict[str, dict[str, float]]

    def distance(self, one: str, other: str) -> float | None:
        """Measure how far two policies are apart, fraction of cDBS, as `apart` has it; None where one of them is not in the map."""
        found = self.apart.get(one, {}).get(other)
        return found if found is not None else self.apart.get(other, {}).get(one)

    def to_json(self) -> dict[str, Any]:
        """Convert the map to its stored form, which `from_json` reads."""
        return asdict(self)

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> BehaviourMap:
        """Read a stored map."""
        curves = {name: Curve(*(tuple(c[member]) for member in ("middle", "low", "high"))) for name, c in stored["policies"].items()}
        tried = tuple(tuple(column) for column in stored["tried"])
        return cls(tuple(stored["edges"]), tried, curves, {name: dict(to) for name, to in stored["apart"].items()})


def behaviour_map(buffer: ReplayBuffer, policies: Mapping[str, Policy]) -> BehaviourMap:
    """Compute what each policy does on the recorded windows, by their mean beta. Raises ValueError where the buffer has no usable step.

    Args:
        buffer: of the recorded sessions. policies: by name.
    """
    table = usable_steps(buffer)
    levels = table.states.mean(1)
    low, high = np.quantile(levels, [0.01, 0.99])
    if high <= low:
        low, high = low - 0.5, high + 0.5
    edges = np.linspace(low, high, COLUMNS + 1)
    column = np.clip(np.searchsorted(edges, levels, "right") - 1, 0, COLUMNS - 1)
    dose = np.clip((table.actions * DOSES + 1e-9).astype(np.int64), 0, DOSES - 1)
    tried = np.zeros((COLUMNS, DOSES), dtype=np.int64)
    np.add.at(tried, (column, dose), 1)
    asked = {name: np.clip(policy.act(table.states), 0.0, 1.0) for name, policy in policies.items()}
    curves = {name: _curve(actions, column) for name, actions in asked.items()}
    return BehaviourMap(tuple(map(float, edges)), tuple(tuple(map(int, row)) for row in tried), curves, _apart(asked))


def _apart(asked: Mapping[str, NDArray[np.float64]]) -> dict[str, dict[str, float]]:
    names = list(asked)
    table = np.stack([asked[name] for name in names]) if names else np.zeros((0, 0))
    found: dict[str, dict[str, float]] = {}
    for k, name in enumerate(names[:-1]):
        gaps = np.abs(table[k + 1 :] - table[k]).mean(1)
        found[name] = {other: round(float(gap), 4) for other, gap in zip(names[k + 1 :], gaps, strict=True)}
    return found


def _curve(actions: NDArray[np.float64], column: NDArray[np.int64]) -> Curve:
    found: list[tuple[float | None, ...]] = []
    for k in range(COLUMNS):
        own = actions[column == k]
        found.append(tuple(float(q) for q in np.quantile(own, [0.5, 0.1, 0.9])) if own.size >= FEWEST else (None, None, None))
    middle, low, high = zip(*found, strict=True)
    return Curve(middle, low, high)
