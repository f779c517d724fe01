"""Table of converters through the check of ports: does a converted copy stay the policy?

    python benchmarks/ports.py --environments FOLDER [--only NAME ...] [--write ports]

For each converter an environment is made in FOLDER, outside the repository, with pinned packages of the package index (some GB). Three
policies are converted: beta in uV, beta as a power of the order of a million, and proportional control with a Clip. `--quick` runs
betaloop's own C headers alone, which need no environment. A converter that cannot be installed or take a policy is listed with its reason.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from support.results import emit, run_benchmark

from ml.deploy.bundle import OpenBundle, build_bundle, open_bundle, unpack
from ml.deploy.manifest import BundleManifest
from ml.deploy.ports.answers import Answers, write_answers
from ml.deploy.ports.check import check_port, port_vectors
from ml.deploy.ports.report import fault_words, verdict_words
from ml.deploy.ports.targets import TargetError, run_target
from ml.deploy.ports.vectors import PortVectors
from ml.deploy.ports.windows import Recorded
from ml.rl import MlpPolicy

PROGRAM = "import converters; converters.main()"
SUPPORT = Path(__file__).parent / "support"
MAKE_S, CONVERT_S = 3600, 900
RUN_HERE = ("onnx2tf", "onnx2tf_int8")
"""Functions whose TFLite files `check-port` runs too."""


@dataclass(frozen=True)
class Converter:
    """A converter: what the table calls it, the function in `support/converters.py`, its environment with packages, and its policies."""

    name: str
    function: str
    environment: str
    packages: tuple[str, ...]
    policies: tuple[str, ...] = ("uV", "power")


ORT = ("onnxruntime==1.32.0", "onnx==1.23.2", "sympy")
ONNX2TF = ("onnx2tf==1.29.24",)
CONVERTERS = (
    Converter("onnxruntime 1.32.0, float", "float", "onnxruntime", ORT, ("uV", "power", "clip")),
    Converter("onnxruntime 1.32.0, quantize_dynamic", "dynamic", "onnxruntime", ORT, ("uV", "power", "clip")),
    Converter("onnxruntime 1.32.0, quantize_static", "static", "onnxruntime", ORT, ("uV", "power", "clip")),
    Converter("emlearn 0.23.2, scaling folded in", "emlearn", "emlearn", ("emlearn==0.23.2", "onnx==1.23.2", "setuptools")),
    Converter("tinygrad 0.14.0, DEV=PYTHON", "tinygrad", "tinygrad", ("tinygrad==0.14.0", "onnx==1.23.2"), ("uV",)),
    Converter("onnx2tf 1.29.24, 2-D input", "onnx2tf", "onnx2tf", ONNX2TF),
    Converter("onnx2tf 1.29.24, Flatten first, order of the ONNX file", "onnx2tf_flatten", "onnx2tf", ONNX2TF, ("uV",)),
    Converter("onnx2tf 1.29.24, Flatten first, order of its declared shape", "onnx2tf_declared", "onnx2tf", ONNX2TF, ("uV",)),
    Converter("onnx2tf 1.29.24, int8", "onnx2tf_int8", "onnx2tf", ONNX2TF, ("uV",)),
    Converter("hls4ml 1.3.0, defaults, scaling folded in", "hls4ml", "hls4ml", ("hls4ml[onnx]==1.3.0",), ("uV",)),
    Converter("executorch 1.5.1", "executorch", "executorch", ("executorch==1.5.1", "torch==2.13.0", "onnx==1.23.2")),
)


@dataclass(frozen=True)
class Case:
    """A policy as a bundle, unpacked in a folder with its windows as arrays."""

    folder: Path
    content: bytes
    opened: OpenBundle
    vectors: PortVectors


def make_case(folder: Path, mean: float, std: float, *, clip: bool = False) -> Case:
    """Make a bundle from three visits; with `clip` of proportional control, 0 at the mean and full dose one SD above."""
    rng = np.random.default_rng(0)
    visits = [Recorded(f"visit {n}", np.abs(rng.normal(mean, std, (size, 10)))) for n, size in ((1, 300), (2, 40), (3, 200))]
    manifest = BundleManifest(
        participant="P1", policy_id=1, policy_name="clip" if clip else "network", window=10, beta_unit="uV", beta_source="table",
        min_ma=0.5, max_ma=3.2, cdbs_ma=3.0, ramp_ma_per_s=0.25, beta_max=8 * mean, level_low=mean / 4, level_high=4 * mean,
        frozen_after=5, code_version="benchmark", test_windows_from="made",
    )  # fmt: skip
    if clip:
        policy = proportional(mean, std)
    else:
        network = MlpPolicy(10, (20, 10), mean=mean, std=std, seed=3)
        with torch.no_grad():
            network.layers[-1].weight.mul_(1000)
        policy = network.to_onnx()
        manifest = replace(manifest, normalisation_mean=mean, normalisation_std=std)
    content = build_bundle(policy, manifest, visits[0].windows[:16], visits)
    opened = open_bundle(content)
    vectors = port_vectors(content, opened.manifest)
    folder.mkdir(parents=True)
    for name, part in unpack(content).items():
        if "/" not in name:
            (folder / name).write_bytes(part)
    np.save(folder / "windows.npy", vectors.windows)
    recorded = np.char.startswith(np.array(vectors.kind), "visit") & (vectors.dose <= 0.5)
    np.save(folder / "calibration.npy", vectors.windows[recorded if clip else np.char.startswith(np.array(vectors.kind), "visit")])
    return Case(folder, content, opened, vectors)


def proportional(mean: float, std: float) -> bytes:
    """Write proportional control on the mean of the window: scaling, one Gemm, one Clip."""
    constants = {"beta_mean": [mean], "beta_std": [std], "weight": np.full((1, 10), 0.1 * 1.0), "bias": [0.0], "low": 0.0, "high": 1.0}
    nodes = [
        helper.make_node("Sub", ["beta_window", "beta_mean"], ["centred"]),
        helper.make_node("Div", ["centred", "beta_std"], ["scaled"]),
        helper.make_node("Gemm", ["scaled", "weight", "bias"], ["wish"], transB=1),
        helper.make_node("Clip", ["wish", "low", "high"], ["amplitude_fraction"]),
    ]
    graph = helper.make_graph(
        nodes, "proportional",
        [helper.make_tensor_value_info("beta_window", TensorProto.FLOAT, ["N", 10])],
        [helper.make_tensor_value_info("amplitude_fraction", TensorProto.FLOAT, ["N", 1])],
        [numpy_helper.from_array(np.asarray(value, dtype=np.float32), name) for name, value in constants.items()],
    )  # fmt: skip
    return bytes(helper.make_model(graph, ir_version=8, opset_imports=[helper.make_opsetid("", 17)]).SerializeToString())


def python_of(folder: Path, converter: Converter) -> Path:
    """Make the environment of a converter, if it is not there. Raises RuntimeError with pip's last line."""
    place = folder / converter.environment
    if not (place / "made").exists():
        subprocess.run([sys.executable, "-m", "venv", place], check=True)
        command = [place / "bin" / "python", "-m", "pip", "install", "-q", "--disable-pip-version-check", *converter.packages]
        installed = subprocess.run(command, capture_output=True, text=True, timeout=MAKE_S)
        if installed.returncode:
            raise RuntimeError(f"cannot be installed: {_last_line(installed.stderr)}")
        (place / "made").touch()
    return place / "bin" / "python"


def _last_line(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    return lines[-1][:140] if lines else "no reason given"


def answers_of(python: Path, function: str, model: Path, case: Case) -> np.ndarray:
    """Convert a model and run the copy. Raises RuntimeError with the converter's last line."""
    target = case.folder / f"{function}.npy"
    target.unlink(missing_ok=True)
    arguments = [function, model, case.folder / "windows.npy", case.folder / "calibration.npy", target]
    env = os.environ | {"PYTHONPATH": str(SUPPORT)}
    ran = subprocess.run([python, "-c", PROGRAM, *map(str, arguments)], capture_output=True, text=True, timeout=CONVERT_S, env=env)
    if ran.returncode:
        raise RuntimeError(_last_line(ran.stderr))
    return np.asarray(np.load(target))


def row(name: str, policy: str, case: Case, answers: Answers, passes_on: str) -> str:
    """Write a row of the table."""
    check = check_port(case.content, case.opened, write_answers(case.vectors, answers))
    faults = "; ".join(fault_words(fault, check) for fault in check.faults) or "none"
    return f"| {name} | {policy} | {verdict_words(check).split(':')[0]} | {faults} | {passes_on} |"


def convert_all(converter: Converter, folder: Path, cases: dict[str, Case]) -> Iterator[str]:
    """Yield the rows of a converter."""
    try:
        python = python_of(folder, converter)
    except (RuntimeError, subprocess.TimeoutExpired, subprocess.CalledProcessError) as error:
        yield f"| {converter.name} | | not tried | {error} | |"
        return
    for policy in converter.policies:
        case = cases[policy]
        try:
            answers = answers_of(python, converter.function, case.folder / "model.onnx", case)
        except (RuntimeError, subprocess.TimeoutExpired) as error:
            yield f"| {converter.name} | {policy} | not converted | {error} | |"
            continue
        copy = case.folder / f"{converter.function}.tflite"
        run_here = run_by_check(converter, policy, case, copy) if copy.exists() and converter.function in RUN_HERE else None
        try:
            lost = answers_of(python, converter.function, case.folder / "model-lost-sample.onnx", case)[case.vectors.without_dose]
            passes_on = "not passed on" if converter.function in ("emlearn", "hls4ml") else "yes" if np.isnan(lost).all() else "no"
        except (RuntimeError, subprocess.TimeoutExpired):
            passes_on = "not converted"
        yield row(converter.name, policy, case, Answers(answers, None), passes_on)
        if run_here is not None:
            yield run_here


def run_by_check(converter: Converter, policy: str, case: Case, copy: Path) -> str:
    """Write the row of a TFLite file that `check-port` runs itself, with `betaloop[ports]` installed here."""
    try:
        answers = run_target(copy, case.vectors, case.opened.manifest)
    except TargetError as error:
        return f"| {converter.name}, run by check-port | {policy} | not tried | {error} | |"
    name = f"{converter.name}, run by check-port with ai-edge-litert {version('ai-edge-litert')}"
    return row(name, policy, case, answers, "see above")


def own(cases: dict[str, Case]) -> Iterator[str]:
    """Yield the rows of betaloop's C headers."""
    compiler = shutil.which("cc")
    for name, header in (("betaloop C, float32", "betaloop_controller"), ("betaloop C, whole numbers", "betaloop_controller_int8")):
        for policy, case in cases.items():
            if compiler is None or not (case.folder / f"{header}.h").exists():
                yield f"| {name} | {policy} | not tried | no C compiler, or no header of this policy | |"
                continue
            options = ["-std=c99", "-O2", "-shared", "-fPIC", "-Dbetaloop_linkage=", "-x", "c"]
            subprocess.run([compiler, *options, f"{header}.h", "-o", f"{header}.so"], cwd=case.folder, check=True)
            answers = run_target(case.folder / f"{header}.so", case.vectors, case.opened.manifest)
            yield row(name, policy, case, answers, "cDBS by its envelope")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--environments", type=Path, help="folder for the environments of the converters")
    parser.add_argument("--only", nargs="*", default=[], help="functions of support/converters.py")
    parser.add_argument("--quick", action="store_true", help="betaloop's own headers alone")
    asked = parser.parse_args()
    if asked.environments is None and not asked.quick:
        parser.error("--environments FOLDER says where the converters are installed")
    with tempfile.TemporaryDirectory() as made_in:
        cases = {
            "uV": make_case(Path(made_in) / "uV", 30.0, 9.0),
            "power": make_case(Path(made_in) / "power", 1.2e6, 3.5e5),
            "clip": make_case(Path(made_in) / "clip", 30.0, 9.0, clip=True),
        }
        emit(f"onnx {onnx.__version__}, numpy {np.__version__}, Python {sys.version.split()[0]}; 3 mA is the full dose\n\n")
        emit("| converter | policy | verdict | faults | lost sample reaches the answer |\n|---|---|---|---|---|\n")
        for line in own(cases):
            emit(line + "\n")
        for converter in () if asked.quick else CONVERTERS:
            if not asked.only or converter.function in asked.only:
                for line in convert_all(converter, asked.environments, cases):
                    emit(line + "\n")
                    sys.stdout.flush()


if __name__ == "__main__":
    run_benchmark(main)
