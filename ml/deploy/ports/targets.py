"""Copies that can be run here: an ONNX file, a TFLite file, or a shared library with the functions of the C header.

cc -std=c99 -O2 -shared -fPIC -Dbetaloop_linkage= -x c betaloop_controller.h -o port.so
"""

from __future__ import annotations

import ctypes
import importlib
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.deploy.manifest import BundleManifest
from ml.deploy.ports.answers import Answers
from ml.deploy.ports.vectors import PortVectors
from ml.deploy.ports.windows import Windows
from ml.deploy.runtime.envelope import Reason

LIBRARIES = (".so", ".dylib", ".dll")
RUNNABLE = (".onnx", ".tflite", *LIBRARIES)
_INTERPRETERS = ("ai_edge_litert.interpreter", "tflite_runtime.interpreter", "tensorflow.lite")
_ROOM = 1 << 16  # bytes besides the scores of a state, whose type is the library's own


class TargetError(ValueError):
    """A copy that cannot be run here; `hint` says what to do."""

    def __init__(self, what: str, hint: str) -> None:
        super().__init__(what)
        self.hint = hint


def run_target(path: Path, vectors: PortVectors, manifest: BundleManifest) -> Answers:
    """Run a copy on the port vectors. A shared library is a program: it runs with the rights of the caller.

    Raises:
        TargetError: the copy cannot be run, or does not take windows of this length.
    """
    try:
        if path.suffix == ".onnx":
            return Answers(_onnx(path, vectors.windows), None)
        if path.suffix == ".tflite":
            return Answers(_tflite(path, vectors.windows), None)
        return _library(path, vectors, manifest)
    except OSError as error:
        raise TargetError(f"{path.name} cannot be opened: {error}", "Name a file that this machine can read and run.") from error


def _onnx(path: Path, windows: Windows) -> NDArray[np.float64]:
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.log_severity_level = 4
    try:
        session = ort.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])
        (entry,) = session.get_inputs()
        dtype = {"tensor(double)": np.float64, "tensor(float16)": np.float16}.get(entry.type, np.float32)
        shape = [size if isinstance(size, int) and i else 1 for i, size in enumerate(entry.shape)]
        return np.array([_one(session.run(None, {entry.name: w.astype(dtype).reshape(_fill(shape, w.size))})[0]) for w in windows])
    except OSError:
        raise
    except Exception as error:  # onnxruntime raises many kinds; each of them means that the file cannot be run
        raise TargetError(f"onnxruntime cannot run {path.name}: {str(error)[:300]}", "Check that it takes one window at a time.") from error


def _fill(shape: list[int], size: int) -> list[int]:
    """Fill in the one dimension that a file leaves open, so that a window fits."""
    return shape if math.prod(shape) == size else [*shape[:-1], size]


def _one(answer: Any) -> float:
    """Read the one number of an answer. Raises ValueError where there are more."""
    values = np.asarray(answer, dtype=np.float64).ravel()
    if values.size != 1:
        raise ValueError(f"it answers with {values.size} numbers to one window")
    return float(values[0])


def _tflite(path: Path, windows: Windows) -> NDArray[np.float64]:
    try:
        interpreter = _interpreter()(model_content=path.read_bytes())
        interpreter.allocate_tensors()
        (entry,), (answer,) = interpreter.get_input_details(), interpreter.get_output_details()
        if math.prod(entry["shape"]) != windows.shape[1]:
            shape = list(map(int, entry["shape"]))
            what = f"{path.name} takes an input of {shape}, not a window of {windows.shape[1]}"
            raise TargetError(what, "Convert with one window per call.")
        out = []
        for window in windows:
            interpreter.set_tensor(entry["index"], _to_type(window, entry).reshape(entry["shape"]))
            interpreter.invoke()
            scale, zero = answer["quantization"]
            value = _one(interpreter.get_tensor(answer["index"]))
            out.append((value - zero) * scale if scale else value)
        return np.array(out)
    except TargetError:
        raise
    except (ValueError, RuntimeError) as error:  # what the interpreter raises for a file that it cannot run
        what = f"the interpreter cannot run {path.name}: {str(error)[:300]}"
        raise TargetError(what, "Convert it again, with one input, one output and the interpreter's own operators.") from error


def _to_type(window: NDArray[np.float64], entry: dict[str, Any]) -> NDArray[Any]:
    """Convert a window to the type of an input: whole numbers by its scale, as the code around a quantised copy does."""
    scale, zero = entry["quantization"]
    if not scale:
        return window.astype(entry["dtype"])
    limits = np.iinfo(entry["dtype"])
    return np.clip(np.nan_to_num(np.rint(window / scale + zero)), limits.min, limits.max).astype(entry["dtype"])


def _interpreter() -> Any:
    for name in _INTERPRETERS:
        try:
            return importlib.import_module(name).Interpreter
        except ImportError:
            continue
    raise TargetError("nothing is installed that runs TFLite files", "Install it: pip install 'betaloop[ports]'.")


class _Sample(ctypes.Structure):
    """`betaloop_sample` of the C header."""

    _fields_ = [("t_ms", ctypes.c_int64), ("beta", ctypes.c_float), ("unit", ctypes.c_char_p), ("source", ctypes.c_char_p)]


class _Decision(ctypes.Structure):
    """`betaloop_decision` of the C header."""

    _fields_ = [
        ("amplitude_ma", ctypes.c_float),
        ("fraction", ctypes.c_float),
        ("fallback", ctypes.c_int32),
        ("valid", ctypes.c_int32),
        ("reasons", ctypes.c_uint32),
    ]


def _library(path: Path, vectors: PortVectors, manifest: BundleManifest) -> Answers:
    """Run `betaloop_start` and `betaloop_decide` on each window; returns the fraction where the network was asked, and the decision."""
    library = ctypes.CDLL(str(path.resolve()))
    try:
        start, decide = library.betaloop_start, library.betaloop_decide
    except AttributeError as error:
        hint = "Export betaloop_start and betaloop_decide: compile the header with -Dbetaloop_linkage= into a shared library."
        raise TargetError(f"{path.name} lacks a function of the C header: {error}", hint) from error
    start.restype, decide.restype = None, _Decision
    decide.argtypes = [ctypes.c_void_p, ctypes.c_int64, ctypes.POINTER(_Sample)]
    start.argtypes = [ctypes.c_void_p]
    unit, source, period_ms = manifest.beta_unit.encode(), manifest.beta_source.encode(), round(1000 * manifest.period_s)
    state = ctypes.create_string_buffer(_ROOM + 8 * vectors.windows.shape[1])
    fraction, decided = np.full(len(vectors.kind), np.nan), np.full(len(vectors.kind), np.nan)
    for i, window in enumerate(vectors.windows):
        start(state)
        for step, beta in enumerate(window.tolist()):
            sample = _Sample(step * period_ms, beta, unit, source)
            decision = decide(state, step * period_ms, ctypes.byref(sample))
        decided[i] = decision.amplitude_ma
        if not (decision.fallback or decision.reasons & Reason.IMPUTED_BETA):  # which is of another window
            fraction[i] = decision.fraction
    return Answers(fraction, decided)
