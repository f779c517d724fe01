"""The observer that knows how virtual patients come about: its regression against closed forms, and what it sees of a world."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from ml.population.virtual import world

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def observer(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    yield importlib.import_module("support.observer")
    for name in [n for n in sys.modules if n.split(".")[0] == "support"]:
        del sys.modules[name]


def test_the_regression_is_the_mean_given_the_data_where_all_is_normal(observer):
    # x = c + e, target c: the mean of c given x is x / (1 + variance of e), and what is left open is var e / (1 + var e)
    rng = np.random.default_rng(0)
    c, noise = rng.standard_normal((600, 4)), 0.5
    x = c + noise * rng.standard_normal((600, 4))
    fitted = observer.regress(x, c)
    new = rng.standard_normal((200, 4)) * np.sqrt(1 + noise**2)
    assert np.abs(fitted.predict(new) - new / (1 + noise**2)).max() < 0.35
    left = ((c - fitted.left_out) ** 2).mean()
    assert left == pytest.approx(noise**2 / (1 + noise**2), rel=0.1)


def test_a_left_out_patient_is_predicted_as_if_it_had_not_been_there(observer):
    rng = np.random.default_rng(1)
    x = rng.standard_normal((40, 3))
    y = (x @ np.array([1.0, -2.0, 0.5]) + 0.1 * rng.standard_normal(40))[:, None]
    fitted = observer.regress(x, y)
    z, mean = fitted.points, fitted.mean
    others = np.delete(np.arange(40), 7)
    gram = observer.kernel(z[others], z[others], fitted.rbf_share, fitted.length) + fitted.noise * np.eye(39)
    alone = mean + observer.kernel(z[7:8], z[others], fitted.rbf_share, fitted.length) @ np.linalg.solve(gram, y[others] - mean)
    assert fitted.left_out[7] == pytest.approx(alone[0], abs=1e-8)


def test_what_is_seen_of_a_world_is_what_its_data_hold(observer):
    w = world("A", 3)
    seen = observer.statistics(w, "stratified", 1)
    sessions = w.data("stratified", visits=1).sessions
    for at, kind in ((0, "cdbs"), (1, "no_dbs")):
        of = [s for s in sessions if s.controller == kind]
        own = seen[7 * at : 7 * at + 7]
        assert own[0] == pytest.approx(np.mean([(s.beta >= w.settings.xi_beta).mean() for s in of]))
        assert own[3] == pytest.approx(np.mean([np.log(s.beta).mean() for s in of]))
        assert own[4:] == pytest.approx(np.mean([[s.qoc.grasp_hz, s.qoc.rating, s.qoc.tremor_percent / 100] for s in of], axis=0))


def test_patients_of_its_kind_share_the_threshold_and_nothing_is_told_without_visits(observer):
    w = world("A", 3)
    alike = [observer.patient_alike(w, k) for k in range(6)]
    assert {a.patient.kind for a in alike} == {w.patient.kind}
    assert len({a.patient.depth for a in alike}) == 6
    assert alike[0].patient == observer.patient_alike(w, 0).patient
    policies = list(w.candidates().values())[:3]
    targets = np.stack([observer.returns_of(a, policies, 4).mean(1) for a in alike[:4]])
    told = observer.observe(w, "paper", 0, alike[:4], targets, np.zeros(3), alike[4:])
    assert told.said == pytest.approx(targets.mean(0))
    assert told.others.shape == (2, 3)
