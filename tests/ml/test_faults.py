"""Messages about data reach the reader of results; what a library says goes to the log."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ml.faults import BROKE, own_words, said_of
from ml.mdp import MdpSettings
from ml.policies.onnx_policy import OnnxPolicy


def raised(call: Callable[[], object]) -> Exception:
    with pytest.raises(ValueError) as caught:
        call()
    return caught.value


def test_our_own_reasons_are_told_and_those_of_a_library_are_not() -> None:
    ours = raised(lambda: MdpSettings(xi_beta=1.0, window=0))
    assert own_words(ours) == "window must be at least 1 step, not 0"
    assert own_words(raised(lambda: OnnxPolicy(b"no network", 10))), "an error of our own kind"
    assert own_words(raised(lambda: np.linalg.inv(np.zeros((2, 2))))) is None
    log: list[str] = []
    assert said_of(raised(lambda: np.linalg.cholesky(-np.eye(2))), log.append) == BROKE
    assert "positive definite" in log[0], "engineers read it"
    assert said_of(ours, log.append) == "window must be at least 1 step, not 0"
    assert len(log) == 1
