"""The networks of the deep actor-critic: policy (actor) and state-action value function (critic).

Sizes, initial weights and the place where the action joins the critic follow Lillicrap et al. 2016 (Continuous control with deep
reinforcement learning). So do Gao et al. 2023, section 5.1 and appendix C.1. Two things are ours. Inputs are z-scored with one mean and
standard deviation of beta instead of batch normalisation. Both are *inside* the policy network, so that an exported policy takes raw beta
amplitudes. The action bound is [0, 1] instead of [-1, 1].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from ml.policies.onnx_policy import PolicyFileError

TEACHER_HIDDEN = (400, 300)
STUDENT_HIDDEN = (20, 10)
ONNX_OPSET = 17
ONNX_IR_VERSION = 8
"""Older than this release's own, so that runtimes on clinic tablets of some years ago still load the file."""
_FORMAT_KEY, _FORMAT = "betaloop_policy", "mlp-tanh-1"
_FINAL_INIT = 3e-3  # Lillicrap et al.: first actions near the middle of the range, first values near 0


class MlpPolicy(nn.Module):
    """A deterministic policy pi(s): multi-layer perceptron with ReLU on z-scored beta windows.

    The output is (tanh(x) + 1) / 2: Lillicrap's bounded tanh moved to [0, 1]. It cannot leave the range, is 0.5 for a new network and
    has the logistic function's shape (it equals sigmoid(2x)).

    Args:
        window: W, beta amplitudes per state.
        hidden: units of each hidden layer.
        mean, std: of beta, in the participant's unit.
        seed: seed of the initial weights.

    Raises:
        ValueError: no hidden layer, a size below 1, or a standard deviation that is not positive.
    """

    def __init__(self, window: int, hidden: Sequence[int] = TEACHER_HIDDEN, *, mean: float = 0.0, std: float = 1.0, seed: int = 0) -> None:
        super().__init__()
        if window < 1 or not hidden or min(hidden) < 1:
            raise ValueError(f"a policy needs a window of 1 or more and hidden layers of 1 or more units, not {window} and {tuple(hidden)}")
        if not (math.isfinite(mean) and math.isfinite(std) and std > 0):
            raise ValueError(f"the beta scale needs a finite mean and a positive standard deviation, not {mean} and {std}")
        self.window = window
        self.hidden = tuple(hidden)
        sizes = [window, *hidden, 1]
        self.layers = nn.ModuleList(nn.utils.skip_init(nn.Linear, i, o) for i, o in pairwise(sizes))
        self.register_buffer("mean", torch.tensor([mean], dtype=torch.float32))
        self.register_buffer("std", torch.tensor([std], dtype=torch.float32))
        initialise(self.layers, torch.Generator().manual_seed(seed))

    def normalise(self, beta: Any) -> Any:
        """Convert beta amplitudes to z-scores, same shape."""
        return (beta - self.mean) / self.std

    def act_on_scores(self, scores: Any) -> Any:
        """Compute amplitude fractions [N, 1] for windows that are z-scored already, tensor [N, W]: training scales its data once."""
        hidden = scores
        for layer in self.layers[:-1]:
            hidden = torch.relu(layer(hidden))
        return 0.5 * (torch.tanh(self.layers[-1](hidden)) + 1.0)

    def forward(self, windows: Any) -> Any:
        """Compute amplitude fractions [N, 1] for beta windows, float32 tensor [N, W]."""
        return self.act_on_scores(self.normalise(windows))

    def act(self, states: NDArray[Any]) -> NDArray[np.float64]:
        """Compute amplitude fractions in [0, 1], shape [N], for beta windows [N, W]; NaN where a window has NaN.

        Raises:
            ValueError: states of another shape.
        """
        states = np.asarray(states)
        if states.ndim != 2 or states.shape[1] != self.window:
            raise ValueError(f"this policy takes beta windows of shape [N, {self.window}], not {list(states.shape)}")
        with torch.inference_mode():
            windows = torch.tensor(states, dtype=torch.float32, device=self.mean.device)
            return np.asarray(self(windows).squeeze(1).cpu().numpy(), dtype=np.float64)

    @property
    def parameter_count(self) -> int:
        """Trained weights and biases (the two constants of the beta scale are not among them)."""
        return sum(p.numel() for p in self.parameters())

    @property
    def macs(self) -> int:
        """Multiply-accumulate operations of the matrix products of one decision."""
        return sum(layer.weight.numel() for layer in self.layers)

    def to_onnx(self) -> bytes:
        """Export the policy as ONNX (opset 17): `beta_window` float32 [N, W] to `amplitude_fraction` float32 [N, 1].

        The bytes depend on the weights alone (and the onnx version), so that their SHA-256 names the policy.
        """
        constants = {"beta_mean": self.mean, "beta_std": self.std, "one": torch.ones(1), "half": torch.full((1,), 0.5)}
        nodes = [
            helper.make_node("Sub", ["beta_window", "beta_mean"], ["centred"]),
            helper.make_node("Div", ["centred", "beta_std"], ["hidden_0"]),
        ]
        last = len(self.layers) - 1
        for i, layer in enumerate(self.layers):
            constants |= {f"weight_{i}": layer.weight, f"bias_{i}": layer.bias}
            nodes.append(helper.make_node("Gemm", [f"hidden_{i}", f"weight_{i}", f"bias_{i}"], [f"linear_{i}"], transB=1))
            if i < last:
                nodes.append(helper.make_node("Relu", [f"linear_{i}"], [f"hidden_{i + 1}"]))
        nodes += [
            helper.make_node("Tanh", [f"linear_{last}"], ["bounded"]),
            helper.make_node("Add", ["bounded", "one"], ["shifted"]),
            helper.make_node("Mul", ["shifted", "half"], ["amplitude_fraction"]),
        ]
        graph = helper.make_graph(
            nodes,
            "policy",
            [helper.make_tensor_value_info("beta_window", TensorProto.FLOAT, ["N", self.window])],
            [helper.make_tensor_value_info("amplitude_fraction", TensorProto.FLOAT, ["N", 1])],
            [numpy_helper.from_array(value.detach().cpu().contiguous().numpy(), name) for name, value in constants.items()],
        )
        model = helper.make_model(
            graph, producer_name="betaloop", ir_version=ONNX_IR_VERSION, opset_imports=[helper.make_opsetid("", ONNX_OPSET)]
        )
        helper.set_model_props(model, {_FORMAT_KEY: _FORMAT})
        return bytes(model.SerializeToString(deterministic=True))

    @staticmethod
    def from_onnx(content: bytes) -> MlpPolicy:
        """Read what `to_onnx` wrote, for fine-tuning a stored policy.

        Raises:
            PolicyFileError: the bytes are not an ONNX file that `to_onnx` wrote.
        """
        try:
            model = onnx.load_model_from_string(content)
        except Exception as error:  # protobuf's own error class is no public name
            raise PolicyFileError(f"this is not an ONNX file: {error}") from error
        if {p.key: p.value for p in model.metadata_props}.get(_FORMAT_KEY) != _FORMAT:
            raise PolicyFileError("this ONNX file was not written by betaloop: it can be evaluated and deployed, but not trained further")
        values = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
        try:
            weights = [values[f"weight_{i}"] for i in range(sum(name.startswith("weight_") for name in values))]
            biases = [values[f"bias_{i}"] for i in range(len(weights))]
            policy = MlpPolicy(
                weights[0].shape[1],
                tuple(w.shape[0] for w in weights[:-1]),
                mean=float(values["beta_mean"][0]),
                std=float(values["beta_std"][0]),
            )
            with torch.no_grad():
                for layer, weight, bias in zip(policy.layers, weights, biases, strict=True):
                    if layer.weight.shape != weight.shape or layer.bias.shape != bias.shape:
                        raise PolicyFileError(f"the layers of this policy do not fit together: {[w.shape for w in weights]}")
                    layer.weight.copy_(torch.from_numpy(weight.copy()))
                    layer.bias.copy_(torch.from_numpy(bias.copy()))
        except (KeyError, IndexError) as error:
            raise PolicyFileError(f"this betaloop policy is damaged: the weights {error} are missing") from error
        return policy


class Critic(nn.Module):
    """The state-action value function Q(s, a) on z-scored windows.

    The action joins at the second hidden layer, next to the first layer's units, as in Lillicrap et al. (2016). It enters as 2a - 1, their
    range of actions, which is also nearer to the z-scores of the other inputs.

    Args:
        window: W.
        hidden: units of each hidden layer; at least two layers, since the action joins at the second.
        layer_norm: normalise each hidden layer's rectified output (Tarasov et al. 2023); without weights of its own, which the next
            layer would absorb.
        seed: seed of the initial weights.

    Raises:
        ValueError: fewer than two hidden layers.
    """

    def __init__(self, window: int, hidden: Sequence[int] = TEACHER_HIDDEN, *, layer_norm: bool = False, seed: int = 0) -> None:
        super().__init__()
        if len(hidden) < 2:
            raise ValueError(f"the critic needs two hidden layers or more (the action joins at the second), not {tuple(hidden)}")
        self.layer_norm = layer_norm
        sizes = [window, *hidden, 1]
        self.layers = nn.ModuleList(nn.utils.skip_init(nn.Linear, i, o) for i, o in pairwise(sizes))
        self.action = nn.utils.skip_init(nn.Linear, 1, hidden[1], bias=False)
        generator = torch.Generator().manual_seed(seed)
        initialise(self.layers, generator)
        with torch.no_grad():
            bound = 1.0 / math.sqrt(hidden[0] + 1)
            self.action.weight.uniform_(-bound, bound, generator=generator)

    def forward(self, scores: Any, actions: Any) -> Any:
        """Compute values [N, 1] of actions [N, 1] in z-scored windows [N, W], tensors of float32."""
        hidden = self._rectify(self.layers[0](scores))
        # The action's column of the second layer is separate: the actor's gradient then needs no product with the other columns.
        hidden = self._rectify(self.layers[1](hidden) + self.action(2.0 * actions - 1.0))
        for layer in self.layers[2:-1]:
            hidden = self._rectify(layer(hidden))
        return self.layers[-1](hidden)

    def _rectify(self, outputs: Any) -> Any:
        hidden = torch.relu(outputs)
        return nn.functional.layer_norm(hidden, hidden.shape[-1:]) if self.layer_norm else hidden


class Value(nn.Module):
    """The state value function V(s) on z-scored windows: a critic without an action.

    Args:
        window: W.
        hidden: units of each hidden layer.
        seed: seed of the initial weights.
    """

    def __init__(self, window: int, hidden: Sequence[int] = TEACHER_HIDDEN, *, seed: int = 0) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.utils.skip_init(nn.Linear, i, o) for i, o in pairwise([window, *hidden, 1]))
        initialise(self.layers, torch.Generator().manual_seed(seed))

    def forward(self, scores: Any) -> Any:
        """Compute values [N, 1] of z-scored windows, float32 tensor [N, W]."""
        hidden = scores
        for layer in self.layers[:-1]:
            hidden = torch.relu(layer(hidden))
        return self.layers[-1](hidden)


def initialise(layers: Any, generator: Any) -> None:
    """Draw Lillicrap's initial weights: uniform within 1 / sqrt(inputs) of 0, the last layer within 0.003; from `generator` alone."""
    with torch.no_grad():
        for i, layer in enumerate(layers):
            bound = _FINAL_INIT if i == len(layers) - 1 else 1.0 / math.sqrt(layer.in_features)
            layer.weight.uniform_(-bound, bound, generator=generator)
            layer.bias.uniform_(-bound, bound, generator=generator)
