"""The training of the posterior's constants finds what is wrong with differences whose error is known."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def training(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    yield importlib.import_module("support.training")
    for name in [n for n in sys.modules if n.split(".")[0] == "support"]:
        del sys.modules[name]


def examples(training, number: int):
    """Truths are half of what is said where `doubtful` is 1, and all of it where it is 0."""
    rng, found = np.random.default_rng(0), []
    for k in range(number):
        dose, doubtful = np.append(rng.uniform(-0.7, -0.3, 6), 0.0), np.full(7, float(k % 2))
        base = np.stack([dose * rng.uniform(0.2, 1.0)] * 4, axis=1)
        truth = base * (1 - 0.5 * doubtful[:, None]) + 0.01 * rng.standard_normal(base.shape) * (dose != 0)[:, None]
        parts = {"dose": dose, "moving": np.zeros(7), "doubtful": doubtful, "effect": base[:, 0]}
        found.append(training.Example(parts, base, truth, np.array([1.0, 1.0, 1.0, -1.0]), f"world {k // 2}"))
    return found


def test_a_share_that_depends_on_the_record_is_learned(training) -> None:
    rows = examples(training, 80)
    found = training.train(rows[:60], training.Training(members=2, hidden=16, epochs=60, rate=1e-2, batch=8, decay=1e-3, dropout=0.0))
    before = [np.abs(e.base - e.truth).mean() for e in rows[60:]]
    after = [np.abs(found.of(e.parts, e.base)[0] - e.truth).mean() for e in rows[60:]]
    assert np.mean(after) < 0.4 * np.mean(before)
    sd = np.concatenate([found.of(e.parts, e.base)[1][:-1] for e in rows[60:]])
    error = np.concatenate([(found.of(e.parts, e.base)[0] - e.truth)[:-1] for e in rows[60:]])
    assert 0.6 < np.mean(np.abs(error) < 1.645 * sd) <= 1.0
    assert all(np.allclose(found.of(e.parts, e.base)[0][-1], 0) for e in rows[60:])


def test_folds_keep_the_records_of_a_world_together(training) -> None:
    rows = examples(training, 20)
    parts = training.folds(rows, 4)
    assert sorted(np.concatenate(parts).tolist()) == list(range(20))
    for part in parts:
        worlds = {rows[k].world for k in part}
        assert len(part) == 2 * len(worlds)
    with pytest.raises(ValueError, match="no example"):
        training.train([], training.Training(members=1))
