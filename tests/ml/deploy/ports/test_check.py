"""The check of a port: each kind of fault, made by arithmetic on the policy's own answers, is called by its name."""

from __future__ import annotations

import json
import shutil
import subprocess

import numpy as np
import pytest

from ml.deploy.bundle import build_bundle, open_bundle, unpack
from ml.deploy.fixed_point import quantise
from ml.deploy.manifest import BundleError
from ml.deploy.ports.answers import Answers, write_answers
from ml.deploy.ports.check import MOST_MA, NOT, SAME, WITHIN, PortCheck, check_port, port_vectors
from ml.deploy.ports.report import fault_words, headline, lines, page, verdict_words
from ml.deploy.ports.targets import TargetError, run_target
from tests.ml.deploy.ports.conftest import make_port


def codes(check: PortCheck) -> list[str]:
    return [fault.code for fault in check.faults]


def test_the_policys_own_answers_are_the_same(port):
    check = port.check(port.answers())
    assert (check.verdict, check.faults, verdict_words(check)) == (SAME, (), "same")
    assert check.worst_ma < 1e-5
    assert check.lost_windows == 55
    assert check.lost_numbers == 0


def test_a_clip_that_is_gone_shows_in_the_largest_dose(port):
    """As onnxruntime's static quantisation, whose largest dose is that of its calibration."""
    check = port.check(np.minimum(port.answers(), 0.5))
    assert check.verdict == NOT
    assert codes(check) == ["full_dose"]
    assert (check.highest_ma, round(check.highest_due_ma, 2)) == (1.5, 3.0)
    assert headline(check, "port of 12 Jan, ONNX") == (
        "port of 12 Jan, ONNX: the largest dose is 1.50 mA instead of 3.00 mA: not to be connected"
    )
    assert codes(port.check(np.maximum(port.answers(), 0.4))) == ["least_dose"]


def test_weights_of_six_decimals_with_the_scaling_folded_in(large_port):
    """As emlearn writes them, where beta is a power of the order of a million."""
    layers = [
        (layer.weight.detach().numpy().astype(float), layer.bias.detach().numpy().astype(float)) for layer in large_port.policy.layers
    ]
    weights, bias = layers[0]
    layers[0] = (weights / 3.5e5, bias - 1.2e6 / 3.5e5 * weights.sum(axis=1))
    hidden = large_port.vectors.windows
    for index, (weights, bias) in enumerate(layers):
        hidden = hidden @ np.round(weights, 6).T + np.round(bias, 6)
        hidden = np.maximum(hidden, 0) if index < len(layers) - 1 else (np.tanh(hidden) + 1) / 2
    check = large_port.check(hidden[:, 0])
    assert check.verdict == NOT
    assert (check.faults[0].code, check.faults[0].value) == ("rounded", 6)
    assert "weights are rounded to 6 decimals" in fault_words(check.faults[0], check)


@pytest.mark.parametrize(("order", "name"), [
    (np.arange(10)[::-1], "newest first"),
    (np.arange(10).reshape(2, 5).T.ravel(), "2 rows taken for columns"),
    (np.arange(10).reshape(5, 2).T.ravel(), "5 rows taken for columns"),
])  # fmt: skip
def test_a_window_read_in_another_order(port, order, name):
    """As onnx2tf reads it behind a Flatten."""
    check = port.check(port.answers(port.vectors.windows[:, order]))
    assert check.verdict == NOT
    assert (check.faults[0].code, check.faults[0].value) == ("order", name)


def test_a_number_format_that_wraps_at_32(port):
    """As 16 bits with 6 before the point: from 32 on beta counts as -32 and more."""
    check = port.check(port.answers((port.vectors.windows + 32.0) % 64.0 - 32.0))
    assert check.verdict == NOT
    assert (check.faults[0].code, check.faults[0].value) == ("wrap", 32.0)
    assert "beta from 32 on wraps round to -32" in headline(check, "FPGA")


def test_a_number_format_that_is_cut_at_32(port):
    check = port.check(port.answers(np.minimum(port.vectors.windows, 32.0)))
    assert (check.faults[0].code, check.faults[0].value) == ("cut", 32.0)


def test_a_lost_sample_that_gets_a_dose(port):
    """As from converters whose ReLU makes 0 of NaN: a dose without a measurement."""
    answers = port.answers()
    answers[np.isnan(answers)] = 0.86 / 3.0
    check = port.check(answers)
    assert (check.verdict, codes(check)) == (NOT, ["lost_sample"])
    assert headline(check, "port of 12 Jan, TFLite") == "port of 12 Jan, TFLite: a lost sample gets 0.86 mA: not to be connected"
    assert check.worst_ma < 1e-5, "everything else is the policy's"


@pytest.mark.parametrize("answer", [1.0, -1.0, np.nan, np.inf, 7.0])
def test_cdbs_or_what_the_envelope_refuses_is_right_for_a_lost_sample(port, answer):
    answers = port.answers()
    answers[np.isnan(answers)] = answer
    assert port.check(answers).verdict == SAME


def test_cdbs_for_some_lost_samples_and_a_dose_for_others_is_a_fault(port):
    answers = port.answers()
    lost = np.flatnonzero(np.isnan(answers))
    answers[lost], answers[lost[-1]] = 1.0, 0.4
    assert codes(port.check(answers)) == ["lost_sample"]


def test_answers_in_other_units(port):
    assert port.check(port.answers() * 3.0).faults[0].value == "mA"
    assert port.check(port.answers() * 100.0).faults[0].value == "per cent"


def test_a_small_difference_is_told_and_half_a_step_of_the_stimulator_is_the_limit(port):
    noise = np.random.default_rng(0).uniform(-1.0, 1.0, 400)
    near = port.check(np.clip(port.answers() + noise * 0.3 * MOST_MA / 3.0, 0.0, 1.0))
    assert near.verdict == WITHIN
    assert 0.005 < near.worst_ma <= 0.3 * MOST_MA
    assert verdict_words(near) in ("within 0.015 mA",)
    far = port.check(np.clip(port.answers() + noise * 1.5 * MOST_MA / 3.0, 0.0, 1.0))
    assert (far.verdict, far.faults[-1].code) == (NOT, "differs")


def test_one_wrong_window_of_400_is_enough(port):
    answers = port.answers()
    answers[7] += 0.2
    check = port.check(answers)
    assert (check.verdict, codes(check)) == (NOT, ["differs"])
    assert check.faults[0].count == 1


def test_complete_windows_without_an_answer_are_a_fault(port):
    answers = port.answers()
    answers[:3] = np.nan
    assert codes(port.check(answers)) == ["no_answer"]
    assert codes(port.check(np.full(400, np.nan))) == ["no_answer", "differs"]


def test_a_dose_that_falls_where_the_policys_rises(manifest):
    from app.learning.policies import proportional_onnx
    from ml.policies.policy import ProportionalPolicy

    windows = np.abs(np.random.default_rng(0).normal(30.0, 9.0, (64, 10)))
    content = build_bundle(proportional_onnx(ProportionalPolicy(20.0, 60.0, 0.2), 10), manifest, windows)
    opened = open_bundle(content)
    vectors = port_vectors(content, opened.manifest)
    fraction = opened.network.act(vectors.windows)
    fraction[vectors.without_dose] = np.nan
    levels = np.flatnonzero(np.array(vectors.kind) == "level")
    fraction[levels[12]] -= 0.3
    check = check_port(content, opened, write_answers(vectors, Answers(fraction, None)))
    assert check.monotone_due
    assert not check.monotone
    assert "monotone" in codes(check)


def test_whole_decisions_are_compared_too(port):
    due = port.vectors.decision_ma
    assert port.check(None, due).verdict == SAME
    lost = port.vectors.without_dose
    imputed = lost & (due < 3.0 - 1e-6)
    assert imputed.any(), "some lost samples may be imputed"
    assert codes(port.check(None, np.where(imputed, 0.86, due))) == ["differs"]
    wrong = port.check(None, np.where(lost & ~imputed, 0.86, due))
    assert codes(wrong) == ["lost_decision"]
    assert "after a lost sample 0.86 mA are delivered instead of cDBS, 3.00 mA" in headline(wrong, "x")
    assert "limits" in codes(port.check(None, np.where(lost, due, due + 1.0)))


def test_a_check_survives_json_and_stands_on_a_page(port):
    answers = port.answers()
    answers[np.isnan(answers)] = 0.3
    check = port.check(np.minimum(answers, 0.6))
    assert PortCheck.from_json(json.loads(json.dumps(check.to_json(), allow_nan=False))) == check
    printed = page(check, "TFLite <1>", "12 January 2026")
    for text in ("A lost sample gets", "TFLite &lt;1&gt;", check.answers_sha256, check.vectors_sha256, "not to be connected", "visit 2"):
        assert text in printed, text
    assert "to do: Put the guard in front of the network" in lines(check, "TFLite")


@pytest.fixture(scope="module")
def compiler():
    found = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if found is None:
        pytest.skip("no C compiler here (cc, gcc or clang)")
    return found


@pytest.mark.parametrize(("mean", "std"), [(30.0, 9.0), (1.2e6, 3.5e5), (0.8, 0.05)])
def test_our_own_onnx_c_and_whole_numbers_are_the_policy(manifest, compiler, tmp_path, mean, std):
    own = make_port(manifest, mean, std)
    for name, content in unpack(own.content).items():
        if "/" not in name:
            (tmp_path / name).write_bytes(content)
    for header in ("betaloop_controller", "betaloop_controller_int8"):
        options = ["-std=c99", "-O2", "-Wall", "-Werror", "-shared", "-fPIC", "-Dbetaloop_linkage=", "-x", "c"]
        subprocess.run([compiler, *options, f"{header}.h", "-o", f"{header}.so"], cwd=tmp_path, check=True)
    found = {}
    for name in ("model.onnx", "model-lost-sample.onnx", "betaloop_controller.so", "betaloop_controller_int8.so"):
        answers = run_target(tmp_path / name, own.vectors, own.opened.manifest)
        found[name] = check_port(own.content, own.opened, write_answers(own.vectors, answers))
    assert {name: check.verdict for name, check in found.items() if "int8" not in name} == dict.fromkeys(list(found)[:3], SAME)
    whole_numbers = found["betaloop_controller_int8.so"]
    assert whole_numbers.verdict in (SAME, WITHIN)
    assert whole_numbers.worst_ma <= 0.02
    assert whole_numbers.compared == ("network", "decision")
    assert quantise(own.opened.network) is not None


def test_a_library_without_the_headers_functions_is_named(compiler, port, tmp_path):
    (tmp_path / "a.c").write_text("int other(void) { return 1; }\n")
    subprocess.run([compiler, "-shared", "-fPIC", "a.c", "-o", "a.so"], cwd=tmp_path, check=True)
    with pytest.raises(TargetError, match="lacks a function of the C header"):
        run_target(tmp_path / "a.so", port.vectors, port.opened.manifest)
    (tmp_path / "b.onnx").write_bytes(b"no network")
    with pytest.raises(TargetError, match=r"cannot run b\.onnx"):
        run_target(tmp_path / "b.onnx", port.vectors, port.opened.manifest)


def test_answers_to_another_bundle_are_refused(port, large_port):
    with pytest.raises(ValueError, match="line 2: hash"):
        check_port(port.content, port.opened, write_answers(large_port.vectors, Answers(large_port.answers(), None)))
    assert issubclass(BundleError, ValueError)
