"""Sums of sessions that lie in visits, and the elimination of both levels from the equations of a mixed model.

A session has a level of its own, and its visit has one. The column of a level is that of the overall level on its own rows. So no row of
the equations for levels has to be written down. The block of the sessions is diagonal; once sessions are eliminated (Schur complement), so
is that of the visits. What is left has the size of the other columns, however many sessions there are.

Draws are those of the Cholesky factor of all equations in the order columns, visits, sessions, without making it. Each level is drawn given
those after it, from the last session to the first. What the columns leave open is kept as a small covariance, which every step updates by
one vector, as in Kalman's filter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Reduced:
    """Equations without the levels, B of them; c columns, V visits, n sessions.

    Attributes:
        joint: [B, c + 1, c + 1], of the columns and y. log_det: of what was eliminated times its lambdas, [B].
        visits: row of every visit's level, sessions eliminated, [B, V, c + 1]. ratios: lambdas of visits and sessions, [B, 2].
        present: 1 for sessions that count, else 0, [B, n].
    """

    joint: Floats
    log_det: Floats
    visits: Floats
    ratios: Floats
    present: Floats


@dataclass(frozen=True)
class SessionSums:
    """Sums over the rows of n sessions, session by session.

    Attributes:
        joint: sums of products of the columns and y, [n, c + 1, c + 1]; the first column is that of the overall level, y the last.
        rows: number of rows, [n]. visit: of the session, [n], 0 to V - 1, each at least once.
    """

    levels: ClassVar[tuple[str, ...]] = ("visit", "session")

    joint: Floats
    rows: Indices
    visit: Indices

    @property
    def number(self) -> int:
        """Rows of all sessions."""
        return int(self.rows.sum())

    @property
    def square(self) -> float:
        """Sum of y^2."""
        return float(self.joint[:, -1, -1].sum())

    @property
    def visits(self) -> int:
        """V."""
        return int(self.visit.max()) + 1

    @property
    def diagonal(self) -> Floats:
        """Sums of squares of the columns, [c]."""
        return np.diagonal(self.joint.sum(0))[:-1]

    @property
    def trace(self) -> float:
        """Of the Gram matrix of all columns, those of the levels among them."""
        return float(self.diagonal.sum() + 2 * self.joint[:, 0, 0].sum())

    def take(self, columns: Indices) -> SessionSums:
        """Select the sums of some columns, the first among them."""
        kept = np.append(columns, self.joint.shape[1] - 1)
        return replace(self, joint=self.joint[:, kept[:, None], kept])

    def changed(self, change: Floats) -> SessionSums:
        """Return the sums of new columns: the present ones times a matrix [c, c'], which keeps the first column."""
        whole = np.zeros((change.shape[0] + 1, change.shape[1] + 1))
        whole[:-1, :-1], whole[-1, -1] = change, 1.0
        return replace(self, joint=whole.T @ self.joint @ whole)

    def reduced(self, ratios: Floats, present: Floats | None = None) -> Reduced:
        """Return the equations without the levels at lambdas of visits and sessions [B, 2]; `present` [B, n] excludes sessions."""
        by_level = self.joint[:, 0, :]
        own, of_visit, of_session = by_level[:, 0], 1 / ratios[:, :1], 1 / ratios[:, 1:]
        some = np.ones((len(ratios), len(own))) if present is None else present
        total = self.joint.sum(0) if present is None else np.tensordot(present, self.joint, 1)
        weight = some / (own + of_session)
        order = np.argsort(self.visit, kind="stable")
        starts = np.searchsorted(self.visit[order], np.arange(self.visits))
        visits = np.add.reduceat((of_session * weight)[:, order, None] * by_level[order], starts, axis=1)
        pivot = visits[:, :, 0] + of_visit
        joint = total - np.swapaxes(weight[..., None] * by_level, 1, 2) @ by_level - np.swapaxes(visits / pivot[..., None], 1, 2) @ visits
        # without the difference of two large numbers: the overall level may be all but given by those below it
        joint[:, 0, :] = joint[:, :, 0] = ((of_visit / pivot)[..., None] * visits).sum(1)
        log_det = np.log1p(some * own * ratios[:, 1:]).sum(1) + np.log1p(visits[:, :, 0] * ratios[:, :1]).sum(1)
        return Reduced(joint, log_det, visits, ratios, some)

    def means(self, at: Reduced, columns: Floats) -> tuple[Floats, Floats]:
        """Return levels of visits [B, V] and sessions [B, n] given the columns' coefficients [B, c]; 0 where no row counts."""
        with_y = np.concatenate([-columns, np.ones((len(columns), 1))], axis=1)[..., None]
        of_visit = (at.visits @ with_y)[..., 0] / (at.visits[:, :, 0] + 1 / at.ratios[:, :1])
        by_level = at.present[..., None] * self.joint[:, 0, :]
        left = (by_level @ with_y)[..., 0] - by_level[:, :, 0] * of_visit[:, self.visit]
        return of_visit, left / (by_level[:, :, 0] + 1 / at.ratios[:, 1:])

    def spread(self, at: Reduced, penalties: Floats, noise: Floats) -> Floats:
        """Multiply L^-T by noise [B, R, c + V + n], where L L^T are all equations with the penalties [B, c] of the columns.

        Levels without a row are 0; columns without one keep their share of the noise.
        """
        n, c = len(self.rows), penalties.shape[1]
        by_level, ridge = self.joint[:, 0, :c], penalties[:, :, None] * np.eye(c)
        of_visit, of_session = 1 / at.ratios[:, 0], 1 / at.ratios[:, 1]
        found, visits = np.zeros(noise.shape), c + self.visits
        covariance = np.linalg.inv(at.joint[:, :c, :c] + ridge)
        coupling, pivot = at.visits[:, :, :c].copy(), at.visits[:, :, 0] + of_visit[:, None]
        # what the levels drawn so far ask of each visit and of the columns
        asked, pull = np.zeros((*noise.shape[:2], self.visits)), np.zeros((*noise.shape[:2], c))
        for i in reversed(range(n)):
            v, row = self.visit[i], at.present[:, i, None] * by_level[i]
            own = row[:, 0]
            diagonal, share = own + of_session, own / pivot[:, v]
            reach = row - coupling[:, v] * share[:, None]
            gain = (covariance @ reach[..., None])[..., 0]
            open_ = (reach * gain).sum(1) + own * share
            level = noise[:, :, visits + i] * np.sqrt((1 + open_ / diagonal) / diagonal)[:, None]
            level += ((pull @ gain[..., None])[..., 0] + share[:, None] * asked[:, :, v]) / diagonal[:, None]
            covariance -= gain[:, :, None] * (gain / (diagonal + open_)[:, None])[:, None, :]
            before, through = coupling[:, v].copy(), asked[:, :, v] / pivot[:, None, v]
            coupling[:, v] += row * (own / diagonal)[:, None]
            pivot[:, v] += own**2 / diagonal
            asked[:, :, v] += own[:, None] * level
            moved = np.stack([through, level, -asked[:, :, v] / pivot[:, None, v]], axis=2)
            pull += moved @ np.stack([before, row, coupling[:, v]], axis=1)
            found[:, :, visits + i] = np.where(own[:, None] > 0, level, 0.0)
        for v in reversed(range(self.visits)):
            row, diagonal = coupling[:, v], pivot[:, v]
            gain = (covariance @ row[..., None])[..., 0]
            open_ = (row * gain).sum(1)
            level = noise[:, :, c + v] * np.sqrt((1 + open_ / diagonal) / diagonal)[:, None]
            level += ((pull @ gain[..., None])[..., 0] - asked[:, :, v]) / diagonal[:, None]
            covariance -= gain[:, :, None] * (gain / (diagonal + open_)[:, None])[:, None, :]
            pull += row[:, None] * (asked[:, :, v] / diagonal[:, None] + level)[..., None]
            found[:, :, c + v] = np.where(row[:, :1] > 0, level, 0.0)
        total = np.tensordot(at.present, self.joint[:, :c, :c], 1) + ridge
        inverse = np.linalg.inv(np.linalg.cholesky(total))
        found[:, :, :c] = (noise[:, :, :c] - pull @ np.swapaxes(inverse, 1, 2)) @ inverse
        return found
