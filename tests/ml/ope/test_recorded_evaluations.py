"""Three evaluations by every method of the panel against their recorded numbers: code that moves must not move an estimate.

`python tests/ml/ope/test_recorded_evaluations.py [METHOD ...]` records all methods again, or those that it names, where numbers
change on purpose; say why in CHANGELOG.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.estimator import Dlsm
from ml.ope.registry import estimators
from ml.policies.policy import ConstantPolicy, ProportionalPolicy

# the only names of the package that this file knows
from ml.population import random_controller_buffer
from ml.qoc import Qoc
from ml.trajectories import ReplayBuffer

RECORDED = Path(__file__).resolve().parents[2] / "data" / "recorded-evaluations.json"
TOLERANCE = {"dlsm": 1e-3, "dlsm_paper": 1e-3, "dlmm": 1e-3, "dual_dice": 1e-3}
"""Relative; 1e-9 for the methods that solve their equations. Networks amplify the last bits in which matrix kernels of processors differ:
with AVX2 kernels instead of one machine's own the DLSM moved by 2.5e-7. On another processor DualDICE moved by 1.3e-5, the others less.
"""
METHODS = ("dlsm", "dlsm_paper", "linear", "impulse", "dlmm", "fqe", "wdr", "dual_dice", "wis", "pdis", "cwpdis", "posterior")
HORIZON_STEPS = 50

SEED = 11
# what is checked is the arithmetic, not how good the estimates are
SHORT: dict[str, Any] = {"members": 2, "rollouts": 32, "steps": 30, "check_every": 10, "replay_draws": 4}
SMALL = SHORT | {"latent": 4, "hidden": 8, "heads": (8,)}
FORMS = {"dlsm": replace(DlsmConfig.expert("full", SEED), **SHORT), "dlsm_paper": replace(DlsmConfig.paper("full", SEED), **SMALL)}


@cache
def buffer(name: str) -> ReplayBuffer:
    """Build a buffer. P1: ten sessions over two visits. P2: with a no-DBS session. P4: with invalid beta, a missing amplitude and missing
    QoCs.
    """
    if name == "P1":
        return random_controller_buffer("P1", 2, 5, 60, seed=101)
    if name == "P2":
        return random_controller_buffer("P2", 3, 3, 50, seed=202)
    whole = random_controller_buffer("P4", 3, 3, 60, seed=404)
    first, second, third, *others = whole.sessions
    beta, amplitude = first.beta.copy(), second.amplitude.copy()
    beta[20:23] = np.nan
    amplitude[40] = np.nan
    damaged = (replace(first, beta=beta), replace(second, amplitude=amplitude), replace(third, qoc=Qoc()))
    return replace(whole, sessions=(*damaged, *others))


def numbers(name: str, method: str) -> dict[str, Any]:
    """Estimate five policies by a method, at full precision."""
    seen = buffer(name)
    xi = seen.settings.xi_beta
    policies = {
        "cdbs": ConstantPolicy(1.0),
        "half": ConstantPolicy(0.5),
        "none": ConstantPolicy(0.0),
        "eager": ProportionalPolicy(0.7 * xi, 1.1 * xi, 0.4, 2),
        "lazy": ProportionalPolicy(xi, 1.4 * xi, 0.3, 5),
    }
    panel = estimators(SEED, demo=True) | {key: Dlsm(config, key) for key, config in FORMS.items()}
    estimates = panel[method].fit(seen).evaluate(policies, HORIZON_STEPS)
    return {
        policy: {
            "value": e.value,
            "low": e.low,
            "high": e.high,
            "standard_error": e.standard_error,
            "step_return": e.step_return,
            "end_reward": e.end_reward,
            "supported": e.supported,
            "n": e.n,
            "predicted": dict(sorted(e.predicted.items())),
        }
        for policy, e in estimates.items()
    }


def test_the_panel_has_no_method_without_recorded_numbers() -> None:
    assert set(estimators(SEED, demo=True)) == set(METHODS)


NETWORKS = ("dlsm", "dlsm_paper", "dlmm", "dual_dice")
CASES = [
    pytest.param(name, method, marks=pytest.mark.slow if name != "P1" and method in NETWORKS else ())
    for name in ("P1", "P2", "P4")
    for method in METHODS
]


@pytest.mark.parametrize(("name", "method"), CASES)
def test_an_evaluation_gives_its_recorded_numbers(name: str, method: str) -> None:
    recorded = json.loads(RECORDED.read_text())[name][method]
    assert differences(numbers(name, method), recorded, TOLERANCE.get(method, 1e-9)) == []


def differences(new: Any, old: Any, rel: float, place: str = "") -> list[str]:
    """List the places where two nested records differ."""
    if isinstance(old, dict):
        if new.keys() != old.keys():
            return [f"{place}: {sorted(new.keys() ^ old.keys())}"]
        return [found for key in old for found in differences(new[key], old[key], rel, f"{place}/{key}")]
    if isinstance(old, float) and isinstance(new, float):
        return [] if new == pytest.approx(old, rel=rel, abs=1e-3 * rel) else [f"{place}: {new!r} was {old!r}"]
    return [] if new == old else [f"{place}: {new!r} was {old!r}"]


def record(methods: Sequence[str], write: Callable[[str], Any] = RECORDED.write_text) -> None:
    """Write the numbers of the present code for some methods; the others keep theirs."""
    kept = json.loads(RECORDED.read_text()) if RECORDED.exists() else {}
    write(
        json.dumps(
            {n: {m: numbers(n, m) if m in methods else kept[n][m] for m in METHODS} for n in ("P1", "P2", "P4")},
            indent=1,
        )
        + "\n"
    )


if __name__ == "__main__":
    record(sys.argv[1:] or METHODS)
