"""Windows that a bundle holds for ports, and what is due to them."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace

import numpy as np
import onnx
import pytest

from ml.deploy.bundle import build_bundle, build_scheduled_bundle, open_bundle, unpack
from ml.deploy.manifest import BundleError
from ml.deploy.ports.check import port_vectors
from ml.deploy.ports.lost_sample import MODEL_LOST, with_lost_samples
from ml.deploy.ports.vectors import PORT_VECTORS, from_csv, to_csv
from ml.deploy.runtime.envelope import BetaSample, Signal
from ml.deploy.runtime.schedule import Schedule, ScheduledHold
from ml.policies.onnx_policy import OnnxPolicy
from ml.rl import MlpPolicy
from tests.ml.deploy.test_bundle import pack

BASIC = {"Add", "Sub", "Mul", "Div", "Gemm", "MatMul", "Relu", "Tanh"}


def test_the_windows_show_whatever_converters_are_known_to_break(port):
    windows, kind = port.vectors.windows, np.array(port.vectors.kind)
    assert windows.shape == (400, 10)
    assert set(kind) == {
        "visit 1", "visit 2", "visit 3", "lost one", "lost run", "lost all", "zero", "level", "step", "pulse", "large", "lowest dose",
        "highest dose",
    }  # fmt: skip
    assert min((kind == f"visit {n}").sum() for n in (1, 2, 3)) >= 40
    lost = np.isnan(windows)
    assert {tuple(np.flatnonzero(row)) for row in lost[kind == "lost one"]} == {(place,) for place in range(10)}
    runs = [np.flatnonzero(row) for row in lost[kind == "lost run"]]
    assert {run.size for run in runs} == set(range(2, 10))
    assert all(np.all(np.diff(run) == 1) for run in runs)
    assert lost[kind == "lost all"].all()
    assert not lost[~np.isin(kind, ["lost one", "lost run", "lost all"])].any()
    assert not windows[kind == "zero"].any()
    largest = windows[np.char.startswith(kind, "visit")].max()
    assert windows[kind == "large"].max() >= 9.5 * largest, "up to ten times the largest beta"
    assert np.all(np.diff(windows[kind == "level"], axis=0) > 0)


def test_the_lowest_and_highest_dose_are_found_and_not_only_sampled(port):
    dose, kind = port.vectors.dose, np.array(port.vectors.kind)
    assert dose[kind == "lowest dose"].max() <= np.nanmin(dose[np.char.startswith(kind, "visit")])
    assert dose[kind == "highest dose"].min() >= np.nanmax(dose[np.char.startswith(kind, "visit")])
    assert dose[kind == "lowest dose"].min() < 0.01
    assert dose[kind == "highest dose"].max() > 0.99


def test_doses_are_those_of_the_network_and_decisions_those_of_the_whole_controller(port):
    vectors, manifest = port.vectors, port.opened.manifest
    np.testing.assert_allclose(vectors.dose, port.answers(), atol=1e-6)
    assert np.isnan(vectors.dose[vectors.without_dose]).all()
    newest = np.isnan(vectors.windows[:, -1])
    assert np.all(vectors.decision_ma[newest] == manifest.cdbs_ma), "a lost newest sample gives cDBS"
    begun = np.isnan(vectors.windows[:, 0]) | (np.isnan(vectors.windows).sum(axis=1) > manifest.most_imputed)
    assert np.all(vectors.decision_ma[begun] == manifest.cdbs_ma), "and so does a window with more lost than may be imputed"
    signal = Signal(manifest.beta_unit, manifest.beta_source)
    for row in (0, 150, 399):
        controller = port.opened.controller()
        for k, beta in enumerate(vectors.windows[row]):
            decision = controller.decide(2.0 * k, BetaSample(2.0 * k, float(beta), signal))
        assert vectors.decision_ma[row] == pytest.approx(decision.amplitude_ma, abs=1e-6)
    assert vectors.decision_ma.min() >= manifest.cdbs_ma - manifest.ramp_ma_per_s * manifest.period_s - 1e-6, "one step of the ramp"


def test_the_file_is_in_the_manifest_and_reads_back_as_it_was(port):
    raw = unpack(port.content)[PORT_VECTORS]
    assert port.opened.manifest.files[PORT_VECTORS] == hashlib.sha256(raw).hexdigest()
    assert to_csv(from_csv(raw, 10)) == raw
    header, first = raw.decode().splitlines()[:2]
    assert header.split(",") == ["row", "hash", "kind", *(f"beta_{n}" for n in range(1, 11)), "network_dose", "decision_ma", "must_not"]
    assert len(first.split(",")) == 16, "no field needs quotes"


def test_a_bundle_of_an_earlier_version_stays_valid_and_is_named(port):
    files = unpack(port.content)
    stated = json.loads(files["manifest.json"])
    for name in (PORT_VECTORS, MODEL_LOST):
        del files[name], stated["files"][name]
    old = pack(files | {"manifest.json": json.dumps(stated).encode()})
    opened = open_bundle(old)
    with pytest.raises(BundleError, match="made before ports were checked"):
        port_vectors(old, opened.manifest)


def test_a_schedule_has_nothing_to_port(manifest):
    schedule = Schedule("constant", None, None, None, (ScheduledHold(0, 10, 1.0, None),))
    content = build_scheduled_bundle(replace(manifest, schedule=schedule, policy_id=None, normalisation_mean=None, normalisation_std=None))
    with pytest.raises(BundleError, match="nothing to port"):
        port_vectors(content, open_bundle(content).manifest)


@pytest.mark.parametrize("length", [1, 2, 7, 60])
def test_windows_of_every_length_have_400(manifest, length):
    policy = MlpPolicy(length, (4,), mean=30.0, std=9.0, seed=1)
    windows = np.abs(np.random.default_rng(1).normal(30.0, 9.0, (3, length)))
    content = build_bundle(policy.to_onnx(), replace(manifest, window=length, most_imputed=0), windows)
    vectors = port_vectors(content, open_bundle(content).manifest)
    assert vectors.windows.shape == (400, length)
    assert "near" in vectors.kind, "too few were recorded"


def test_the_graph_stays_easy_to_port_and_the_second_file_passes_a_lost_sample_on():
    content = MlpPolicy(10, (20, 10), mean=30.0, std=9.0, seed=3).to_onnx()
    for made in (content, with_lost_samples(content)):
        model = onnx.load_model_from_string(made)
        assert {node.op_type for node in model.graph.node} <= BASIC
        assert [(o.domain, o.version) for o in model.opset_import] == [("", 17)]
        assert len(model.graph.input[0].type.tensor_type.shape.dim) == 2
        assert [node.op_type for node in model.graph.node][:2] == ["Sub", "Div"], "the scaling is a step of its own"
    windows = np.abs(np.random.default_rng(0).normal(30.0, 9.0, (50, 10)))
    np.testing.assert_array_equal(OnnxPolicy(with_lost_samples(content)).act(windows), OnnxPolicy(content).act(windows))
    windows[:, 3] = np.nan
    assert np.isnan(OnnxPolicy(with_lost_samples(content))._run(windows)).all()
