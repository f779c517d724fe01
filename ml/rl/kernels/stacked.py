"""K networks of one shape side by side: their weights in one tensor, their matrix products in one call, their gradients by hand.

Six small networks trained one after the other leave most of a processor core idle between calls; side by side they share the calls. The
gradients are written out (back-propagation through ReLU layers is ten lines) instead of recorded. Nothing is allocated within an update,
every product is written straight into the gradient that Adam reads, and no unused gradient is computed. All tensors have the member as
first dimension, K = 1 included. Member k's numbers depend on member k's weights and batch alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from ml.rl.kernels.networks import Critic, MlpPolicy, Value

_LAYER_NORM_EPSILON = 1e-5


class Stack:
    """K multi-layer perceptrons with ReLU and one output, an action joining at the second layer where they are critics.

    Args:
        members: K networks of one shape; copied.
        batch: B, rows for which memory is kept between calls; other sizes work too, and allocate.
        device: where the weights live.
        shares: a stack of the same sizes whose memory this one uses too; the `forward` of one then ends the other's right to `backward`.
            Less memory in turn stays nearer to the core.

    Attributes:
        weights: [K, P], a row per member in the order of its module's `parameters()`.
        gradient: [K, P], written by `backward`.
    """

    def __init__(self, members: Sequence[nn.Module], batch: int, device: str = "cpu", shares: Stack | None = None) -> None:
        first: Any = members[0]
        self._batch = batch
        self._norm = bool(getattr(first, "layer_norm", False))
        self.weights = torch.stack([parameters_to_vector(member.parameters()).detach() for member in members]).to(device)
        self.gradient = torch.zeros_like(self.weights)
        shapes = {name: parameter.shape for name, parameter in first.named_parameters()}
        own, slope = _views(self.weights, shapes), _views(self.gradient, shapes)
        depth = len(first.layers)
        self._w = [own[f"layers.{i}.weight"] for i in range(depth)]
        self._b = [own[f"layers.{i}.bias"].unsqueeze(1) for i in range(depth)]
        self._grad_w = [slope[f"layers.{i}.weight"] for i in range(depth)]
        self._grad_b = [slope[f"layers.{i}.bias"].unsqueeze(1) for i in range(depth)]
        self._action_w: Any = own.get("action.weight")
        self._grad_action_w: Any = slope.get("action.weight")
        self._memory: _Memory = _Memory(self._w, batch) if shares is None else shares._memory
        self._last: _Memory | None = None

    @property
    def members(self) -> int:
        """K."""
        return int(self.weights.shape[0])

    def forward(self, scores: Any, actions: Any = None) -> Any:
        """Compute outputs [K, B, 1] for z-scored windows [K, B, W] and, for critics, actions [K, B, 1].

        The next call overwrites the memory of the answer.
        """
        memory = self._last = self._memory_for(int(scores.shape[1]))
        signed = None if actions is None else torch.sub(actions, 0.5).mul_(2.0)
        memory.signed = signed
        hidden = scores
        for i, (weight, bias) in enumerate(zip(self._w, self._b, strict=True)):
            memory.inputs[i] = hidden
            out = memory.outputs[i]
            if i == 1 and signed is not None:
                torch.addcmul(bias, signed, self._action_w.transpose(1, 2), out=out)
                out.baddbmm_(hidden, weight.transpose(1, 2))
            else:
                torch.baddbmm(bias, hidden, weight.transpose(1, 2), out=out)
            if i == len(self._w) - 1:
                return out
            hidden = out.relu_()
            if self._norm:
                hidden, memory.inverse_deviation[i] = _layer_norm(hidden)
        raise AssertionError("a network has at least one layer")

    def backward(self, slope: Any) -> None:
        """Write d loss / d weights into `gradient`, from d loss / d output of the last `forward`, shape [K, B, 1]."""
        memory = self._required_memory(slope)
        for i in reversed(range(len(self._w))):
            torch.bmm(slope.transpose(1, 2), memory.inputs[i], out=self._grad_w[i])
            torch.sum(slope, 1, keepdim=True, out=self._grad_b[i])
            if i == 1 and memory.signed is not None:
                torch.bmm(slope.transpose(1, 2), memory.signed, out=self._grad_action_w)
            if i > 0:
                slope = self._slope_below(i, slope, memory)

    def action_gradient(self, slope: Any) -> Any:
        """Compute d loss / d actions [K, B, 1], from d loss / d output of the last `forward`; the weights' gradient does not change."""
        memory = self._required_memory(slope)
        for i in reversed(range(2, len(self._w))):
            slope = self._slope_below(i, slope, memory)
        return torch.bmm(slope, self._action_w).mul_(2.0)

    def _slope_below(self, i: int, slope: Any, memory: _Memory) -> Any:
        """Compute the slope before layer i's input was rectified, from the slope at layer i's output."""
        below = torch.bmm(slope, self._w[i], out=memory.slopes[i - 1])
        if self._norm:
            below = _layer_norm_slope(below, memory.inputs[i], memory.inverse_deviation[i - 1])
        # Where the rectified output is 0 the slope ends; PyTorch's own backward of ReLU, written in place.
        return torch.ops.aten.threshold_backward.grad_input(below, memory.outputs[i - 1], 0.0, grad_input=below)

    def _memory_for(self, rows: int) -> _Memory:
        return self._memory if rows == self._batch else _Memory(self._w, rows)

    def _required_memory(self, slope: Any) -> _Memory:
        if self._last is None or slope.shape != self._last.outputs[-1].shape:
            last = "none" if self._last is None else list(self._last.outputs[-1].shape)
            raise ValueError(f"a gradient needs the outputs of the last forward pass: {last}, not {list(slope.shape)}")
        return self._last


class StackedActor(Stack):
    """K policies: the perceptron's output x bounded to (tanh(x) + 1) / 2."""

    def act(self, scores: Any) -> Any:
        """Compute amplitude fractions [K, B, 1] for z-scored windows [K, B, W]."""
        return torch.tanh(self.forward(scores)).add_(1.0).mul_(0.5)

    def backward_from_actions(self, slope: Any, actions: Any) -> None:
        """Run `backward` from d loss / d actions, both [K, B, 1]; `actions` are the answers of the last `act`."""
        # d a / d x = (1 - tanh(x)^2) / 2 = 2 a (1 - a)
        self.backward(torch.addcmul(actions, actions, actions, value=-1.0).mul_(slope).mul_(2.0))


class StackedAdam:
    """Adam (Kingma and Ba 2015) with a learning rate per member; the same numbers as `torch.optim.Adam(fused=True)`.

    Calls PyTorch's fused kernel itself: the optimiser class around it costs more per update than the kernel at these sizes.

    Args:
        stack: whose weights move down their gradient. rates: a learning rate per member. decay: L2 penalty inside the gradient.
    """

    def __init__(self, stack: Stack, rates: Sequence[float], decay: float = 0.0) -> None:
        self._moments = torch.zeros(2, *stack.weights.shape, device=stack.weights.device)
        self._steps = torch.zeros(stack.members, device=stack.weights.device)
        rows: list[tuple[Any, ...]] = [
            ([stack.weights[k]], [stack.gradient[k]], [self._moments[0, k]], [self._moments[1, k]], [], [self._steps[k]])
            for k in range(stack.members)
        ]
        self._calls = list(zip(rows, rates, strict=True))
        self._decay = decay

    def step(self) -> None:
        """Take one step down `stack.gradient`."""
        self._steps.add_(1.0)
        for (weights, gradients, first, second, maxima, steps), rate in self._calls:
            torch._fused_adam_(
                weights,
                gradients,
                first,
                second,
                maxima,
                steps,
                lr=rate,
                beta1=0.9,
                beta2=0.999,
                weight_decay=self._decay,
                eps=1e-8,
                amsgrad=False,
                maximize=False,
            )

    def state(self) -> dict[str, Any]:
        """Copy moments and step counts."""
        return {"moments": self._moments.cpu().clone(), "steps": self._steps.cpu().clone()}

    def load_state(self, state: dict[str, Any]) -> None:
        """Put a `state` back; the learning rates stay."""
        self._moments.copy_(state["moments"])
        self._steps.copy_(state["steps"])


def into_module(row: Any, module: MlpPolicy | Critic | Value) -> None:
    """Write one member's weights [P] into a module of its shape."""
    with torch.no_grad():
        vector_to_parameters(row.detach().cpu().clone(), module.parameters())


class _Memory:
    """Values that a forward pass leaves for its backward pass, for `rows` rows."""

    def __init__(self, weights: Sequence[Any], rows: int) -> None:
        members, device = int(weights[0].shape[0]), weights[0].device
        self.outputs = [torch.empty(members, rows, int(w.shape[1]), device=device) for w in weights]
        self.slopes = [torch.empty(members, rows, int(w.shape[1]), device=device) for w in weights[:-1]]
        self.inputs: list[Any] = [None] * len(weights)
        self.inverse_deviation: list[Any] = [None] * len(weights)
        self.signed: Any = None


def _views(flat: Any, shapes: dict[str, Any]) -> dict[str, Any]:
    """Return views [K, *shape] of the columns of `flat`, by parameter name."""
    views, start = {}, 0
    for name, shape in shapes.items():
        views[name] = flat[:, start : start + shape.numel()].view(flat.shape[0], *shape)
        start += shape.numel()
    return views


def _layer_norm(hidden: Any) -> tuple[Any, Any]:
    """Centre each row and scale it to unit deviation; also return one over the deviation it had."""
    deviation, mean = torch.var_mean(hidden, dim=-1, correction=0, keepdim=True)
    inverse = deviation.add_(_LAYER_NORM_EPSILON).rsqrt_()
    return torch.sub(hidden, mean).mul_(inverse), inverse


def _layer_norm_slope(slope: Any, normed: Any, inverse: Any) -> Any:
    """Compute the slope before layer normalisation: minus its mean and its part along the normalised row, over the deviation."""
    along = torch.mul(slope, normed).mean(dim=-1, keepdim=True)
    return slope.sub_(slope.mean(dim=-1, keepdim=True)).addcmul_(normed, along, value=-1.0).mul_(inverse)
