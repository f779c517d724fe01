"""Layers of a policy file, whatever its origin: read from the ONNX graph where that is a plain multi-layer perceptron.

Plain means one path from the window to the answer. It has matrix products, sums and products with constants, ReLU, tanh and logistic
functions, and a clip at its end. Whatever is affine is folded (in float64) into one matrix and bias per layer. A logistic function is a
tanh of half its input, halved and moved by a half. The test vectors of the bundle prove what is read, not this file.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper

from ml.deploy.runtime.network import Layer, MlpNetwork, Output

_KEEPING = {"Identity", "Cast", "Dropout"}
_REAL = {onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE}

Numbers = NDArray[np.float64]


class NoPlainNetwork(ValueError):
    """The graph is no plain multi-layer perceptron; the message says why."""


def mlp_of(policy_onnx: bytes, windows: NDArray[Any] | None = None) -> MlpNetwork:
    """Read the network of a policy file into numpy.

    Args:
        policy_onnx: a file that `OnnxPolicy` takes.
        windows: the participant's beta windows [M, W]. Their mean and standard deviation are used where the file has none of its own, so
            that the fixed-point inputs cover the range of beta.

    Raises:
        NoPlainNetwork: the graph holds more than a plain network.
    """
    graph = onnx.load_model_from_string(policy_onnx).graph
    constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    (entry,) = [value for value in graph.input if value.name not in constants]
    width = entry.type.tensor_type.shape.dim[1].dim_value or (0 if windows is None else windows.shape[1])
    if width < 1:
        raise NoPlainNetwork("the file does not say how long a window is")
    path = _Path(int(width))
    current = entry.name
    for node in graph.node:
        attributes = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
        if node.op_type == "Constant":
            constants[node.output[0]] = _constant(attributes)
        elif list(node.input).count(current) == 1 and node.domain in ("", "ai.onnx"):
            path.take(node.op_type, attributes, [None if name in (current, "") else _of(constants, name) for name in node.input])
            current = node.output[0]
        else:
            raise NoPlainNetwork(f"its operator {node.op_type} does not lie on one path from the window to the answer")
    if current != graph.output[0].name:
        raise NoPlainNetwork("its answer does not come from the last operator")
    return path.network(None if windows is None else np.asarray(windows, dtype=np.float64))


def _constant(attributes: dict[str, Any]) -> NDArray[Any]:
    for name, value in attributes.items():
        return np.asarray(numpy_helper.to_array(value) if name == "value" else value)
    raise NoPlainNetwork("it holds a constant without a value")


def _of(constants: dict[str, NDArray[Any]], name: str) -> NDArray[Any]:
    if name not in constants:
        raise NoPlainNetwork("it has branches")
    return np.asarray(constants[name])


class _Path:
    """Part of the graph that has been read so far: finished layers, and after them an affine map that is not finished yet."""

    def __init__(self, width: int) -> None:
        self.mean, self.std = np.zeros(width), np.ones(width)  # (x - mean) / std of the window, as long as nothing else has come
        self.layers: list[tuple[Numbers, Numbers]] = []
        self.activations: list[str] = []
        self.matrix: Numbers = np.eye(width)
        self.offset: Numbers = np.zeros(width)
        self.scaling = True  # still in front of the first product
        self.clip: tuple[float | None, float | None] | None = None

    def take(self, operator: str, attributes: dict[str, Any], inputs: list[NDArray[Any] | None]) -> None:
        """Read one more operator; `inputs` has None where the path enters."""
        known: dict[str, Callable[[dict[str, Any], list[Any]], None]] = {
            "Gemm": self._gemm, "MatMul": self._matmul, "BatchNormalization": self._batch_normalisation, "Slice": self._slice,
            "ReduceMean": self._reduce_mean, "Clip": self._clip, "Min": self._clip_high, "Max": self._clip_low,
            "Flatten": self._same_shape, "Reshape": self._same_shape,
        }  # fmt: skip
        if operator in _KEEPING and attributes.get("to", onnx.TensorProto.FLOAT) in _REAL:
            return
        if self.clip is not None and operator not in ("Clip", "Min", "Max", "Flatten", "Reshape"):
            raise NoPlainNetwork(f"its operator {operator} follows a clip")
        if operator in ("Add", "Sub", "Mul", "Div", "Neg"):
            self._elementwise(operator, inputs)
        elif operator in ("Relu", "Tanh", "Sigmoid"):
            self._activate(operator)
        elif operator in known:
            known[operator](attributes, inputs)
        else:
            raise NoPlainNetwork(f"its operator {operator} is none of a plain network's")

    @property
    def size(self) -> int:
        """Numbers that flow at this place of the path."""
        return len(self.offset)

    def _row(self, value: NDArray[Any]) -> Numbers:
        """Convert a constant to one number per column."""
        return _columns(value, self.size)

    def _elementwise(self, operator: str, inputs: list[NDArray[Any] | None]) -> None:
        first = inputs[0] is None
        c = np.zeros(self.size) if operator == "Neg" else self._row(_other(inputs))
        if operator == "Div" and (not first or not c.all()):
            raise NoPlainNetwork("it divides by its values or by zero")
        if operator in ("Add", "Sub") and first and self.scaling:
            self.mean = self.mean - c * self.std * (1 if operator == "Add" else -1)
        elif operator == "Div" and self.scaling:
            self.std = self.std * c
        elif operator == "Mul" and self.scaling and c.all():
            self.std = self.std / c
        else:
            sign = -1.0 if operator == "Neg" or (operator == "Sub" and not first) else 1.0
            gain = {"Mul": c, "Div": 1.0 / np.where(c == 0, 1.0, c)}.get(operator, np.full(self.size, sign))
            moved = {"Add": c, "Sub": -c if first else c}.get(operator, np.zeros(self.size))
            self._affine(np.diag(gain), moved)

    def _affine(self, matrix: Numbers, offset: Numbers) -> None:
        if matrix.shape[1] != self.size:
            raise NoPlainNetwork(f"a matrix of {matrix.shape[1]} columns meets {self.size} values")
        self.scaling = False
        self.matrix, self.offset = matrix @ self.matrix, matrix @ self.offset + offset

    def _gemm(self, attributes: dict[str, Any], inputs: list[Any]) -> None:
        if inputs[0] is not None or attributes.get("transA", 0):
            raise NoPlainNetwork("a Gemm takes its values from elsewhere than its first input")
        weights = np.asarray(inputs[1], dtype=np.float64) * attributes.get("alpha", 1.0)
        matrix = weights if attributes.get("transB", 0) else weights.T
        bias = np.zeros(()) if len(inputs) < 3 or inputs[2] is None else inputs[2]
        self._affine(matrix, _columns(bias, len(matrix)) * attributes.get("beta", 1.0))

    def _matmul(self, attributes: dict[str, Any], inputs: list[Any]) -> None:
        if inputs[0] is not None or np.ndim(inputs[1]) != 2:
            raise NoPlainNetwork("a MatMul takes its values from elsewhere than its first input")
        matrix = np.asarray(inputs[1], dtype=np.float64).T
        self._affine(matrix, np.zeros(len(matrix)))

    def _batch_normalisation(self, attributes: dict[str, Any], inputs: list[Any]) -> None:
        if attributes.get("training_mode", 0):
            raise NoPlainNetwork("its batch normalisation is in training mode")
        gain, bias, mean, variance = (self._row(value) for value in inputs[1:5])
        gain = gain / np.sqrt(variance + attributes.get("epsilon", 1e-5))
        self._affine(np.diag(gain), bias - gain * mean)

    def _slice(self, attributes: dict[str, Any], inputs: list[Any]) -> None:
        start, stop, axes, *step = (np.ravel(value).tolist() for value in inputs[1:]) if len(inputs) >= 4 else ([], [], [])
        if axes not in ([1], [-1]) or step not in ([], [[1]]):
            raise NoPlainNetwork("its Slice takes other than a part of the window")
        rows = np.eye(self.size)[int(start[0]) : int(min(stop[0], self.size))]
        if len(rows) == 0:
            raise NoPlainNetwork("its Slice takes nothing")
        self._affine(rows, np.zeros(len(rows)))

    def _reduce_mean(self, attributes: dict[str, Any], inputs: list[Any]) -> None:
        axes = attributes.get("axes", np.ravel(inputs[1]).tolist() if len(inputs) > 1 else [])
        if list(axes) not in ([1], [-1]) or not attributes.get("keepdims", 1):
            raise NoPlainNetwork("its ReduceMean is not over the window")
        self._affine(np.full((1, self.size), 1.0 / self.size), np.zeros(1))

    def _same_shape(self, attributes: dict[str, Any], inputs: list[Any]) -> None:
        shape = [attributes.get("axis", 1)] if len(inputs) == 1 else np.ravel(inputs[1]).tolist()
        if shape not in ([1], [-1, self.size], [0, self.size], [0, -1]):
            raise NoPlainNetwork(f"it gives its values another shape, {shape}")

    def _activate(self, operator: str) -> None:
        half = 0.5 if operator == "Sigmoid" else 1.0
        self.scaling = False
        self.layers.append((half * self.matrix, half * self.offset))
        self.activations.append("relu" if operator == "Relu" else "tanh")
        self.matrix, self.offset = half * np.eye(self.size), np.full(self.size, 1.0 - half)

    def _clip(self, attributes: dict[str, Any], inputs: list[Any]) -> None:
        low, high = (None if i >= len(inputs) or inputs[i] is None else float(np.ravel(inputs[i])[0]) for i in (1, 2))
        low, high = attributes.get("min", low), attributes.get("max", high)  # attributes until opset 10
        before = self.clip or (None, None)
        lows, highs = [v for v in (low, before[0]) if v is not None], [v for v in (high, before[1]) if v is not None]
        self.clip = (max(lows) if lows else None, min(highs) if highs else None)

    def _clip_high(self, attributes: dict[str, Any], inputs: list[Any]) -> None:
        self._clip({}, [None, None, self._row(_other(inputs))])

    def _clip_low(self, attributes: dict[str, Any], inputs: list[Any]) -> None:
        self._clip({}, [None, self._row(_other(inputs))])

    def network(self, windows: Numbers | None) -> MlpNetwork:
        """Return the finished network."""
        if self.size != 1:
            raise NoPlainNetwork(f"it ends with {self.size} values instead of one")
        low, high = self.clip or (None, None)
        if self.layers and self.activations[-1] == "tanh" and len(self.layers[-1][1]) == 1:
            output = Output("tanh", float(self.matrix[0, 0]), float(self.offset[0]), low, high)
            layers, activations = self.layers, self.activations[:-1]
        else:
            output = Output("linear", 1.0, 0.0, low, high)
            layers, activations = [*self.layers, (self.matrix, self.offset)], self.activations
        mean, std = self._scale(windows)
        (first, offset), *others = layers
        if np.any(self.mean != mean) or np.any(self.std != std):
            # (x - mean_i) / std_i in terms of the one z-score s = (x - mean) / std that the runtimes keep
            offset = offset + first @ ((mean - self.mean) / self.std)
            first = first * (std / self.std)
        out: list[Layer] = [(w.astype(np.float32), b.astype(np.float32)) for w, b in [(first, offset), *others]]
        return MlpNetwork(out, mean, std, tuple(activations), output)

    def _scale(self, windows: Numbers | None) -> tuple[float, float]:
        """Compute mean and standard deviation for the z-scores of all positions of the window."""
        if windows is None or (np.any(self.mean) and np.any(self.std != 1.0)):
            return float(self.mean.mean()) if np.ptp(self.mean) else float(self.mean[0]), float(np.abs(self.std).mean())
        level, spread = float(np.float32(windows.mean())), float(np.float32(windows.std()))
        return level, spread if spread > 0 else max(abs(level), 1.0)


def _columns(value: NDArray[Any], size: int) -> Numbers:
    """Convert a constant that is broadcast over the windows to one number per column [size]."""
    value = np.asarray(value, dtype=np.float64)
    if value.size not in (1, size) or (value.ndim and value.size != value.shape[-1]):
        raise NoPlainNetwork(f"a constant of shape {list(value.shape)} meets {size} values")
    return np.broadcast_to(value.reshape(-1), (size,)).copy()


def _other(inputs: list[NDArray[Any] | None]) -> NDArray[Any]:
    constants = [value for value in inputs if value is not None]
    if len(constants) != 1 or len(inputs) != 2:
        raise NoPlainNetwork("it has branches")
    return constants[0]
