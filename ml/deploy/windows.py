"""Policies as the controller loop takes them: with a window of their own."""

from __future__ import annotations

import numpy as np

from ml.policies.policy import Policy


class PolicyWindow:
    """Any policy with its window, for files that are no plain multi-layer perceptron.

    Args:
        policy: of beta windows.
        window: W.
    """

    def __init__(self, policy: Policy, window: int) -> None:
        self._policy = policy
        self._window = np.zeros((1, window))

    def push(self, beta: float) -> None:
        """Move the window on by one beta amplitude."""
        self._window[0, :-1] = self._window[0, 1:]
        self._window[0, -1] = beta

    def fraction(self) -> float:
        """Compute the amplitude fraction for the current window. Raises ValueError for an answer that is not one number."""
        answer = np.asarray(self._policy.act(self._window), dtype=np.float64)
        if answer.shape != (1,):
            raise ValueError(f"answer of shape {list(answer.shape)} instead of [1]")
        return float(answer[0])
