"""Differences to cDBS as a population of patients teaches them: structures corrected, with errors of their own size in every record.

How far a structure is to be believed depends on the record: on its noise, on how long doses were held, on whether structures agree with
each other and with what sessions of similar doses showed. That is learned from worlds with the distribution of the virtual population that
are in none of its parts (`ml.population.virtual.training_world`), whose truth is known: amortised inference in a hierarchical model
(Gershman and Goodman 2014), with the population as prior.

It guards itself. `constants.BELIEVED` of a correction is taken, and the interval holds the rest. A correction is 0 for a policy that does
what cDBS does. A record that lies outside what was learned from is believed the less the further it lies, and what structures say takes its
place, with `constants.FALLBACK`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ml.ope.posterior.constants import BELIEVED, FALLBACK, VERSION
from ml.ope.posterior.learned.evidence import UNITS, Evidence

Floats = NDArray[np.float64]

FILE = Path(__file__).with_name("constants.npz")
Q = len(UNITS)

NEAR_CDBS = 0.15
"""Root mean squared distance to cDBS over which a correction and its error come in."""
LEAST_ERROR = 0.02
"""Share of the error that stays at no distance."""
CUT = 3.0
"""Standardised numbers count no further than this."""
LOG_SD = (-4.0, 2.0)


@dataclass(frozen=True)
class Networks:
    """An ensemble of M networks with two layers of tanh units that correct differences.

    Attributes:
        names: of the numbers that go in, F. centre, spread: of them where it was learned, [F]. scale: of corrections, [4].
        layers: (weights [M, in, out], offsets [M, out]) of the three layers; the last gives 4 corrections and 4 log standard deviations.
        usual: how far outside a record that was learned from may lie (`outside`).
    """

    names: tuple[str, ...]
    centre: Floats
    spread: Floats
    scale: Floats
    layers: tuple[tuple[Floats, Floats], ...]
    usual: float

    def of(self, parts: Mapping[str, Floats], base: Floats) -> tuple[Floats, Floats]:
        """Mean and standard deviation [P, 4] of differences whose uncorrected values are [P, 4]."""
        distance = np.tanh(np.sqrt(parts["dose"] ** 2 + parts["moving"] ** 2) / NEAR_CDBS)[:, None]
        x = np.clip(self._standard(parts), -CUT, CUT)
        hidden = x[None]
        for weights, offsets in self.layers[:-1]:
            hidden = np.tanh(hidden @ weights + offsets[:, None])
        weights, offsets = self.layers[-1]
        out = hidden @ weights + offsets[:, None]
        means = base + distance * self.scale * out[..., :Q]
        sds = self.scale * np.exp(np.clip(out[..., Q:], *LOG_SD)) * (distance + LEAST_ERROR)
        return means.mean(0), np.sqrt((sds**2).mean(0) + means.var(0))

    def outside(self, parts: Mapping[str, Floats]) -> Floats:
        """How far outside each policy's numbers lie, [P]: mean of what standardised numbers are beyond `CUT`, each counted to 2."""
        return np.asarray(np.clip(np.abs(self._standard(parts)) - CUT, 0, 2).mean(1), dtype=np.float64)

    def _standard(self, parts: Mapping[str, Floats]) -> Floats:
        return (np.stack([parts[name] for name in self.names], axis=1) - self.centre) / self.spread


@dataclass(frozen=True)
class Learned:
    """All learned constants; quantities are in the order of `UNITS`.

    Attributes:
        networks: that correct. wider: factor on their errors. together: correlation of errors of the quantities, [4, 4].
        level_common, level_own: standard deviation of the error of the level under cDBS as a share of that of a mean over few days, and
            besides it, [4]. level_against: its correlation with the errors of differences, [4]: where cDBS is thought too good,
            everything else is thought too bad beside it.
    """

    version: int
    networks: Networks
    wider: Floats
    together: Floats
    level_common: Floats
    level_own: Floats
    level_against: Floats


@dataclass(frozen=True)
class Differences:
    """Differences of P policies to cDBS in `UNITS`: mean and standard deviation, [P, 4]; trust: share that is learned, [P]."""

    mean: Floats
    sd: Floats
    trust: Floats


def differences_of(evidence: Evidence, leverage: Floats, learned: Learned) -> Differences:
    """Learned differences as far as they can be trusted, and those of the structures besides; leverage [P]."""
    mean, sd = learned.networks.of(evidence.parts, evidence.expected)
    outside = learned.networks.outside(evidence.parts)
    trust = learned.networks.usual / np.maximum(outside, learned.networks.usual)
    share = trust[:, None] * evidence.known
    correction = mean - evidence.expected
    errors = np.stack([FALLBACK[name].variance(leverage) / unit**2 for name, unit in UNITS.items()], axis=1)
    own = (learned.wider * sd) ** 2 + BELIEVED * (1 - BELIEVED) * correction**2
    variance = share * own + (1 - share) * (evidence.spread**2 + errors)
    variance += share * (1 - share) * (BELIEVED * correction) ** 2
    variance[-1] = 0.0
    both = evidence.expected + share * BELIEVED * correction
    return Differences(both - both[-1], np.sqrt(variance), trust)


@lru_cache(maxsize=1)
def learned() -> Learned:
    """The constants that the project ships.

    Raises:
        ValueError: they are of another version than the code.
    """
    with np.load(FILE) as found:
        arrays = {name: found[name] for name in found.files}
    version = int(arrays["version"])
    if version != VERSION:
        raise ValueError(f"{FILE.name} has version {version} and the code {VERSION}: run python benchmarks/posterior_constants.py")
    own = {name: np.asarray(values, dtype=np.float64) for name, values in arrays.items() if name not in ("version", "names")}
    layers = tuple((own[f"weights_{k}"], own[f"offsets_{k}"]) for k in range(3))
    names = tuple(str(name) for name in arrays["names"])
    networks = Networks(names, own["centre"], own["spread"], own["scale"], layers, float(own["usual"]))
    rest = {name: own[name] for name in ("wider", "together", "level_common", "level_own", "level_against")}
    return Learned(version, networks, **rest)
