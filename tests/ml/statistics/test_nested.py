"""Sessions within visits without a column of their own, against the same model with one dense column per level.

The dense model is slow to read rows into but plain: its equations are those of `MixedModel` over all columns.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ml.statistics.left_out import left_out_draws
from ml.statistics.mixed import MixedModel, Sums
from ml.statistics.nested import SessionSums

Floats = NDArray[np.float64]

VISIT = np.array([0, 0, 1, 2, 1, 2, 0, 3])
"""Not in order, and the last visit has one session."""
CORE = MixedModel(4, {"slopes": (2, 3)}, {1: 50.0})


class Twin:
    """The dense twin: columns (core, visits, sessions) written out."""

    def __init__(self, columns: list[Floats], y: list[Floats], unit: float = 1.0) -> None:
        n, v = len(VISIT), int(VISIT.max()) + 1
        levels = [np.tile(np.concatenate([np.eye(v)[VISIT[i]], np.eye(n)[i]]), (len(part), 1)) for i, part in enumerate(y)]
        self.parts = [np.concatenate([c, d], axis=1) for c, d in zip(columns, levels, strict=True)]
        self.y = [unit * part for part in y]
        groups = {**CORE.estimated, "visit": range(4, 4 + v), "session": range(4 + v, 4 + v + n)}
        self.model = MixedModel(4 + v + n, groups, CORE.known)
        joint = [np.concatenate([c, part[:, None]], axis=1) for c, part in zip(columns, self.y, strict=True)]
        self.nested = SessionSums(np.stack([rows.T @ rows for rows in joint]), np.array([len(part) for part in y]), VISIT)

    def sums(self, without: int | None = None) -> Sums:
        """Sum over all rows, or over those outside one session."""
        kept = [i for i in range(len(VISIT)) if i != without]
        return Sums.of(np.concatenate([self.parts[i] for i in kept]), np.concatenate([self.y[i] for i in kept]))

    def left_out(self, i: int, ratios: Floats, noise: Floats, rng: np.random.Generator) -> Floats:
        """Draw all coefficients for noise [D, q] from all sessions but one, by the Cholesky factor of the whole matrix."""
        sums = self.sums(i)
        live = np.flatnonzero(np.diag(sums.gram) > 1e-12)
        penalty = np.full(self.model.columns, 1e-10 * np.trace(sums.gram))
        penalty[1] = 1 / CORE.known[1]
        for ratio, columns in zip(ratios, self.model.estimated.values(), strict=True):
            penalty[list(columns)] = 1 / ratio
        lower = np.linalg.cholesky((sums.gram + np.diag(penalty))[np.ix_(live, live)])
        half = np.linalg.solve(lower, sums.moment[live])
        sigma = np.sqrt((sums.square - half @ half) / (sums.number - 1))
        found = np.zeros(noise.shape)
        found[:, live] = np.linalg.solve(lower.T, half) + sigma * np.linalg.solve(lower.T, noise[:, live].T).T
        for ratio, columns in zip(ratios, self.model.estimated.values(), strict=True):
            unseen = np.setdiff1d(list(columns), live)
            found[:, unseen] = sigma * np.sqrt(ratio) * rng.standard_normal((len(noise), unseen.size))
        return found


def twin(unit: float = 1.0, empty: bool = False) -> Twin:
    """Build eight sessions in four visits whose levels differ; with `empty`, one session has no row."""
    rng = np.random.default_rng(5)
    columns, y = [], []
    visits, sessions = rng.normal(size=4), 0.5 * rng.normal(size=len(VISIT))
    for i, v in enumerate(VISIT):
        rows = 0 if empty and i == 4 else 12 + i
        x = np.concatenate([np.ones((rows, 1)), rng.normal(size=(rows, 3))], axis=1)
        columns.append(x)
        y.append(x @ [1.0, -2.0, 0.3, 0.4] + visits[v] + sessions[i] + rng.normal(size=rows))
    return Twin(columns, y, unit)


@pytest.mark.parametrize("empty", [False, True])
def test_without_columns_for_levels_the_posterior_is_that_of_the_dense_form(empty: bool) -> None:
    found = twin(empty=empty)
    nested, dense = CORE.fit(found.nested), found.model.fit(found.sums())
    assert nested.groups == dense.groups == ("slopes", "visit", "session")
    for name in ("likeliest", "ratios", "weights", "means", "squares", "coefficients"):
        np.testing.assert_allclose(getattr(nested, name), getattr(dense, name), rtol=1e-8, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(nested.covariance, dense.covariance, rtol=1e-8, atol=1e-12)
    assert nested.log_evidence == pytest.approx(dense.log_evidence, rel=1e-10)
    assert nested.degrees == dense.degrees
    assert nested.share("session") == pytest.approx(dense.share("session"), rel=1e-8)
    np.testing.assert_allclose(CORE.likeliest(found.nested)[1], found.model.likeliest(found.sums())[1], rtol=1e-8, atol=1e-12)


def test_draws_are_those_of_the_dense_factor_number_by_number() -> None:
    found = twin(empty=True)
    nested = CORE.fit(found.nested).draws(50, np.random.default_rng(3))
    dense = found.model.fit(found.sums()).draws(50, np.random.default_rng(3))
    np.testing.assert_allclose(nested, dense, rtol=1e-8, atol=1e-10)


def test_a_session_is_left_out_as_if_its_rows_had_never_been() -> None:
    found, ratios, held = twin(), np.array([0.5, 0.8, 0.3]), (0, 3, 7)
    columns, levels = left_out_draws(CORE, found.nested, ratios, held, 5, np.random.default_rng(4))
    rng = np.random.default_rng(4)
    for j, i in enumerate(held):
        expected = found.left_out(i, ratios, rng.standard_normal((5, found.model.columns)), rng)
        np.testing.assert_allclose(columns[j], expected[:, :4], rtol=1e-8)
        np.testing.assert_allclose(levels[j], expected[:, 4 + VISIT[i]] + expected[:, 8 + i], rtol=1e-8)


def test_levels_and_answers_follow_the_unit_of_y() -> None:
    one = CORE.fit(twin().nested)
    for unit in (1e-12, 1e-6, 1e6):
        other = CORE.fit(twin(unit).nested)
        np.testing.assert_allclose(other.coefficients, unit * one.coefficients, rtol=1e-9)
        np.testing.assert_allclose(other.weights, one.weights, rtol=1e-7)


def test_no_rows_are_an_error() -> None:
    nothing = SessionSums(np.zeros((2, 5, 5)), np.zeros(2, dtype=np.int64), np.array([0, 1]))
    with pytest.raises(ValueError, match="at least one row"):
        CORE.fit(nothing)


def test_memory_and_time_do_not_hold_a_matrix_of_all_levels() -> None:
    # 2000 sessions in 200 visits: a dense matrix of their levels at one point of the grid would be 39 MB, and there are 125 points
    rng = np.random.default_rng(0)
    visit = np.repeat(np.arange(200), 10)
    rows = np.concatenate([np.ones((2000, 20, 1)), rng.normal(size=(2000, 20, 4))], axis=2)
    rows[..., -1] += rng.normal(size=200)[visit][:, None]
    fit = CORE.fit(SessionSums(np.swapaxes(rows, 1, 2) @ rows, np.full(2000, 20), visit))
    assert fit.draws(3, rng).shape == (3, 4 + 200 + 2000)
    assert fit.ratios[np.argmax(fit.weights), 1] == pytest.approx(1.0, rel=0.3)
