"""Known faults of converters, each as the answers that it would give. A fault is named where it explains the answers.

Sources: docs/results/ports.md, which measures each with its version.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.deploy.ports.windows import Act, Windows
from ml.deploy.runtime.network import MlpNetwork, Output

EXPLAINED = 0.8
"""Share of windows that a fault must reproduce to be named, and by half of what is left more than the policy itself does."""
NEAR = 0.02
"""An answer this near, amplitude fraction, is reproduced: int8 copies are that coarse."""
_DECIMALS = range(3, 9)
_POWERS = range(2, 24)


@dataclass(frozen=True)
class Explanation:
    """One known fault with the answers that it would give, [N]. `code` and `value` as in `check.Fault`."""

    code: str
    value: float | str
    answers: NDArray[np.float64]


def explain(answers: NDArray[np.float64], windows: Windows, act: Act, network: MlpNetwork | None, cdbs_ma: float) -> Explanation | None:
    """Find the known fault that reproduces the answers best.

    Args:
        answers: [N], NaN where there is none. windows: complete ones, [N, W]. act: the policy.
        network: its layers, where they are known. cdbs_ma: what fraction 1 means.

    Returns:
        None where the policy itself reproduces them as well, or no known fault does.
    """
    plain = _share(answers, act(windows))
    best, best_share = None, max(EXPLAINED, plain + 0.5 * (1.0 - plain))
    for tried in _tries(windows, act, network, cdbs_ma):
        share = _share(answers, tried.answers)
        if share > best_share or (best is None and share >= best_share):
            best, best_share = tried, share
    return best


def _share(answers: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    near = np.abs(answers - reference) <= NEAR * np.maximum(1.0, np.abs(reference))
    return float(near.mean())


def _tries(windows: Windows, act: Act, network: MlpNetwork | None, cdbs_ma: float) -> Iterator[Explanation]:
    due = act(windows)
    yield Explanation("unit", "mA", due * cdbs_ma)
    yield Explanation("unit", "per cent", due * 100.0)
    yield Explanation("unit", "shares of cDBS left, 1 minus the fraction", 1.0 - due)
    for name, order in orders(windows.shape[1]):
        yield Explanation("order", name, act(windows[:, order]))
    for power in _POWERS:
        top = 2.0**power
        if np.any(windows >= top):
            yield Explanation("wrap", top, act((windows + top) % (2.0 * top) - top))
            yield Explanation("cut", top, act(np.minimum(windows, top)))
    if network is not None:
        for decimals in _DECIMALS:
            yield Explanation("rounded", decimals, round_weights(network, decimals)(windows))
    if network is not None and network.output.low is not None:
        free = MlpNetwork(network.layers, network.mean, network.std, network.activations, network.output._replace(low=None, high=None))
        yield Explanation("outside", "without its clip", free.act(windows))


def orders(length: int) -> Iterator[tuple[str, NDArray[np.int64]]]:
    """List the orders in which a window may be misread: backwards, and as rows taken for columns."""
    straight = np.arange(length)
    yield "newest first", straight[::-1]
    for rows in range(2, length):
        if length % rows == 0:
            yield f"{rows} rows taken for columns", straight.reshape(rows, -1).T.ravel()


def round_weights(network: MlpNetwork, decimals: int) -> Callable[[Windows], NDArray[np.float64]]:
    """Make the network with its scaling folded into the first layer and every weight written with so many decimals."""
    (weights, bias), *others = network.layers
    first = weights.astype(np.float64) / network.std
    folded: list[tuple[NDArray[Any], NDArray[Any]]] = [(first, bias - network.mean * first.sum(axis=1)), *others]
    layers = [(_round(w, decimals), _round(b, decimals)) for w, b in folded]
    output: Output = network.output
    return MlpNetwork(layers, 0.0, 1.0, network.activations, output).act


def _round(values: NDArray[Any], decimals: int) -> NDArray[np.float32]:
    return np.asarray(np.round(values.astype(np.float64), decimals), dtype=np.float32)
