"""A small network in whole numbers, for implants without a floating-point unit: int8 weights, int16 activations, int32 accumulators.

Each row of weights has one scale. A row is one plane of int8. Where one plane cannot keep the guaranteed error small, it is two: a coarse
one, and a fine one in steps of 1/256 of the coarse. Between layers a row's sum is brought to int16 by a whole multiplier and a shift. Only
the last sum and its tanh are real numbers (and those of hidden layers with tanh, which files made elsewhere may have).

The error bound is analytical. It starts from intervals of the real network's activations over all windows. Through them it carries the
errors of inputs, weights, biases, multipliers and roundings, each at its worst sign. It applies to every possible window, not only to those
that were tried. Z-scores beyond `SCORE_LIMIT` are cut, and the bound is then against the real network on the cut window.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.deploy.c_envelope import header_tanh
from ml.deploy.runtime.network import MlpNetwork, Output

SCORE_LIMIT = 8.0
"""Largest z-score that the int16 inputs hold."""
MAX_PARAMETERS = 4096
"""Larger networks get no fixed-point header: they are not meant for an implant."""
WANTED_BOUND = 0.02
"""With one plane the guaranteed error of the fraction may be this much; beyond, two planes are used. At 3 mA it is 0.06 mA, less than the
0.1 mA in which stimulators of the RC+S kind are set."""
_FINE = 256
_INT16, _INT32 = 2**15 - 1, 2**31 - 1
_MULTIPLIER_BITS = 24
_FLOAT_SLACK = 5e-6  # float32 roundings of the z-score, the last product and the tanh, all together well below this

_TANH_SLACK = 2e-6  # of the header's tanh, and of the float32 that it is given

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class FixedLayer:
    """One layer.

    Attributes:
        planes: weights, one or two arrays [outputs, inputs] within int8.
        bias: [outputs], in units of a sum of the first plane.
        unit: [outputs], what a sum of 1 is worth.
        multiplier: [outputs], sums to int16 activations, to be shifted right by `shift`; empty in the last layer and before a tanh.
        shift: bits.
    """

    planes: tuple[Ints, ...]
    bias: Ints
    unit: NDArray[np.float64]
    multiplier: Ints
    shift: int

    def sums(self, activations: Ints) -> Ints:
        """Sum activations [N, inputs] to [N, outputs]. Raises OverflowError where an accumulator leaves int32: not with weights from
        `quantise`."""
        parts = [activations @ plane.T for plane in self.planes]
        if any(np.abs(part).max(initial=0) > _INT32 for part in parts):
            raise OverflowError("an accumulator leaves int32")
        total = parts[0] + self.bias
        return np.asarray(total if len(parts) == 1 else total * _FINE + parts[1])


@dataclass(frozen=True)
class FixedPointNetwork:
    """A network in whole numbers.

    Attributes:
        layers: from the window to the output.
        mean, std: of beta.
        bound: no window gives a fraction farther than this from the real network's.
        output: what follows the last layer.
    """

    layers: tuple[FixedLayer, ...]
    mean: float
    std: float
    bound: float
    output: Output

    @property
    def planes(self) -> int:
        """int8 planes per weight: 1 or 2."""
        return len(self.layers[0].planes)

    @property
    def size_bytes(self) -> int:
        """Weights as int8, biases and multipliers as int32, and float32 units of the sums that become real numbers."""
        return sum(sum(p.size for p in a.planes) + 4 * a.bias.size + 4 * (a.multiplier.size or a.unit.size) for a in self.layers)

    def cut(self, states: NDArray[Any]) -> NDArray[np.float64]:
        """Cut beta windows [N, W] to the limit of their z-scores."""
        reach = SCORE_LIMIT * self.std
        return np.clip(np.asarray(states, dtype=np.float64), self.mean - reach, self.mean + reach)

    def act(self, states: NDArray[Any]) -> NDArray[np.float64]:
        """Compute amplitude fractions [N] for beta windows [N, W], by the same whole numbers as the C header."""
        scores = (np.asarray(states, dtype=np.float32) - np.float32(self.mean)) / np.float32(self.std)
        scaled = np.clip(scores, -SCORE_LIMIT, SCORE_LIMIT).astype(np.float32) * np.float32(_INT16 / SCORE_LIMIT)
        hidden: Ints = np.where(scaled < 0, np.ceil(scaled - np.float32(0.5)), np.floor(scaled + np.float32(0.5))).astype(np.int64)
        for layer in self.layers[:-1]:
            sums = layer.sums(hidden)
            if layer.multiplier.size:
                hidden = np.minimum((np.maximum(sums, 0) * layer.multiplier + (1 << (layer.shift - 1))) >> layer.shift, _INT16)
            else:
                hidden = np.rint(header_tanh(sums.astype(np.float32) * layer.unit.astype(np.float32)) * np.float32(_INT16)).astype(np.int64)
        last, out = self.layers[-1], self.output
        total = (last.sums(hidden)[:, 0].astype(np.float32) * np.float32(last.unit[0])).astype(np.float64)
        answer = out.gain * (np.tanh(total) if out.kind == "tanh" else total) + out.offset
        return np.asarray(np.clip(answer, -np.inf if out.low is None else out.low, np.inf if out.high is None else out.high))


class CutNetwork:
    """The real network on beta amplitudes cut as the whole numbers cut them: what the bound is against.

    Args:
        network: the real network. fixed: the same in whole numbers.
    """

    def __init__(self, network: MlpNetwork, fixed: FixedPointNetwork) -> None:
        self._network, self._fixed = network, fixed

    def push(self, beta: float) -> None:
        """Move the window on by one beta amplitude."""
        self._network.push(float(self._fixed.cut(np.array([beta]))[0]))

    def fraction(self) -> float:
        """Compute the amplitude fraction for the current window."""
        return self._network.fraction()


def quantise(network: MlpNetwork) -> FixedPointNetwork | None:
    """Quantise the network to whole numbers with one plane, or two where one keeps too little. None where it is too large for an implant or
    its sums do not fit."""
    if sum(w.size + b.size for w, b in network.layers) > MAX_PARAMETERS:
        return None
    if network.output.kind == "linear" and (network.output.low is None or network.output.high is None):
        return None  # a rounded sum could leave [0, 1] where the real one does not, and would count as a fault
    tried = [_quantise(network, planes) for planes in (1, 2)]
    fitting = [fixed for fixed in tried if fixed is not None]
    small = [fixed for fixed in fitting if fixed.bound <= WANTED_BOUND]
    return small[0] if small else min(fitting, key=lambda fixed: fixed.bound, default=None)


def _quantise(network: MlpNetwork, planes: int) -> FixedPointNetwork | None:
    low = np.full(network.window, max(-SCORE_LIMIT, -network.mean / network.std))  # beta amplitudes are not negative
    high = np.full(network.window, SCORE_LIMIT)
    scale = SCORE_LIMIT / _INT16
    error = np.full(network.window, scale / 2)
    reach = np.full(network.window, float(_INT16))
    layers = []
    for index, (weights32, bias32) in enumerate(network.layers):
        weights, bias = weights32.astype(np.float64), bias32.astype(np.float64)
        parts, row_scale = _split(weights, planes)
        unit = row_scale * scale / (_FINE if planes == 2 else 1)
        bias_unit = row_scale * scale
        whole_bias = np.rint(bias / bias_unit)
        kept = row_scale[:, None] * (parts[0] if planes == 1 else parts[0] + parts[1] / _FINE)
        sums = np.abs(parts[0] * _FINE + parts[1] if planes == 2 else parts[0]) @ reach + np.abs(whole_bias) * (_FINE if planes == 2 else 1)
        if max(np.max(np.abs(p) @ reach) for p in parts) > _INT32 or np.abs(whole_bias).max() > _INT32:
            return None
        if planes == 1 and sums.max() > _INT32:
            return None
        error = (
            np.abs(kept) @ error + np.abs(weights - kept) @ np.maximum(np.abs(low), np.abs(high)) + np.abs(bias - whole_bias * bias_unit)
        )
        positive, negative = np.maximum(weights, 0), np.minimum(weights, 0)
        low, high = positive @ low + negative @ high + bias, positive @ high + negative @ low + bias
        if index == len(network.layers) - 1:
            layers.append(_layer(parts, whole_bias, unit, np.empty(0), 0))
            break
        if network.activations[index] == "tanh":
            layers.append(_layer(parts, whole_bias, unit, np.empty(0), 0))
            low, high, scale = np.tanh(low), np.tanh(high), 1.0 / _INT16
            error = 2.0 * np.tanh(error / 2.0) + _TANH_SLACK + scale / 2  # |tanh a - tanh b| <= 2 tanh(|a - b| / 2)
            reach = np.full(len(bias), float(_INT16))
            continue
        low, high = np.maximum(low, 0), np.maximum(high, 0)
        top = float((high + error).max())
        scale = max(top, 1e-12) / _INT16
        wanted = unit / scale
        shift = _MULTIPLIER_BITS - math.ceil(math.log2(wanted.max()))
        if shift < 1 or sums.max() * wanted.max() * 2.0**shift >= 2.0**62:
            return None
        multiplier = np.rint(wanted * 2.0**shift)
        layers.append(_layer(parts, whole_bias, unit, multiplier, shift))
        error = error + scale / 2 + np.abs(multiplier / 2.0**shift - wanted) / wanted * (high + error)
        reach = np.full(len(bias), float(_INT16))
    out, last = network.output, float(error[0])
    bound = abs(out.gain) * (2.0 * math.tanh(last / 2) if out.kind == "tanh" else last) + _FLOAT_SLACK
    return FixedPointNetwork(tuple(layers), network.mean, network.std, min(bound, 1.0), out)


def _split(weights: NDArray[np.float64], planes: int) -> tuple[list[NDArray[np.float64]], NDArray[np.float64]]:
    """Split rows in steps of their scale [outputs], into one plane or two."""
    largest = np.abs(weights).max(axis=1)
    row_scale = np.where(largest > 0, largest, 1.0) / 127.0
    in_steps = weights / row_scale[:, None]
    coarse = np.clip(np.rint(in_steps), -127, 127)
    if planes == 1:
        return [coarse], row_scale
    return [coarse, np.clip(np.rint((in_steps - coarse) * _FINE), -127, 127)], row_scale


def _layer(
    parts: list[NDArray[np.float64]], bias: NDArray[np.float64], unit: NDArray[np.float64], multiplier: NDArray[np.float64], shift: int
) -> FixedLayer:
    return FixedLayer(tuple(p.astype(np.int64) for p in parts), bias.astype(np.int64), unit, multiplier.astype(np.int64), shift)
