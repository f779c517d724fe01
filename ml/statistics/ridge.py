"""Ridge regression of few rows: penalty by leave-one-out error. The first column of a design is the intercept and is not penalised."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def ridge_weights(x: Floats, y: Floats, penalty: float) -> Floats:
    """Weights [p] (or [p, m]) of the design x [n, p] for y [n] (or [n, m])."""
    return np.asarray(np.linalg.solve(_gram(x, penalty), x.T @ y), dtype=np.float64)


def leave_one_out_errors(x: Floats, y: Floats, penalty: float) -> Floats:
    """Prediction errors [n] with each row left out in turn, by the hat matrix."""
    hat = x @ np.linalg.solve(_gram(x, penalty), x.T)
    return np.asarray((y - hat @ y) / np.maximum(1 - np.diag(hat), 1e-6), dtype=np.float64)


def _gram(x: Floats, penalty: float) -> Floats:
    ridge = np.full(x.shape[1], penalty)
    ridge[0] = 1e-9
    return np.asarray(x.T @ x + np.diag(ridge), dtype=np.float64)
