"""Policies as the controller loop takes them: from an ONNX file to a network that keeps its own window."""

from __future__ import annotations

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper

from ml.deploy.runtime.network import Layer, MlpNetwork
from ml.rl.policy import Policy

_FORMAT_KEY, _FORMAT = "betaloop_policy", "mlp-tanh-1"  # as `ml.rl.networks` writes them; read here without loading torch


def mlp_of(policy_onnx: bytes) -> MlpNetwork | None:
    """The numpy network of an ONNX file that betaloop's learners wrote; None for a baseline or a policy made elsewhere.

    Raises:
        ValueError: the file says that betaloop wrote it, but its layers do not fit together.
    """
    model = onnx.load_model_from_string(policy_onnx)
    if {p.key: p.value for p in model.metadata_props}.get(_FORMAT_KEY) != _FORMAT:
        return None
    values = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    count = sum(name.startswith("weight_") for name in values)
    try:
        layers: list[Layer] = [(_float32(values[f"weight_{i}"]), _float32(values[f"bias_{i}"])) for i in range(count)]
        return MlpNetwork(layers, float(values["beta_mean"][0]), float(values["beta_std"][0]))
    except (KeyError, IndexError) as error:
        raise ValueError(f"the policy file is damaged: {error} is missing") from error


def _float32(values: object) -> NDArray[np.float32]:
    return np.asarray(values, dtype=np.float32)


class PolicyWindow:
    """Any policy with its window, for files that are no multi-layer perceptron of betaloop.

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
        """Amplitude fraction for the window as it stands. Raises ValueError for an answer that is not one number."""
        answer = np.asarray(self._policy.act(self._window), dtype=np.float64)
        if answer.shape != (1,):
            raise ValueError(f"answer of shape {list(answer.shape)} instead of [1]")
        return float(answer[0])
