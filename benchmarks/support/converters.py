"""Converters, each run in an environment of its own: `converters.py NAME MODEL WINDOWS CALIBRATION ANSWERS` writes a copy's answers.

`benchmarks/ports.py` calls this file by its path with the Python of each environment; nothing of betaloop is imported here. MODEL is a
policy's ONNX file, WINDOWS and CALIBRATION are `.npy` arrays [N, W]. A converter that cannot take the model raises, and its last line is
quoted in the table.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

Array = Any
Convert = Callable[[Path, Array, Array, Path], Array]
COPY = "copy.tflite"
"""A converted file that betaloop can run too; `main` keeps it with the answers."""


def run_onnx(model: Path, windows: Array) -> Array:
    """Run an ONNX file by onnxruntime, a window at a time."""
    import onnxruntime as ort

    session = ort.InferenceSession(str(model), providers=["CPUExecutionProvider"])
    name = session.get_inputs()[0].name
    return np.array([float(session.run(None, {name: w[None].astype(np.float32)})[0].ravel()[0]) for w in windows])


def convert_float(model: Path, windows: Array, _calibration: Array, _folder: Path) -> Array:
    """Run the file as it is."""
    return run_onnx(model, windows)


def convert_dynamic(model: Path, windows: Array, _calibration: Array, folder: Path) -> Array:
    """Quantise the weights by onnxruntime, int8; activations at run time."""
    from onnxruntime.quantization import quantize_dynamic

    quantize_dynamic(str(model), str(folder / "copy.onnx"))
    return run_onnx(folder / "copy.onnx", windows)


def convert_static(model: Path, windows: Array, calibration: Array, folder: Path) -> Array:
    """Quantise weights and activations by onnxruntime, calibrated on recorded windows."""
    from onnxruntime.quantization import CalibrationDataReader, quantize_static

    class Reader(CalibrationDataReader):
        """Windows for the calibration."""

        def __init__(self) -> None:
            self.rows: Iterator[Array] = iter(calibration.astype(np.float32))

        def get_next(self) -> dict[str, Array] | None:
            """Return the next window; None at the end."""
            row = next(self.rows, None)
            return None if row is None else {"beta_window": row[None]}

    quantize_static(str(model), str(folder / "copy.onnx"), Reader())
    return run_onnx(folder / "copy.onnx", windows)


def layers_of(model: Path) -> tuple[list[tuple[Array, Array]], float, float]:
    """Read weights [outputs, inputs] and biases of betaloop's own file, and its scaling."""
    import onnx
    from onnx import numpy_helper

    found = {t.name: numpy_helper.to_array(t).astype(np.float64) for t in onnx.load(str(model)).graph.initializer}
    count = sum(name.startswith("weight_") for name in found)
    layers = [(found[f"weight_{i}"], found[f"bias_{i}"]) for i in range(count)]
    return layers, float(found["beta_mean"][0]), float(found["beta_std"][0])


def fold_scaling(model: Path) -> list[tuple[Array, Array]]:
    """Fold the scaling into the first layer, and (tanh(x) + 1) / 2 into a logistic function of 2 x."""
    layers, mean, std = layers_of(model)
    weights, bias = layers[0]
    layers[0] = (weights / std, bias - mean / std * weights.sum(axis=1))
    layers[-1] = (2 * layers[-1][0], 2 * layers[-1][1])
    return layers


def convert_emlearn(model: Path, windows: Array, _calibration: Array, folder: Path) -> Array:
    """Write C by emlearn, with the scaling folded in, as it has no step for it; compile and run it."""
    import emlearn
    from emlearn.net import c_generate_net_loadable

    layers = fold_scaling(model)
    activations = ["relu"] * (len(layers) - 1) + ["logistic"]
    code = c_generate_net_loadable(activations, [w.T for w, _ in layers], [b for _, b in layers], "net")
    length = windows.shape[1]
    main = f"""
#include <stdio.h>
#include <math.h>
int main(void) {{
    static float values[{length}];
    while (fread(values, sizeof(float), {length}, stdin) == {length}) printf("%.9g\\n", (double)net_regress1(values, {length}));
    return 0;
}}
"""
    (folder / "net.c").write_text(code + main)
    subprocess.run(["cc", "-O1", f"-I{emlearn.includedir}", "net.c", "-o", "net", "-lm"], cwd=folder, check=True)
    printed = subprocess.run([folder / "net"], input=windows.astype("<f4").tobytes(), capture_output=True, check=True).stdout
    return np.array([float(line) for line in printed.decode().split()])


def convert_tinygrad(model: Path, windows: Array, _calibration: Array, _folder: Path) -> Array:
    """Run the file by tinygrad."""
    os.environ.setdefault("DEV", "PYTHON")  # its own interpreter: no compiler is needed
    from tinygrad import Tensor
    from tinygrad.nn.onnx import OnnxRunner

    run = OnnxRunner(str(model))
    return np.array(
        [float(run({"beta_window": Tensor(w[None].astype(np.float32))})["amplitude_fraction"].numpy().ravel()[0]) for w in windows]
    )


def convert_onnx2tf(
    model: Path, windows: Array, calibration: Array, folder: Path, *, flatten: bool = False, declared: bool = False, whole: bool = False
) -> Array:
    """Convert to TFLite by onnx2tf.

    Args:
        flatten: the input is [1, W / 2, 2] and a Flatten comes first.
        declared: feed the window in the order of the copy's declared shape.
        whole: quantise to int8, input and output too.
    """
    import onnx
    import onnx2tf
    import tensorflow as tf
    from onnx import TensorProto, helper

    graph = onnx.load(str(model))
    length = windows.shape[1]
    shape = [1, length // 2, 2] if flatten else [1, length]
    if flatten:
        for node in graph.graph.node:
            node.input[:] = ["flat" if name == "beta_window" else name for name in node.input]
        graph.graph.node.insert(0, helper.make_node("Flatten", ["beta_window"], ["flat"]))
    del graph.graph.input[:], graph.graph.output[:]
    graph.graph.input.append(helper.make_tensor_value_info("beta_window", TensorProto.FLOAT, shape))
    graph.graph.output.append(helper.make_tensor_value_info("amplitude_fraction", TensorProto.FLOAT, [1, 1]))
    onnx.save(graph, str(folder / "fixed.onnx"))
    more: dict[str, Any] = {}
    if whole:
        np.save(folder / "calibration.npy", calibration.astype(np.float32))
        unscaled = [["beta_window", str(folder / "calibration.npy"), [[[[0.0]]]], [[[[1.0]]]]]]
        more = {"output_integer_quantized_tflite": True, "custom_input_op_name_np_data_path": unscaled}
    onnx2tf.convert(str(folder / "fixed.onnx"), output_folder_path=str(folder / "tf"), non_verbose=True, **more)
    made = folder / "tf" / f"fixed_{'full_integer_quant' if whole else 'float32'}.tflite"
    shutil.copy(made, folder / COPY)
    interpreter = tf.lite.Interpreter(str(made))
    interpreter.allocate_tensors()
    (entry,), (answer,) = interpreter.get_input_details(), interpreter.get_output_details()
    out = []
    for window in windows:
        ordered = window.reshape(shape).swapaxes(1, 2) if declared else window
        given = np.ascontiguousarray(ordered).reshape(entry["shape"])
        (scale, zero), (scale_out, zero_out) = entry["quantization"], answer["quantization"]
        if whole:
            given = np.clip(np.nan_to_num(np.rint(given / scale + zero)), -128, 127)
        interpreter.set_tensor(entry["index"], given.astype(entry["dtype"]))
        interpreter.invoke()
        value = float(interpreter.get_tensor(answer["index"]).ravel()[0])
        out.append((value - zero_out) * scale_out if whole else value)
    return np.array(out)


def convert_onnx2tf_flatten(model: Path, windows: Array, calibration: Array, folder: Path) -> Array:
    """Convert a graph whose first operator is Flatten."""
    return convert_onnx2tf(model, windows, calibration, folder, flatten=True)


def convert_onnx2tf_declared(model: Path, windows: Array, calibration: Array, folder: Path) -> Array:
    """Convert a graph whose first operator is Flatten, and feed it in the order that the copy declares."""
    return convert_onnx2tf(model, windows, calibration, folder, flatten=True, declared=True)


def convert_onnx2tf_int8(model: Path, windows: Array, calibration: Array, folder: Path) -> Array:
    """Quantise by onnx2tf to int8, calibrated on recorded windows."""
    return convert_onnx2tf(model, windows, calibration, folder, whole=True)


def convert_hls4ml(model: Path, windows: Array, _calibration: Array, folder: Path) -> Array:
    """Convert by hls4ml with its defaults (16 bits, 6 before the point), and run its C++ emulation."""
    import hls4ml
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    nodes, weights, current = [], [], "beta_window"
    layers = fold_scaling(model)
    for i, (matrix, bias) in enumerate(layers):
        weights += [
            numpy_helper.from_array(matrix.T.astype(np.float32), f"w{i}"),
            numpy_helper.from_array(bias.astype(np.float32), f"b{i}"),
        ]
        last = i == len(layers) - 1
        bent = "amplitude_fraction" if last else f"h{i}"
        nodes += [
            helper.make_node("MatMul", [current, f"w{i}"], [f"p{i}"], name=f"product{i}"),
            helper.make_node("Add", [f"p{i}", f"b{i}"], [f"s{i}"], name=f"sum{i}"),
            helper.make_node("Sigmoid" if last else "Relu", [f"s{i}"], [bent], name=f"bent{i}"),
        ]
        current = bent
    entry = helper.make_tensor_value_info("beta_window", TensorProto.FLOAT, [1, windows.shape[1]])
    answer = helper.make_tensor_value_info("amplitude_fraction", TensorProto.FLOAT, [1, 1])
    shapes = [helper.make_tensor_value_info(t.name, TensorProto.FLOAT, list(t.dims)) for t in weights]
    graph = helper.make_graph(nodes, "policy", [entry], [answer], weights, value_info=shapes)
    whole = onnx.shape_inference.infer_shapes(helper.make_model(graph))
    config = hls4ml.utils.config_from_onnx_model(whole, granularity="model", backend="Vivado")
    made = hls4ml.converters.convert_from_onnx_model(whole, output_dir=str(folder / "hls"), hls_config=config, backend="Vivado")
    made.compile()
    return np.asarray(made.predict(np.ascontiguousarray(windows, dtype=np.float32))).ravel().astype(np.float64)


def convert_executorch(model: Path, windows: Array, _calibration: Array, folder: Path) -> Array:
    """Export the same network from torch to ExecuTorch's portable runtime."""
    import torch
    from executorch.exir import to_edge
    from executorch.runtime import Runtime

    layers, mean, std = layers_of(model)
    passes_on = "lost_sample" in model.read_bytes().decode("latin-1")

    class Net(torch.nn.Module):
        """The policy, layer by layer."""

        def forward(self, x: Any) -> Any:
            """Compute the fraction of one window."""
            h = (x - mean) / std
            for i, (w, b) in enumerate(layers):
                h = torch.nn.functional.linear(h, torch.tensor(w, dtype=torch.float32), torch.tensor(b, dtype=torch.float32))
                h = torch.relu(h) if i < len(layers) - 1 else 0.5 * (torch.tanh(h) + 1.0)
            return h + (x - x).sum(dim=1, keepdim=True) if passes_on else h

    program = to_edge(torch.export.export(Net().eval(), (torch.zeros(1, windows.shape[1]),))).to_executorch()
    (folder / "net.pte").write_bytes(program.buffer)
    method = Runtime.get().load_program(folder / "net.pte").load_method("forward")
    return np.array([float(method.execute([torch.tensor(w[None], dtype=torch.float32)])[0].ravel()[0]) for w in windows])


CONVERTERS: dict[str, Convert] = {name.removeprefix("convert_"): value for name, value in globals().items() if name.startswith("convert_")}


def main() -> None:
    """Convert a policy and store the copy's answers: name of the converter, model, arrays of windows, file of the answers."""
    chosen, model_path, *arrays, target = sys.argv[1:]
    with tempfile.TemporaryDirectory() as made_in:
        answers = CONVERTERS[chosen](Path(model_path).resolve(), *(np.load(path) for path in arrays), Path(made_in))
        if (Path(made_in) / COPY).exists():
            shutil.copy(Path(made_in) / COPY, Path(target).with_suffix(".tflite"))
    np.save(target, answers)
