"""Policy files made elsewhere: plain networks are read from their graph and leave in every form; for others the reason is given."""

from __future__ import annotations

import dataclasses
import io
import shutil
import subprocess
import zipfile

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from ml.deploy.bundle import build_bundle, open_bundle, verify_bundle
from ml.deploy.fixed_point import SCORE_LIMIT, _quantise, quantise
from ml.deploy.onnx_mlp import NoPlainNetwork, mlp_of
from ml.deploy.vectors import edge_windows
from ml.policies.onnx_policy import OnnxPolicy
from ml.rl import MlpPolicy

W = 10
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-Wconversion", "-O2")


class Graph:
    """Writes a policy file operator by operator, as a user's exporter would."""

    def __init__(self, dtype=np.float32):
        self.dtype, self.nodes, self.constants, self.at = dtype, [], {}, "x"

    def add(self, operator, *constants, first=False, **attributes):
        names = []
        for value in constants:
            value = np.asarray(value)
            name = f"c{len(self.constants)}"
            self.constants[name] = value if value.dtype == np.int64 else value.astype(self.dtype)
            names.append(name)
        out = f"v{len(self.nodes)}"
        inputs = [*names, self.at] if first else [self.at, *names]
        self.nodes.append(helper.make_node(operator, inputs, [out], **attributes))
        self.at = out
        return self

    def file(self, opset=17):
        kind = TensorProto.FLOAT if self.dtype == np.float32 else TensorProto.DOUBLE
        graph = helper.make_graph(
            self.nodes,
            "other",
            [helper.make_tensor_value_info("x", kind, ["N", W])],
            [helper.make_tensor_value_info(self.at, kind, ["N", 1])],
            [numpy_helper.from_array(value, name) for name, value in self.constants.items()],
        )
        return helper.make_model(graph, ir_version=8, opset_imports=[helper.make_opsetid("", opset)]).SerializeToString()


def draw(seed=0):
    rng = np.random.default_rng(seed)
    return lambda *shape: rng.normal(0, 1 / np.sqrt(shape[0]), shape)


def sigmoid_of_tanh_layers(mean, std):
    n = draw(1)
    g = Graph().add("Sub", np.full(W, mean)).add("Div", np.full((1, W), std))
    for i, o in ((W, 16), (16, 8)):
        g = g.add("MatMul", n(i, o)).add("Add", n(1, o)).add("Tanh")
    return g.add("MatMul", 3 * n(8, 1)).add("Add", [0.2]).add("Sigmoid").file()


def clipped_line_of_relu_layers(mean, std):
    n = draw(2)
    first = n(W, 24)
    g = Graph().add("Gemm", first / std, -(np.ones(W) * mean / std) @ first).add("Relu")
    return g.add("Gemm", n(1, 24), [[0.4]], transB=1, alpha=0.5).add("Clip", np.float32(0.1), np.float32(0.9)).file()


def standard_scaler_per_position(mean, std):
    n = draw(3)
    means, stds = mean * (1 + 0.02 * np.arange(W)), std * (1 + 0.03 * np.arange(W))
    g = Graph().add("Sub", means).add("Mul", 1 / stds).add("Gemm", n(W, 12), n(12)).add("Relu")
    g = g.add("BatchNormalization", 1 + n(12) ** 2, n(12), n(12), 1 + n(12) ** 2)
    return g.add("Gemm", n(12, 6), n(6)).add("Sigmoid").add("Gemm", 4 * n(6, 1), [-1.0]).add("Tanh").add("Mul", 0.4).add("Add", 0.5).file()


def logistic_layers_without_scaling(mean, std):
    n = draw(4)
    g = Graph(np.float64).add("Mul", 1 / mean).add("MatMul", n(W, 9)).add("Add", n(9)).add("Sigmoid").add("Identity")
    return g.add("MatMul", 4 * n(9, 1)).add("Add", -0.3).add("Sigmoid").file()


def single_layer(mean, std):
    return Graph().add("Sub", mean).add("Div", std).add("Gemm", draw(5)(W, 1), [0.5]).add("Max", 0.0).add("Min", 1.0).file()


def turned_around(mean, std):
    """Build c - x, a negated layer, and a clip by attributes, as before opset 11."""
    n = draw(6)
    g = Graph().add("Sub", np.full(W, mean), first=True).add("Div", std).add("Gemm", n(W, 5), n(5)).add("Neg").add("Relu")
    return g.add("Gemm", n(5, 1), [0.3]).add("Clip", min=0.0, max=1.0).file(opset=10)


PLAIN = [
    sigmoid_of_tanh_layers, clipped_line_of_relu_layers, standard_scaler_per_position, logistic_layers_without_scaling, single_layer,
    turned_around,
]  # fmt: skip
SCALES = [(120.0, 35.0), (0.8, 0.2), (2e4, 9e3)]


def usual_windows(mean, std, count=64):
    return np.abs(np.random.default_rng(7).normal(mean, std, (count, W)))


@pytest.mark.parametrize(("mean", "std"), SCALES)
@pytest.mark.parametrize("made", PLAIN)
def test_a_plain_network_made_elsewhere_is_read_from_its_graph_and_answers_as_onnxruntime_does(made, mean, std):
    content, usual = made(mean, std), usual_windows(mean, std)
    network = mlp_of(content, usual)
    windows = edge_windows(usual_windows(mean, 2 * std, 300))
    expected = OnnxPolicy(content, W).act(windows)
    assert np.ptp(expected) > 0.05, "a network that answers"
    np.testing.assert_allclose(network.act(windows), expected, atol=1e-5)
    for window, fraction in zip(windows[:40], expected[:40], strict=True):
        for beta in window:
            network.push(beta)
        assert network.fraction() == pytest.approx(fraction, abs=1e-5)


@pytest.mark.parametrize("made", PLAIN)
def test_it_leaves_with_header_whole_numbers_and_runner_which_all_give_the_test_vectors(made, manifest, tmp_path):
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler here (cc or gcc)")
    bare = dataclasses.replace(manifest, normalisation_mean=None, normalisation_std=None, device_max_ma=None)
    content = build_bundle(made(120.0, 35.0), bare, usual_windows(120.0, 35.0))
    stated = verify_bundle(content)
    assert stated.no_header is None
    assert stated.layers[0] == W
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(tmp_path)
    for name in ("selftest", "selftest_int8"):
        subprocess.run([compiler, *STRICT, f"{name}.c", "-o", name], cwd=tmp_path, check=True)
        ran = subprocess.run([tmp_path / name], capture_output=True, text=True, check=False)
        assert ran.returncode == 0, (name, ran.stdout)
    assert open_bundle(content).network.output == mlp_of(made(120.0, 35.0), usual_windows(120.0, 35.0)).output


@pytest.mark.parametrize("planes", [1, 2])
@pytest.mark.parametrize("made", PLAIN)
def test_whole_numbers_stay_within_their_bound_with_tanh_layers_and_lines_too(made, planes):
    network = mlp_of(made(120.0, 35.0), usual_windows(120.0, 35.0))
    fixed = _quantise(network, planes)
    rng, low = np.random.default_rng(3), max(-SCORE_LIMIT, -network.mean / network.std)
    scores = [rng.choice([low, SCORE_LIMIT], (10_000, W)), rng.uniform(low, SCORE_LIMIT, (10_000, W)), rng.normal(0, 1, (10_000, W))]
    windows = np.clip(np.concatenate(scores), low, None) * network.std + network.mean
    assert np.abs(fixed.act(windows) - network.act(fixed.cut(windows))).max() <= fixed.bound


def test_our_own_networks_are_read_to_the_last_bit():
    policy = MlpPolicy(W, (20, 10), mean=120.3, std=35.7, seed=2)
    network = mlp_of(policy.to_onnx(), usual_windows(120, 35))
    assert (network.mean, network.std) == (float(policy.mean), float(policy.std))
    for (weights, bias), layer in zip(network.layers, policy.layers, strict=True):
        np.testing.assert_array_equal(weights, layer.weight.detach().numpy())
        np.testing.assert_array_equal(bias, layer.bias.detach().numpy())
    assert (network.activations, network.output) == (("relu", "relu"), ("tanh", 0.5, 0.5, None, None))


def test_the_proportional_baseline_is_a_network_of_one_layer_and_a_constant_is_none():
    from app.learning.policies import constant_onnx, proportional_onnx
    from ml.policies.policy import ProportionalPolicy

    policy = ProportionalPolicy(90.0, 150.0, floor=0.3, newest=3)
    network = mlp_of(proportional_onnx(policy, W), usual_windows(120.0, 35.0))
    windows = usual_windows(120.0, 60.0)
    np.testing.assert_allclose(network.act(windows), policy.act(windows), atol=1e-5)
    with pytest.raises(NoPlainNetwork, match="Shape"):
        mlp_of(constant_onnx(0.5, W), windows)


def residual():
    g = Graph().add("Gemm", np.eye(W), np.zeros(W)).add("Relu")
    g.nodes.append(helper.make_node("Add", [g.at, "x"], ["sum"]))
    g.at = "sum"
    return g.add("Gemm", np.full((W, 1), 1e-3), [0.0]).add("Sigmoid").file()


def squared():
    g = Graph()
    g.nodes.append(helper.make_node("Mul", ["x", "x"], ["square"]))
    g.at = "square"
    return g.add("Gemm", np.full((W, 1), 1e-3), [0.0]).add("Sigmoid").file()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (residual(), "branches|one path"),
        (squared(), "one path"),
        (Graph().add("Gemm", np.ones((W, 4)), np.zeros(4)).add("LeakyRelu").add("Gemm", np.ones((4, 1)), [0.0]).file(), "LeakyRelu"),
        (Graph().add("Clip", np.float32(0), np.float32(1)).add("Gemm", np.ones((W, 1)), [0.0]).add("Sigmoid").file(), "follows a clip"),
        (Graph().add("Cast", to=TensorProto.INT32).add("Cast", to=TensorProto.FLOAT).add("Gemm", np.ones((W, 1)), [0.0]).file(), "Cast"),
        (Graph().add("Gemm", np.ones((W, 3)), np.zeros(3)).add("Softmax").add("Gemm", np.ones((3, 1)), [0.0]).file(), "Softmax"),
        (Graph().add("Reciprocal").add("Gemm", np.ones((W, 1)), [0.0]).file(), "Reciprocal"),
        (Graph().add("Div", np.ones(W), first=True).add("Gemm", np.ones((W, 1)), [0.0]).file(), "divides"),
        (Graph().add("Gemm", np.ones((W, 2)), np.zeros(2)).file(), "2 values instead of one"),
    ],
)  # fmt: skip
def test_of_a_graph_that_is_more_it_is_said_what_stands_in_the_way(content, reason):
    with pytest.raises(NoPlainNetwork, match=reason):
        mlp_of(content, usual_windows(120, 35))


def test_the_manifest_and_the_sheet_say_why_there_is_no_header(manifest):
    bare = dataclasses.replace(manifest, normalisation_mean=None, normalisation_std=None)
    content = build_bundle(residual(), bare, usual_windows(120.0, 35.0))
    stated = verify_bundle(content)
    assert stated.layers == ()
    assert "no plain multi-layer perceptron" in stated.no_header
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert "no plain multi-layer perceptron" in archive.read("sheet.html").decode()
        assert "betaloop_controller.h" not in archive.namelist()


def test_layers_that_lose_too_much_in_float32_give_no_header(manifest):
    """Weights that cancel: the double of the file is needed."""
    weights = np.array([1e9, -1e9, *[0.0] * 8])[:, None]
    content = Graph(np.float64).add("Gemm", weights, [0.0]).add("Mul", 1e-9).add("Mul", 5e-2).add("Sigmoid").add("Mul", 0.9).file()
    sharp = Graph(np.float64).add("Sub", 1e7).add("Gemm", np.array([40.0, -40.0, *[0.0] * 8])[:, None], [0.0]).add("Sigmoid").file()
    bare = dataclasses.replace(manifest, normalisation_mean=None, normalisation_std=None)
    windows = usual_windows(1e7, 3e-3)
    assert verify_bundle(build_bundle(content, bare, usual_windows(120.0, 35.0))).no_header is None
    assert "in float32 answer up to" in verify_bundle(build_bundle(sharp, bare, windows)).no_header


def test_a_line_without_limits_gets_no_whole_numbers():
    line = Graph().add("Mul", np.zeros(W)).add("Gemm", np.ones((W, 1)), [0.5]).file()
    assert quantise(mlp_of(line, usual_windows(120.0, 35.0))) is None


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), hidden=st.lists(st.sampled_from(["Relu", "Tanh", "Sigmoid"]), max_size=3), scaled=st.booleans())
def test_any_plain_chain_is_read_right(seed, hidden, scaled):
    rng = np.random.default_rng(seed)
    g, size = Graph(), W
    if scaled:
        g = g.add("Sub", rng.uniform(50, 150, rng.choice([1, W]))).add("Div", rng.uniform(20, 50, rng.choice([1, W])))
    else:
        g = g.add("Div", 100.0)
    for operator in hidden:
        units = int(rng.integers(1, 12))
        g = g.add("MatMul", rng.normal(0, 1 / np.sqrt(size), (size, units))).add("Add", rng.normal(0, 0.3, units)).add(operator)
        if rng.random() < 0.3:
            g = g.add("Mul", rng.normal(0, 1, units))
        size = units
    content = (
        g.add("Gemm", rng.normal(0, 1, (size, 1)), [0.1])
        .add(str(rng.choice(["Sigmoid", "Identity"])))
        .add("Clip", np.float32(0), np.float32(1))
        .file()
    )
    windows = usual_windows(100.0, 40.0, 50)
    np.testing.assert_allclose(mlp_of(content, windows).act(windows), OnnxPolicy(content, W).act(windows), atol=1e-5)


def test_a_damaged_file_of_our_own_is_no_network():
    model = onnx.load_model_from_string(MlpPolicy(W, (3,)).to_onnx())
    del model.graph.initializer[-1]
    with pytest.raises(NoPlainNetwork):
        mlp_of(model.SerializeToString())
