"""Null studies: which null is one in every metric, and what a saturating metric shows where it is none."""

from __future__ import annotations

import importlib
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import expit

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def worlds(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    yield importlib.import_module("support.null_worlds")
    for name in [n for n in sys.modules if n.split(".")[0] == "support"]:
        del sys.modules[name]


def tremor_at(spread):
    """Compute the expected tremor (%) of sessions whose latent value is normal with that standard deviation, by Gauss-Hermite
    quadrature.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    return 100 * float(weights @ expit(0.8 * spread * nodes - 1.5)) / float(weights.sum())


def test_an_effect_without_an_average_in_the_latent_value_has_one_in_tremor(worlds):
    world = worlds.WORLDS["strong day x dose"]
    alone = np.hypot(world.day, 1.0)
    expected = tremor_at(np.hypot(alone, world.slope)) - tremor_at(alone)
    assert expected > 5.0
    assert worlds.metric_average(world, "tremor") == pytest.approx(expected, abs=0.6)
    assert worlds.metric_average(replace(world, slope=0.0), "tremor") == pytest.approx(0.0, abs=0.6)


def test_what_befalls_either_arm_has_no_average_in_any_metric(worlds):
    world = replace(worlds.WORLDS["strong day x dose"], visits=20_000)
    rng = np.random.default_rng(3)
    design = worlds.layout(world, rng)
    for metric, unit in (("grasp", 0.15), ("rating", 0.8), ("tremor", 30.0)):
        value = worlds.measure(metric, worlds.latent(world, 0.0, rng, design, either=True), design, world, rng).value
        contrast = value[design[1]].mean() - value[~design[1]].mean()
        assert abs(contrast) < 0.1 * unit, metric
