"""A second ONNX file of a policy, in which a lost sample reaches the answer by arithmetic alone.

A ReLU or a clip may turn NaN into a number. Here x - x, which is 0 for a number and NaN for none, is summed over the window. The sum is
added to the answer. docs/results/ports.md has the converters in which it survives.
"""

from __future__ import annotations

import numpy as np
import onnx
from onnx import helper, numpy_helper

MODEL_LOST = "model-lost-sample.onnx"
_PREFIX = "lost_sample_"


def with_lost_samples(policy_onnx: bytes) -> bytes:
    """Add x - x, summed over the window, to a policy's answer.

    Args:
        policy_onnx: a file that `OnnxPolicy` takes, input [N, W] and output [N, 1] of one type.

    Raises:
        ValueError: input and output are of different types, or the window's length is not in the file.
    """
    model = onnx.load_model_from_string(policy_onnx)
    graph = model.graph
    weights = {tensor.name for tensor in graph.initializer}
    (entry,) = [value for value in graph.input if value.name not in weights]
    (answer,) = graph.output
    kind, width = entry.type.tensor_type.elem_type, entry.type.tensor_type.shape.dim[1].dim_value
    if kind != answer.type.tensor_type.elem_type or width < 1:
        raise ValueError("input and output are of different types, or the file does not say how long a window is")
    inner = f"{_PREFIX}answer"
    for node in graph.node:
        node.output[:] = [inner if name == answer.name else name for name in node.output]
        node.input[:] = [inner if name == answer.name else name for name in node.input]
    ones = numpy_helper.from_array(np.ones((width, 1), helper.tensor_dtype_to_np_dtype(kind)), f"{_PREFIX}ones")
    graph.initializer.append(ones)
    graph.node.extend([
        helper.make_node("Sub", [entry.name, entry.name], [f"{_PREFIX}none"]),
        helper.make_node("MatMul", [f"{_PREFIX}none", ones.name], [f"{_PREFIX}sum"]),
        helper.make_node("Add", [inner, f"{_PREFIX}sum"], [answer.name]),
    ])  # fmt: skip
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString(deterministic=True))
