"""The same answers from every form that a policy leaves in: torch, onnxruntime, numpy, C in float32 and in whole numbers."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ml.deploy.bundle import build_bundle, make_controller
from ml.deploy.c_header import comment, float_header, self_test, string_literal
from ml.deploy.fixed_point import SCORE_LIMIT, WANTED_BOUND, CutNetwork, _quantise, quantise
from ml.deploy.manifest import BundleError
from ml.deploy.onnx_mlp import mlp_of
from ml.deploy.runtime.controller import BoundedController
from ml.deploy.runtime.envelope import BetaSample, Signal
from ml.deploy.runtime.network import MlpNetwork
from ml.deploy.vectors import Step, edge_windows, session
from ml.deploy.windows import PolicyWindow
from ml.policies.onnx_policy import OnnxPolicy
from ml.rl import MlpPolicy

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-Wconversion", "-O2")
SANITISED = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g")


def policy_of(hidden, seed=3, gain=300.0, mean=120.0, std=35.0, window=10):
    policy = MlpPolicy(window, hidden, mean=mean, std=std, seed=seed)
    with torch.no_grad():
        policy.layers[-1].weight.mul_(gain)
    return policy


@pytest.fixture(scope="module")
def compiler():
    found = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if found is None:
        pytest.skip("no C compiler here (cc, gcc or clang)")
    return found


@pytest.fixture(scope="module")
def sanitiser(compiler, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sanitiser")
    (folder / "a.c").write_text("int main(void) { return 0; }\n")
    built = subprocess.run([compiler, *SANITISED, "a.c", "-o", "a"], cwd=folder, capture_output=True, check=False)
    if built.returncode or subprocess.run([folder / "a"], check=False).returncode:
        pytest.skip("this compiler has no address and undefined-behaviour sanitiser")
    return SANITISED


def unpacked(content, folder):
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(folder)
    return folder


def compiled_and_run(compiler, folder, name, *options):
    built = subprocess.run([compiler, *STRICT, *options, f"{name}.c", "-o", name], cwd=folder, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    ran = subprocess.run([folder / name], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


@pytest.mark.hazard("H22")
@pytest.mark.parametrize("hidden", [(20, 10), (400, 300), (1,), (7, 5, 3)])
@pytest.mark.parametrize(("mean", "std"), [(120.0, 35.0), (0.8, 0.05), (2e4, 9e3)])
def test_torch_onnxruntime_and_numpy_agree(hidden, mean, std):
    policy = policy_of(hidden, mean=mean, std=std)
    network, onnx = mlp_of(policy.to_onnx()), OnnxPolicy(policy.to_onnx(), 10)
    windows = edge_windows(np.abs(np.random.default_rng(1).normal(mean, 2 * std, (200, 10))))
    expected = policy.act(windows)
    np.testing.assert_allclose(onnx.act(windows), expected, atol=1e-5)
    np.testing.assert_allclose(network.act(windows), expected, atol=1e-5)
    for window, fraction in zip(windows[:50], expected[:50], strict=True):
        for beta in window:
            network.push(beta)
        assert network.fraction() == pytest.approx(fraction, abs=1e-5)


def test_weights_survive_their_file_and_no_other_file_is_taken_for_them():
    network = mlp_of(policy_of((20, 10)).to_onnx())
    again = MlpNetwork.from_bytes(network.to_bytes(), (10, 20, 10, 1), network.mean, network.std)
    windows = np.random.default_rng(0).normal(120, 40, (5, 10))
    np.testing.assert_array_equal(again.act(windows), network.act(windows))
    for content, sizes in [(network.to_bytes()[:-1], (10, 20, 10, 1)), (network.to_bytes(), (10, 21, 10, 1)), (b"", (10, 1))]:
        with pytest.raises(ValueError, match="do not fit layers"):
            MlpNetwork.from_bytes(content, sizes, 0.0, 1.0)
    with pytest.raises(ValueError, match="not a finite number"):
        MlpNetwork([(np.full((1, 2), np.nan, dtype=np.float32), np.zeros(1, dtype=np.float32))], 0.0, 1.0)
    with pytest.raises(ValueError, match="fit together"):
        MlpNetwork([(np.zeros((2, 2), dtype=np.float32), np.zeros(2, dtype=np.float32))], 0.0, 1.0)


@pytest.mark.parametrize("hidden", [(20, 10), (400, 300), (1,)])
def test_the_c_controller_gives_the_test_vectors_under_strict_c99(compiler, tmp_path, manifest, test_windows, hidden):
    folder = unpacked(build_bundle(policy_of(hidden).to_onnx(), manifest, test_windows), tmp_path)
    assert " 0 wrong" in compiled_and_run(compiler, folder, "selftest")
    if hidden != (400, 300):
        assert " 0 wrong" in compiled_and_run(compiler, folder, "selftest_int8")


def test_the_c_controllers_have_no_undefined_behaviour(compiler, sanitiser, tmp_path, manifest, test_windows):
    folder = unpacked(build_bundle(policy_of((20, 10)).to_onnx(), manifest, test_windows), tmp_path)
    for name in ("selftest", "selftest_int8"):
        assert " 0 wrong" in compiled_and_run(compiler, folder, name, *sanitiser)


EXTREME = """
#include <stdio.h>
#include "betaloop_controller.h"
static volatile float zero = 0.0f;
static uint64_t state = 88172645463325252u;
static uint64_t draw(void) { state ^= state << 13; state ^= state >> 7; state ^= state << 17; return state; }
int main(void) {
    betaloop_state s;
    int64_t now = 0;
    long i, fallbacks = 0;
    betaloop_start(&s);
    for (i = 0; i < 300000; ++i) {
        betaloop_sample b;
        betaloop_decision d;
        float before = s.amplitude_ma;
        uint64_t kind = draw() % 300;
        if (kind < 3) now = kind == 0 ? INT64_MAX : kind == 1 ? INT64_MIN : (int64_t)draw();
        else if (kind >= 10) now = now > INT64_MAX / 2 ? 0 : now + 2000;
        b.t_ms = draw() % 97 ? now : (int64_t)draw();
        b.beta = draw() % 61 ? (float)(draw() % 400) : draw() % 2 ? zero / zero : draw() % 2 ? -1.0f / zero : 3e38f;
        b.unit = draw() % 89 ? BETALOOP_UNIT : draw() % 2 ? "mV" : 0;
        b.source = draw() % 89 ? BETALOOP_SOURCE : "";
        d = betaloop_decide(&s, now, draw() % 53 ? &b : 0);
        if (!(d.amplitude_ma >= BETALOOP_MIN_MA && d.amplitude_ma <= BETALOOP_MAX_MA)) return 1;
        if (d.fallback && (d.amplitude_ma != BETALOOP_CDBS_MA || !d.reasons)) return 2;
        if (!d.fallback) {
            float change = d.amplitude_ma - before;
            if ((uint64_t)now - (uint64_t)s.last_sample_ms >= BETALOOP_PERIOD_MS) return 5;
            if (change < 0) change = -change;
            if (change > BETALOOP_RAMP_MA_PER_S * BETALOOP_PERIOD_MS * 0.001f + 1e-6f) return 3;
            if (d.valid != BETALOOP_WINDOW) return 4;
        }
        fallbacks += d.fallback;
    }
    printf("%ld", fallbacks);
    return 0;
}
"""


def test_whatever_comes_the_c_envelope_keeps_the_limits(compiler, sanitiser, tmp_path, manifest, test_windows):
    folder = unpacked(build_bundle(policy_of((20, 10)).to_onnx(), manifest, test_windows), tmp_path)
    (folder / "extreme.c").write_text(EXTREME)
    fallbacks = int(compiled_and_run(compiler, folder, "extreme", *sanitiser))
    assert 1000 < fallbacks < 299_000, "both the network and the fall-back had their turn"


def test_the_constants_of_the_c_header_lie_inside_the_clinicians_limits(manifest):
    network = mlp_of(policy_of((3,)).to_onnx())
    for low, high in [(0.1, 3.1), (0.3, 2.9), (0.7, 3.3)]:
        text = float_header(dataclasses.replace(manifest, min_ma=low, max_ma=high, cdbs_ma=high, device_max_ma=None), network)
        stated = {line.split()[1]: line.split()[2] for line in text.splitlines() if line.startswith("#define BETALOOP_M")}
        assert (
            low
            <= float(np.float32(stated["BETALOOP_MIN_MA"].rstrip("f")))
            <= float(np.float32(stated["BETALOOP_MAX_MA"].rstrip("f")))
            <= high
        )
    with pytest.raises(BundleError, match="whole milliseconds"):
        float_header(dataclasses.replace(manifest, period_s=1 / 3), network)


def random_steps(manifest, network, count, seed):
    """Draw a session in which anything comes at any time, and what the Python controller decides."""
    rng = np.random.default_rng(seed)
    signal = Signal(manifest.beta_unit, manifest.beta_source)
    controller, steps, now = BoundedController(network, manifest.limits(), signal), [], 0.0
    for _ in range(count):
        now = max(
            round(now + float(rng.choice([2.0, 2.0, 2.0, 2.0, 2.001, 1.5, 0.0, 7.0, -3.0], p=[0.5, 0.2, 0.2, 0.06, *[0.008] * 5])), 3), 0.0
        )
        t_s = None if rng.random() < 0.01 else round(now + float(rng.choice([0.0, -0.4, 0.5, -2.0], p=[0.97, 0.01, 0.01, 0.01])), 3)
        beta = float(np.float32(abs(rng.normal(120, 40)))) if rng.random() > 0.01 else float(rng.choice([math.nan, -1.0]))
        said = signal if rng.random() > 0.005 else Signal("mV", manifest.beta_source)
        decision = controller.decide(now, None if t_s is None else BetaSample(t_s, beta, said))
        steps.append(Step(now, t_s, beta, *said, decision.amplitude_ma, decision.reasons))
    return steps


def test_c_decides_as_python_does_whatever_comes(compiler, tmp_path, manifest):
    network = mlp_of(policy_of((20, 10)).to_onnx())
    steps = random_steps(manifest, network, 20_000, 5)
    share = np.mean([s.reasons & 511 & ~64 != 0 for s in steps])
    assert 0.2 < share < 0.9, "both the network and the fall-back had their turn"
    (tmp_path / "betaloop_controller.h").write_text(float_header(manifest, network))
    windows = np.ones((1, 10))
    test = self_test(manifest, "betaloop_controller.h", windows, network.act(windows), steps, 1e-5, exact=True)
    (tmp_path / "selftest.c").write_text(test)
    assert "steps 20000" in compiled_and_run(compiler, tmp_path, "selftest")


NASTY = ["*/ int evil; /*", "??/\n#error", "\\\n", 'a"; system("x"); "', "Zoë µV ☃", "%s%n", "\x00\r\n//", "-->"]


@pytest.mark.parametrize("text", NASTY)
def test_no_name_can_leave_its_place_in_the_c_text(compiler, tmp_path, manifest, text):
    network = mlp_of(policy_of((3,)).to_onnx())
    changed = dataclasses.replace(
        manifest, participant="P" + text, policy_name="N" + text, code_version="v" + text, beta_unit="u" + text, beta_source="s" + text
    )
    windows = np.ones((1, 10))
    steps = session(changed, make_controller(changed, network), windows)
    (tmp_path / "betaloop_controller.h").write_text(float_header(changed, network), encoding="ascii")
    test = self_test(changed, "betaloop_controller.h", windows, network.act(windows), steps, 1e-5, exact=True)
    (tmp_path / "selftest.c").write_text(test, encoding="ascii")
    if "\x00" not in text:  # C strings end there
        assert " 0 wrong" in compiled_and_run(compiler, tmp_path, "selftest")


@given(st.text())
def test_comments_and_strings_let_nothing_through_that_could_end_them(text):
    assert not set(comment(text)) & set('*/\\?"\n\r')
    literal = string_literal(text)
    assert literal.isascii()
    assert not set(literal[1:-1]) & set('"?\n\r')
    back = literal[1:-1].encode().decode("unicode_escape").encode("latin-1").decode()
    assert back == text or "\ud800" <= min(text, default="") <= "\udfff"


def test_the_runner_of_a_bundle_checks_and_runs_it_with_numpy_alone(tmp_path, manifest, test_windows):
    policy = policy_of((20, 10))
    folder = unpacked(build_bundle(policy.to_onnx(), manifest, test_windows), tmp_path)
    barred = "import sys\nfor name in ('torch', 'onnx', 'onnxruntime', 'scipy', 'ml', 'app'): sys.modules[name] = None\n"
    arguments = ["controller", ".", "--run", "--bench", "--replay"]
    code = f"{barred}import runpy\nsys.argv = {arguments}\nrunpy.run_module('controller', run_name='__main__')\n"
    betas = [str(b) for b in test_windows.ravel()[:12]] + ["", "nan", "120"]
    ran = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, input="\n".join(betas), check=False)
    assert ran.returncode == 0, ran.stderr
    assert "test vectors agree" in ran.stderr
    lines = ran.stdout.splitlines()
    assert len(lines) == 15
    assert lines[0] == "3 window_incomplete"
    wish = float(policy.act(test_windows.ravel()[None, :10])[0]) * 3.0
    assert float(lines[9].split()[0]) == pytest.approx(min(max(wish, 2.5), 3.2), abs=1e-5)
    assert lines[12:14] == ["3 invalid_beta", "3 invalid_beta"]
    assert "imputed_beta" in lines[14]
    assert "invalid_beta" not in lines[14]
    (folder / "weights.f32").write_bytes(b"0" * 1764)
    again = subprocess.run([sys.executable, "-m", "controller"], cwd=folder, capture_output=True, text=True, check=False)
    assert again.returncode == 1
    assert "weights.f32 is not the file" in again.stderr


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("planes", [1, 2])
def test_the_error_of_whole_numbers_stays_below_its_bound_at_corners_and_between(seed, planes):
    rng = np.random.default_rng(seed)
    hidden = [(20, 10), (5,), (30, 20), (8, 8, 8), (20, 10), (20, 10)][seed]
    network = mlp_of(
        policy_of(hidden, seed=seed, gain=[300, 30, 100, 1000, 1, 0][seed], mean=[120, 0.8, 5, 120, 1.3, 60][seed], std=1.0).to_onnx()
    )
    fixed = _quantise(network, planes)
    low, high = max(-SCORE_LIMIT, -network.mean / network.std), SCORE_LIMIT
    corners = rng.choice([low, high], (20_000, 10))
    between = rng.uniform(low, high, (20_000, 10))
    usual = np.clip(rng.normal(0, 1, (20_000, 10)), low, None)
    windows = np.concatenate([corners, between, usual]) * network.std + network.mean
    error = np.abs(fixed.act(windows) - network.act(fixed.cut(windows)))
    assert error.max() <= fixed.bound


def test_the_bound_of_one_layer_is_the_true_worst_error():
    """One row, no hidden layer: the error is linear in the inputs, and the corner with the signs of the weights' errors reaches it."""
    weights = np.array([[0.4, -0.3, 0.21, 0.11]], dtype=np.float32)
    network = MlpNetwork([(weights, np.zeros(1, dtype=np.float32))], mean=0.0, std=1.0)
    fixed = _quantise(network, 1)
    kept = fixed.layers[0].planes[0][0] * fixed.layers[0].unit[0] * 32767 / SCORE_LIMIT
    worst = np.abs(weights[0] - kept).sum() * SCORE_LIMIT + np.abs(kept).sum() * SCORE_LIMIT / 32767 / 2
    assert fixed.bound == pytest.approx(math.tanh(worst / 2), abs=1e-5)


def test_two_planes_are_used_where_one_keeps_too_little_and_none_where_it_is_no_implants_network():
    network = mlp_of(policy_of((20, 10), gain=100).to_onnx())
    one, chosen = _quantise(network, 1), quantise(network)
    assert one.bound > WANTED_BOUND > chosen.bound
    assert (one.planes, chosen.planes) == (1, 2)
    assert chosen.size_bytes - one.size_bytes == network.layers[0][0].size + network.layers[1][0].size + network.layers[2][0].size
    assert quantise(mlp_of(policy_of((20, 10), gain=1).to_onnx())).planes == 1
    assert quantise(mlp_of(policy_of((400, 300)).to_onnx())) is None


def test_windows_beyond_the_inputs_are_cut_and_the_bound_is_against_the_cut_window():
    network = mlp_of(policy_of((20, 10)).to_onnx())
    fixed = quantise(network)
    windows = np.array([np.full(10, 1e5), np.zeros(10), np.r_[np.full(9, 120.0), 1e6]])
    assert np.abs(fixed.act(windows) - network.act(fixed.cut(windows))).max() <= fixed.bound
    cut = CutNetwork(network, fixed)
    for beta in windows[2]:
        cut.push(beta)
    assert cut.fraction() == pytest.approx(network.act(fixed.cut(windows[2:]))[0], abs=1e-5)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_the_c_text_of_any_network_reads_back_as_the_same_float32(seed):
    network = mlp_of(policy_of((3, 2), seed=seed).to_onnx())
    numbers = np.concatenate([a.ravel() for layer in network.layers for a in layer])
    from ml.deploy.c_header import _float

    assert all(np.float32(_float(v).rstrip("f")) == v for v in numbers)


def test_a_policy_window_gives_what_the_policy_gives_and_refuses_more_than_one_number():
    policy = policy_of((4,))
    window = PolicyWindow(policy, 10)
    betas = np.random.default_rng(2).normal(120, 30, 14)
    for beta in betas:
        window.push(beta)
    assert window.fraction() == pytest.approx(policy.act(betas[None, -10:])[0])

    class Two:
        def act(self, states):
            return np.zeros(2)

    with pytest.raises(ValueError, match=r"shape \[2\]"):
        PolicyWindow(Two(), 3).fraction()


@pytest.mark.hazard("H22")
def test_the_session_of_the_test_vectors_is_the_same_from_any_runtime(manifest, test_windows):
    policy = policy_of((20, 10))
    ours = session(manifest, make_controller(manifest, mlp_of(policy.to_onnx())), test_windows)
    onnx = session(manifest, make_controller(manifest, PolicyWindow(OnnxPolicy(policy.to_onnx(), 10), 10)), test_windows)
    assert [s.reasons for s in ours] == [s.reasons for s in onnx]
    np.testing.assert_allclose([s.amplitude_ma for s in ours], [s.amplitude_ma for s in onnx], atol=3e-5)
    assert json.dumps([s.now_s for s in ours]) == json.dumps(sorted(s.now_s for s in ours))


@pytest.mark.hazard("H22")
def test_the_shipped_runner_is_the_code_that_is_tested_here(manifest, test_windows, tmp_path):
    folder = unpacked(build_bundle(policy_of((3,)).to_onnx(), manifest, test_windows), tmp_path)
    import ml.deploy.runtime as runtime

    own = Path(runtime.__file__).parent
    assert {p.name: p.read_bytes() for p in (folder / "controller").iterdir()} == {p.name: p.read_bytes() for p in own.glob("*.py")}
