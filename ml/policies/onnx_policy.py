"""Policies as ONNX files, made here or elsewhere.

The contract of such a file: one input [N, W] of beta windows, oldest first, in the participant's unit. One output [N, 1] of amplitude
fractions in [0, 1]. Values are float32 or float64, everything is inside the file, and its answer is deterministic. Names are free, N is
dynamic or fixed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

RANGE_TOLERANCE = 1e-4
"""An output this far outside [0, 1] is rounding and is clipped; farther outside it is a fault and raises."""
MAX_FILE_BYTES = 64 * 2**20
_DTYPES = {onnx.TensorProto.FLOAT: np.float32, onnx.TensorProto.DOUBLE: np.float64}
_DOMAINS = {"", "ai.onnx", "ai.onnx.ml", "com.microsoft"}
"""Of operators that onnxruntime has; functions that the file itself defines come with a domain of their own."""
_RANDOM_OPERATORS = {"RandomNormal", "RandomNormalLike", "RandomUniform", "RandomUniformLike", "Multinomial", "Bernoulli"}


class PolicyFileError(ValueError):
    """The bytes are no policy that betaloop can run; the message says what is wrong and what to do."""


class PolicyOutputError(ValueError):
    """A policy answered with something that is no amplitude fraction."""


class OnnxPolicy:
    """A policy run by onnxruntime on one CPU thread.

    Args:
        content: the ONNX file.
        window: W that the participant uses; None takes the file's own.
        probe: further beta windows to try on load, shape [M, W], in addition to the built-in ones (a snapshot's states, for example).

    Attributes:
        content: the bytes given.
        window: W.

    Raises:
        PolicyFileError: the file is not such a policy.
    """

    def __init__(self, content: bytes, window: int | None = None, probe: NDArray[Any] | None = None) -> None:
        model = _parse(content)
        self.content = content
        self._input, self._dtype, self._batch, self.window = _read_interface(model.graph, window)
        self._session = _open(content)
        self._check_answers(probe)

    def __reduce__(self) -> tuple[type[OnnxPolicy], tuple[bytes, int]]:
        return OnnxPolicy, (self.content, self.window)

    def act(self, states: NDArray[Any]) -> NDArray[np.float64]:
        """Compute amplitude fractions, shape [N], for beta windows [N, W].

        Raises:
            ValueError: states of another shape.
            PolicyOutputError: an output that is not finite or outside [0, 1] by more than `RANGE_TOLERANCE`; less is rounding and is
                clipped.
        """
        states = np.asarray(states)
        if states.ndim != 2 or states.shape[1] != self.window:
            raise ValueError(f"this policy takes beta windows of shape [N, {self.window}], not {list(states.shape)}")
        fractions = self._run(states)
        bad = ~((fractions >= -RANGE_TOLERANCE) & (fractions <= 1 + RANGE_TOLERANCE))  # True for NaN as well
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            raise PolicyOutputError(f"the policy answered {fractions[row]:.6g} for window {row}; an amplitude fraction must be in [0, 1]")
        return np.clip(fractions, 0.0, 1.0)

    def _run(self, states: NDArray[Any]) -> NDArray[np.float64]:
        """Run the file for raw outputs, shape [N]. A file with a fixed N gets blocks, the last one filled up with copies of its last
        row."""
        count = len(states)
        if count == 0:
            return np.empty(0)
        rows = np.ascontiguousarray(states, dtype=self._dtype)
        if self._batch is None:
            return self._run_block(rows)
        padded = np.concatenate([rows, np.repeat(rows[-1:], -count % self._batch, axis=0)])
        blocks = [self._run_block(padded[i : i + self._batch]) for i in range(0, len(padded), self._batch)]
        return np.concatenate(blocks)[:count]

    def _run_block(self, rows: NDArray[Any]) -> NDArray[np.float64]:
        (output,) = self._session.run(None, {self._input: rows})
        if output.shape != (len(rows), 1):
            raise PolicyOutputError(
                f"the policy answered with shape {list(output.shape)} for {len(rows)} windows; it must be [{len(rows)}, 1]"
            )
        return np.asarray(output[:, 0], dtype=np.float64)

    def _check_answers(self, probe: NDArray[Any] | None) -> None:
        """Run the policy on windows of many scales: answers must be fractions, repeatable, and of each window alone."""
        windows = _built_in_probe(self.window)
        if probe is not None:
            windows = np.concatenate([windows, np.asarray(probe, dtype=np.float64).reshape(-1, self.window)])
        try:
            first = self.act(windows)
            again = self.act(windows)
            alone = self.act(windows[:1])
        except PolicyOutputError as error:
            raise PolicyFileError(f"{error}. Bound the output inside the network, with a sigmoid or a clip to [0, 1]") from error
        except Exception as error:  # onnxruntime raises many kinds; each of them means that the file cannot be run
            raise PolicyFileError(f"onnxruntime cannot run this policy on a batch of beta windows: {error}") from error
        if not np.array_equal(first, again):
            raise PolicyFileError("the policy answers differently to the same beta window: it must be deterministic")
        if abs(float(alone[0] - first[0])) > RANGE_TOLERANCE:
            raise PolicyFileError(
                "the policy's answer to a beta window depends on the other windows of the batch; "
                "export it in evaluation mode (batch normalisation)"
            )


def _parse(content: bytes) -> Any:
    if len(content) > MAX_FILE_BYTES:
        raise PolicyFileError(f"the file has {len(content)} bytes; a policy may have at most {MAX_FILE_BYTES}")
    try:
        model = onnx.load_model_from_string(content)
    except Exception as error:  # protobuf's own error class is no public name
        raise PolicyFileError(f"this is not an ONNX file: {error}") from error
    if not model.graph.node:
        raise PolicyFileError("this is not an ONNX file with a network: its graph has no operator")
    for tensor in _tensors(model):
        if tensor.data_location == onnx.TensorProto.EXTERNAL or tensor.external_data:
            raise PolicyFileError(f"the weights '{tensor.name}' lie outside the file; save the model as one file, without external data")
    known = _DOMAINS | {function.domain for function in model.functions}
    for node in _all_nodes(model):
        if node.domain not in known:
            what = f"the operator '{node.op_type}' of '{node.domain}' is not one of ONNX's own"
            raise PolicyFileError(f"{what}; export the policy with standard operators alone")
        if node.op_type in _RANDOM_OPERATORS:
            raise PolicyFileError(f"the operator {node.op_type} draws random numbers: a policy must be deterministic")
    try:
        onnx.checker.check_model(model)
    except onnx.checker.ValidationError as error:
        raise PolicyFileError(f"the ONNX file is not valid: {error}") from error
    return model


def _graphs(graph: Any) -> Iterator[Any]:
    yield graph
    for node in graph.node:
        for attribute in node.attribute:
            for inner in ([attribute.g] if attribute.HasField("g") else []) + list(attribute.graphs):
                yield from _graphs(inner)


def _all_nodes(model: Any) -> Iterator[Any]:
    for graph in _graphs(model.graph):
        yield from graph.node
    for function in model.functions:
        yield from function.node


def _tensors(model: Any) -> Iterator[Any]:
    for graph in _graphs(model.graph):
        yield from graph.initializer
        for sparse in graph.sparse_initializer:
            yield from (sparse.values, sparse.indices)
    for node in _all_nodes(model):
        for attribute in node.attribute:
            yield from [attribute.t] if attribute.HasField("t") else []
            yield from attribute.tensors


def _read_interface(graph: Any, window: int | None) -> tuple[str, type[Any], int | None, int]:
    """Name and dtype of the input, its fixed N (None where dynamic) and W."""
    weights = {tensor.name for tensor in graph.initializer}
    inputs = [value for value in graph.input if value.name not in weights]
    if len(inputs) != 1 or len(graph.output) != 1:
        raise PolicyFileError(
            "a policy has one input (beta windows) and one output (amplitude fractions); "
            f"this file has {len(inputs)} and {len(graph.output)}"
        )
    dtypes = []
    for role, value in (("input", inputs[0]), ("output", graph.output[0])):
        element = value.type.tensor_type.elem_type
        if element not in _DTYPES:
            name = onnx.TensorProto.DataType.Name(element)
            raise PolicyFileError(f"the {role} '{value.name}' is of type {name}; it must be float32 or float64")
        dtypes.append(_DTYPES[element])
    batch, width = _dimensions("input", inputs[0], "[N, W]")
    if width is None:
        width = window
    if width is None:
        raise PolicyFileError(f"the input '{inputs[0].name}' does not say how many beta amplitudes a window has; give it the shape [N, W]")
    if window is not None and width != window:
        raise PolicyFileError(f"the policy takes windows of {width} beta amplitudes; this participant's window has {window}")
    if graph.output[0].type.tensor_type.HasField("shape"):
        _, columns = _dimensions("output", graph.output[0], "[N, 1]")
        if columns not in (None, 1):
            raise PolicyFileError(
                f"the output '{graph.output[0].name}' has {columns} columns; a policy answers with one fraction per window, [N, 1]"
            )
    return inputs[0].name, dtypes[0], batch, width


def _dimensions(role: str, value: Any, wanted: str) -> tuple[int | None, int | None]:
    shape = value.type.tensor_type.shape.dim
    if len(shape) != 2:
        raise PolicyFileError(f"the {role} '{value.name}' has {len(shape)} dimensions; it must have the shape {wanted}")
    first, second = (int(dim.dim_value) if dim.HasField("dim_value") and dim.dim_value > 0 else None for dim in shape)
    return first, second


def _open(content: bytes) -> Any:
    import onnxruntime as ort  # starts a thread, which a process whose forks compute must not have

    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.log_severity_level = 4  # a file that cannot be run raises; no second copy of the text on stderr
    try:
        return ort.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises many kinds; each of them means that the file cannot be run
        raise PolicyFileError(f"onnxruntime cannot load this policy: {error}") from error


def _built_in_probe(window: int) -> NDArray[np.float64]:
    """Make flat and noisy windows over eight decades, because a file does not state the unit of its beta."""
    scales = np.concatenate([[0.0], 10.0 ** np.arange(-3, 5)])
    noise = np.abs(np.random.default_rng(0).normal(1.0, 0.5, size=(4, scales.size, window)))
    shapes = np.concatenate([np.ones((1, scales.size, window)), noise])
    return np.asarray((shapes * scales[None, :, None]).reshape(-1, window))
