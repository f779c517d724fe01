"""Penalised regressions against closed forms, numerical derivatives and refits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import expit
from scipy.stats import multivariate_normal

from ml.ope.outcomes.laplace import Problem, _derivatives, _objective, mean_of, solve


def without(p, left):
    rest = np.delete(np.arange(len(p.y)), left)
    return replace(p, design=p.design[:, rest], parts=p.parts[rest], y=p.y[rest], size=p.size[rest])


def problem(kind, seed=0, n=40, parts=3):
    rng = np.random.default_rng(seed)
    m = parts if kind == "binomial" else 1
    design = rng.standard_normal((2, n, m, 3))
    design[..., 0] = 1.0
    eta = (design[0] @ np.array([0.5, 1.0, -0.8])).mean(1)
    y = {"gaussian": eta + 0.3 * rng.standard_normal(n), "binomial": rng.binomial(10, expit(eta)) / 10}
    y["rounded"] = np.clip(np.round(6 + 2 * eta + 0.5 * rng.standard_normal(n)), 1, 10)
    return Problem(kind, design, np.full((n, m), 1 / m), y[kind], np.full(n, 10.0), np.zeros((2, 3)), np.full((2, 3), 0.1))


@pytest.mark.parametrize("kind", ["gaussian", "rounded", "binomial"])
def test_the_slope_is_the_derivative_of_the_objective_and_vanishes_at_the_mode(kind):
    p = problem(kind)
    theta, dispersion = np.array([[0.4, 0.6, -0.5], [0.1, -0.2, 0.3]]), np.array([0.5, 1.5])
    slope, information = _derivatives(p, theta, dispersion)
    for j in range(3):
        step = np.zeros(3)
        step[j] = 1e-5
        numeric = (_objective(p, theta + step, dispersion) - _objective(p, theta - step, dispersion)) / 2e-5
        np.testing.assert_allclose(slope[:, j], numeric, rtol=1e-4, atol=1e-4)
    assert (np.linalg.eigvalsh(information) > 0).all()
    found = solve(p)
    np.testing.assert_allclose(_derivatives(p, found.mode, found.dispersion)[0], 0, atol=0.05)


def test_the_gaussian_mode_is_the_ridge_regression():
    p = problem("gaussian")
    found = solve(p)
    for k in range(2):
        x, s = p.design[k, :, 0], found.dispersion[k]
        np.testing.assert_allclose(found.mode[k], np.linalg.solve(x.T @ x + 0.1 * s * np.eye(3), x.T @ p.y), rtol=1e-6)


def test_the_design_that_made_the_data_has_the_larger_evidence():
    for kind in ("gaussian", "rounded", "binomial"):
        p = problem(kind, seed=3)
        assert np.argmax(solve(p).log_evidence) == 0


@pytest.mark.parametrize("kind", ["gaussian", "rounded", "binomial"])
def test_leaving_a_session_out_by_one_step_is_close_to_fitting_the_others(kind):
    p = problem(kind, n=25)
    found = solve(p)
    only = p.only(0)
    alone = solve(only)
    quick = alone.left_out(only, only.design, [np.array([i]) for i in range(25)], np.zeros(1))
    for i in (0, 7, 19):
        again = solve(without(p, [i]))
        eta = p.design[0, i] @ again.mode[0]
        exact = mean_of(p.kind, eta[None], p.parts[i : i + 1], again.dispersion[:1])[0]
        whole = mean_of(p.kind, (p.design[0, i] @ found.mode[0])[None], p.parts[i : i + 1], found.dispersion[:1])[0]
        assert abs(quick[i] - exact) < 0.3 * abs(whole - exact) + 0.02 * max(1.0, np.ptp(p.y))


def test_leaving_groups_out_of_a_gaussian_is_exact_with_the_evidence_of_what_is_left():
    p = problem("gaussian", seed=2, n=12)
    p = replace(p, design=np.stack([p.design[0], p.design[0] + 0.15 * p.design[1]]))  # both explain something
    found = solve(p)
    groups = [np.arange(0, 5), np.arange(5, 7), np.arange(7, 12)]
    quick = found.left_out(p, p.design, groups, np.zeros(2))
    for members in groups:
        rest, means, evidence = np.delete(np.arange(12), members), [], []
        for k in range(2):
            x, s = p.design[k, :, 0], found.dispersion[k]
            known = x[rest]
            means.append(x[members] @ np.linalg.solve(known.T @ known + 0.1 * s * np.eye(3), known.T @ p.y[rest]))
            evidence.append(multivariate_normal(np.zeros(len(rest)), s * np.eye(len(rest)) + known @ known.T / 0.1).logpdf(p.y[rest]))
            evidence[-1] -= 0.5 * 3.0 * (np.log(s) + 0.15**2 / s)  # the prior of the dispersion
        weights = np.exp(np.array(evidence) - max(evidence))
        assert 0.001 < weights.min() < 0.999
        np.testing.assert_allclose(quick[members], weights @ np.array(means) / weights.sum(), rtol=1e-5)


@pytest.mark.parametrize("kind", ["rounded", "binomial"])
def test_leaving_a_visit_out_by_one_step_is_close_to_fitting_the_other_visits(kind):
    p, visit = problem(kind, n=24).only(0), np.arange(24) // 6
    days = np.broadcast_to(np.eye(4)[visit][:, None], (1, 24, p.design.shape[2], 4))
    level = np.array([1.2, -0.9, 0.4, -0.7])
    y = np.clip(p.y + 0.15 * level[visit], 0, 1) if kind == "binomial" else np.clip(np.round(p.y + level[visit]), 1, 10)
    p = replace(p, design=np.concatenate([p.design, days], axis=-1), y=y, prior_mean=np.zeros((1, 7)))
    p = replace(p, precision=np.array([[0.1, 0.1, 0.1, 2.0, 2.0, 2.0, 2.0]]))
    found, extra = solve(p), np.array([0.5])
    groups = [np.flatnonzero(visit == v) for v in range(4)]
    quick, moved = found.left_out(p, p.design, groups, extra), []
    for v, members in enumerate(groups):
        again = solve(without(p, members))
        np.testing.assert_allclose(again.mode[0, 3 + v], 0, atol=1e-9)
        exact, whole = (
            mean_of(kind, p.design[0, members] @ theta, p.parts[members], again.dispersion[0], e)
            for theta, e in ((again.mode[0], 0.5), (found.mode[0], 0.0))
        )
        moved.append(np.abs(whole - exact).max())
        assert np.abs(quick[members] - exact).max() < 0.25 * moved[-1] + 0.02 * max(1.0, np.ptp(p.y))
    assert max(moved) > 0.1 * np.ptp(p.y)
    middle = 0.5 if kind == "binomial" else 5.5  # where days differ by more, less is known of the next
    wide = found.left_out(p, p.design, groups, np.array([20.0]))
    assert np.abs(wide - middle).mean() < 0.8 * np.abs(quick - middle).mean()


def test_the_mean_of_a_rounded_and_of_a_shared_out_predictor_is_that_of_many_draws():
    rng = np.random.default_rng(4)
    for eta in (-1.0, 5.2, 11.0):
        drawn = np.clip(np.round(eta + np.sqrt(0.5 + 0.7) * rng.standard_normal(400_000)), 1, 10)
        assert mean_of("rounded", np.array([[eta]]), np.ones((1, 1)), 0.5, 0.7)[0] == pytest.approx(drawn.mean(), abs=0.01)
        level = 0.9 * rng.standard_normal(400_000)
        shares = 0.25 * expit(eta / 4 + level) + 0.75 * expit(eta / 2 + level)
        found = mean_of("binomial", np.array([[eta / 4, eta / 2]]), np.array([[0.25, 0.75]]), 1.0, np.array([0.81]))
        assert found[0] == pytest.approx(shares.mean(), abs=0.01)


def test_ratings_far_from_what_is_expected_keep_finite_slopes():
    p = replace(problem("rounded"), y=np.where(np.arange(40) % 2, 1.0, 10.0))
    theta = np.array([[80.0, 0.0, 0.0], [-80.0, 0.0, 0.0]])
    slope, information = _derivatives(p, theta, np.array([0.01, 0.01]))
    assert np.isfinite(slope).all()
    assert np.isfinite(information).all()
    assert slope[0, 0] < 0 < slope[1, 0]
