"""The network in numpy: a multi-layer perceptron on z-scored beta windows; betaloop's own have ReLU, and (tanh(x) + 1) / 2 at their end."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Layer = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Weights [outputs, inputs] and biases [outputs]."""
_ZERO = np.zeros(1, dtype=np.float32)  # an array: a Python number would be converted at each call


class Output(NamedTuple):
    """Conversion of the last sum x to a fraction: gain * tanh(x) + offset (`tanh`) or gain * x + offset (`linear`), cut to [low, high]
    where these are stated."""

    kind: str = "tanh"
    gain: float = 0.5
    offset: float = 0.5
    low: float | None = None
    high: float | None = None


OWN_OUTPUT = Output()
"""(tanh(x) + 1) / 2, as betaloop's own networks end."""


class MlpNetwork:
    """A policy that keeps its own window, so that a decision costs three small matrix products.

    Args:
        layers: from the window to the one output.
        mean, std: of beta, in the unit of the beta amplitudes.
        activations: of each hidden layer, `relu` or `tanh`; empty means ReLU throughout.
        output: what follows the last layer.

    Raises:
        ValueError: layers or activations that do not fit together, numbers that are not finite, or a standard deviation that is not
            positive.
    """

    def __init__(
        self,
        layers: Sequence[Layer],
        mean: float,
        std: float,
        activations: Sequence[str] = (),
        output: Output = OWN_OUTPUT,
    ) -> None:
        sizes = [layers[0][0].shape[1], *(w.shape[0] for w, _ in layers)]
        if any(w.shape != (o, i) or b.shape != (o,) for (w, b), (i, o) in zip(layers, pairwise(sizes), strict=True)) or sizes[-1] != 1:
            raise ValueError(f"the layers do not fit together: {[w.shape for w, _ in layers]}")
        if not all(np.isfinite(w).all() and np.isfinite(b).all() for w, b in layers):
            raise ValueError("a weight is not a finite number")
        if not (math.isfinite(mean) and math.isfinite(std) and std > 0):
            raise ValueError(f"the beta scale needs a finite mean and a positive standard deviation, not {mean} and {std}")
        self.activations = tuple(activations) or ("relu",) * (len(layers) - 1)
        if len(self.activations) != len(layers) - 1 or not set(self.activations) <= {"relu", "tanh"}:
            raise ValueError(f"{len(layers) - 1} hidden layers need as many of relu and tanh, not {list(self.activations)}")
        limits = (-math.inf if output.low is None else output.low, math.inf if output.high is None else output.high)
        finite = math.isfinite(output.gain) and math.isfinite(output.offset)
        if output.kind not in ("tanh", "linear") or not finite or not limits[0] <= limits[1]:
            raise ValueError(f"the last layer cannot be followed by {output}")
        self.output = output
        self.layers = [(w.astype(np.float32), b.astype(np.float32)) for w, b in layers]
        self.mean, self.std = float(np.float32(mean)), float(np.float32(std))
        self.window = sizes[0]
        # The bias is a column of the weights and a 1 behind the inputs: one call of numpy less per layer.
        self._inputs = [np.ones(size + 1, dtype=np.float32) for size in sizes]
        self._steps = [
            (np.ascontiguousarray(np.column_stack([w, b])), self._inputs[i], self._inputs[i + 1][:-1], kind == "relu")
            for i, ((w, b), kind) in enumerate(zip(self.layers, (*self.activations, ""), strict=True))
        ]
        scores = self._inputs[0][:-1]
        scores[:] = 0.0
        self._older, self._newer, self._scores, self._newest = scores[:-1], scores[1:], scores, self.window - 1
        matrix, inputs, *_ = self._steps.pop()
        self._last = np.ascontiguousarray(matrix[0]), inputs, output.kind == "tanh", output.gain, output.offset
        self._limits = limits if limits != (-math.inf, math.inf) else None

    def push(self, beta: float) -> None:
        """Move the window on by one beta amplitude."""
        self._older[...] = self._newer
        self._scores[self._newest] = (beta - self.mean) / self.std

    def fraction(self) -> float:
        """Compute the amplitude fraction for the current window."""
        dot, maximum = np.dot, np.maximum
        for matrix, inputs, outputs, relu in self._steps:
            if relu:
                maximum(dot(matrix, inputs), _ZERO, out=outputs)
            else:
                np.tanh(dot(matrix, inputs), out=outputs)
        weights, inputs, bounded, gain, offset = self._last
        total = dot(weights, inputs)
        answer = gain * (math.tanh(total) if bounded else float(total)) + offset
        if self._limits is None or answer != answer:  # no number stays none: the envelope is to see it
            return answer
        return min(max(answer, self._limits[0]), self._limits[1])

    def act(self, states: NDArray[Any], tanh: Callable[[Any], Any] = np.tanh) -> NDArray[np.float64]:
        """Compute amplitude fractions, shape [N], for beta windows [N, W]; the network's own window does not move. `tanh`: on float32
        arrays."""
        hidden = ((np.asarray(states, dtype=np.float32) - np.float32(self.mean)) / np.float32(self.std)).T
        for (weights, biases), kind in zip(self.layers, self.activations, strict=False):
            total = weights @ hidden + biases[:, None]
            hidden = np.maximum(total, np.float32(0.0)) if kind == "relu" else tanh(total)
        weights, biases = self.layers[-1]
        last = (weights @ hidden + biases[:, None])[0]
        out = self.output
        answer = out.gain * (tanh(last) if out.kind == "tanh" else last).astype(np.float64) + out.offset
        return np.asarray(answer if self._limits is None else np.clip(answer, *self._limits), dtype=np.float64)

    def to_bytes(self) -> bytes:
        """Write weights and biases layer by layer, row by row, little-endian float32."""
        return b"".join(np.ascontiguousarray(a, dtype="<f4").tobytes() for layer in self.layers for a in layer)

    @staticmethod
    def from_bytes(
        content: bytes,
        sizes: Sequence[int],
        mean: float,
        std: float,
        activations: Sequence[str] = (),
        output: Output = OWN_OUTPUT,
    ) -> MlpNetwork:
        """Read what `to_bytes` wrote, for the sizes [W, ..., 1]. Raises ValueError where the bytes are too few or too many."""
        numbers = np.frombuffer(content, dtype="<f4") if len(content) % 4 == 0 else np.empty(0, dtype="<f4")
        if numbers.size != sum(o * i + o for i, o in pairwise(sizes)):
            raise ValueError(f"{len(content)} bytes of weights do not fit layers of {list(sizes)}")
        layers: list[Layer] = []
        at = 0
        for i, o in pairwise(sizes):
            weights, biases = numbers[at : at + o * i].reshape(o, i), numbers[at + o * i : at + o * i + o]
            layers.append((weights.astype(np.float32), biases.astype(np.float32)))
            at += o * i + o
        return MlpNetwork(layers, mean, std, activations, output)
