from __future__ import annotations

import pytest
import torch

from ml.ope.dlsm_recurrence import LOG_STD_BOUNDS, bounded, lstm, lstm_loop, stochastic_lstm, stochastic_lstm_loop


def tensors(steps, batch, latent, hidden, seed=0):
    g = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return (0.4 * torch.randn(*shape, generator=g, dtype=torch.float64)).requires_grad_()

    eps = torch.randn(steps, batch, latent, generator=g, dtype=torch.float64)
    return [
        draw(steps, batch, 4 * hidden),
        draw(steps, batch, latent),
        draw(batch, latent),
        eps,
        draw(latent, 4 * hidden),
        draw(hidden, 4 * hidden),
        draw(latent, latent),
        draw(hidden, 2 * latent),
        draw(2 * latent),
    ]


@pytest.mark.parametrize(("steps", "batch", "latent", "hidden"), [(1, 1, 1, 1), (7, 3, 4, 5), (40, 6, 3, 8)])
def test_the_fused_stochastic_recurrence_has_the_values_and_gradients_of_the_loop(steps, batch, latent, hidden):
    inputs = tensors(steps, batch, latent, hidden)
    fast, slow = stochastic_lstm(*inputs), stochastic_lstm_loop(*inputs)
    wanted = [t for t in inputs if t.requires_grad]
    weights = [torch.randn_like(t) for t in slow]
    grads = [torch.autograd.grad(sum((o * w).sum() for o, w in zip(out, weights, strict=True)), wanted) for out in (fast, slow)]
    for a, b in zip((*fast, *grads[0]), (*slow, *grads[1]), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-11)


def test_the_fused_lstm_has_the_values_and_gradients_of_the_loop():
    gates, w_h = tensors(20, 4, 2, 6)[0], tensors(20, 4, 2, 6)[5]
    weight = torch.randn(20, 4, 6, dtype=torch.float64)
    fast, slow = lstm(gates, w_h), lstm_loop(gates, w_h)
    torch.testing.assert_close(fast, slow)
    for a, b in zip(
        torch.autograd.grad((fast * weight).sum(), [gates, w_h]), torch.autograd.grad((slow * weight).sum(), [gates, w_h]), strict=True
    ):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-11)


def test_the_gradients_of_the_fused_recurrence_are_those_of_finite_differences():
    assert torch.autograd.gradcheck(stochastic_lstm, tensors(4, 2, 2, 3), raise_exception=True)


def test_the_loop_is_torchs_lstm_when_the_gates_are_put_into_its_order():
    gates, w_h = (t.detach() for t in (tensors(9, 3, 2, 5)[0], tensors(9, 3, 2, 5)[5]))
    reference = torch.nn.LSTM(20, 5, bias=False).double()
    g, i, f, o = torch.eye(20, dtype=torch.float64).chunk(4, dim=1)
    order = torch.cat([i, f, g, o], dim=1)
    with torch.no_grad():
        reference.weight_ih_l0.copy_(order.t())
        reference.weight_hh_l0.copy_((w_h @ order).t())
    torch.testing.assert_close(lstm_loop(gates, w_h), reference(gates)[0])


def test_log_standard_deviations_stay_within_their_bounds_however_far_the_network_goes():
    low, high = LOG_STD_BOUNDS
    values = bounded(torch.tensor([-1e6, -3.0, 0.0, 3.0, 1e6]))
    assert low <= values.min() < values.max() <= high
