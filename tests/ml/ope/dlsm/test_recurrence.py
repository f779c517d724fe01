from __future__ import annotations

import numpy as np
import pytest
import torch
from numba import njit

from ml.ope.dlsm import recurrence as dlsm_recurrence
from ml.ope.dlsm.kernels import squash
from ml.ope.dlsm.recurrence import LOG_STD_BOUNDS, LatentWeights, bounded, lstm, lstm_loop, stochastic_lstm, stochastic_lstm_loop


def tensors(steps, batch, latent, hidden, inputs=3, seed=0):
    """Draw x, z0, eps and the weights in the order of `LatentWeights`; all but the noise want a gradient."""
    g = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return (0.4 * torch.randn(*shape, generator=g, dtype=torch.float64)).requires_grad_()

    eps = torch.randn(steps, batch, latent, generator=g, dtype=torch.float64)
    shapes = [
        (inputs, 4 * hidden), (4 * hidden,), (inputs, latent), (latent, 4 * hidden), (hidden, 4 * hidden), (latent, latent),
        (hidden, 2 * latent), (2 * latent,),
    ]  # fmt: skip
    return [draw(steps, batch, inputs), draw(batch, latent), eps, *(draw(*shape) for shape in shapes)]


def both(inputs):
    """Compute values and gradients of the fused recurrence and of the loop."""
    results = []
    wanted = [t for t in inputs if t.requires_grad]
    for way in (stochastic_lstm, stochastic_lstm_loop):
        out = way(*inputs[:3], LatentWeights(*inputs[3:]))
        weights = [torch.randn(t.shape, generator=torch.Generator().manual_seed(5)).to(t) for t in out]
        results.append((*out, *torch.autograd.grad(sum((o * w).sum() for o, w in zip(out, weights, strict=True)), wanted)))
    return zip(*results, strict=True)


@pytest.mark.parametrize(("steps", "batch", "latent", "hidden"), [(1, 1, 1, 1), (7, 3, 4, 5), (40, 6, 3, 8)])
def test_the_fused_stochastic_recurrence_has_the_values_and_gradients_of_the_loop(steps, batch, latent, hidden):
    for fast, slow in both(tensors(steps, batch, latent, hidden)):
        torch.testing.assert_close(fast, slow, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("numbers", [1, 200])
def test_the_steps_may_be_worked_through_in_pieces_of_any_size(numbers, monkeypatch):
    monkeypatch.setattr(dlsm_recurrence, "CHUNK", numbers)
    for fast, slow in both(tensors(23, 3, 4, 5)):
        torch.testing.assert_close(fast, slow, rtol=1e-9, atol=1e-11)
    x, _, _, w_x, bias, _, _, w_h, *_ = tensors(23, 3, 2, 5)
    wanted = [x, w_x, bias, w_h]
    grads = [torch.autograd.grad((way(*wanted) ** 2).sum(), wanted) for way in (lstm, lstm_loop)]
    for a, b in zip(*grads, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-11)


def test_single_precision_with_its_fitted_tanh_stays_within_a_millionth_per_step():
    single = [t.detach().float().requires_grad_(t.requires_grad) for t in tensors(40, 6, 3, 8)]
    for fast, slow in both(single):
        assert (fast - slow).abs().max() < 1e-5 * max(1.0, float(slow.detach().abs().max()))


def test_the_fitted_tanh_is_off_by_less_than_a_third_of_a_millionth_and_keeps_what_is_no_number():
    x = np.linspace(-20, 20, 200_001, dtype=np.float32)

    @njit
    def apply(values):
        return np.array([squash(v) for v in values])

    assert np.abs(apply(x) - np.tanh(x.astype(np.float64))).max() < 3.1e-7
    assert np.isnan(apply(np.array([np.nan], dtype=np.float32)))[0]
    np.testing.assert_allclose(apply(np.array([np.inf, -np.inf], dtype=np.float32)), [1.0, -1.0], atol=3e-7)


def test_what_is_no_number_comes_out_of_the_fused_recurrence_as_none():
    inputs = [t.detach().float() for t in tensors(5, 2, 2, 3)]
    inputs[0][2, 1, 0] = float("nan")
    z, _, _ = stochastic_lstm(*inputs[:3], LatentWeights(*inputs[3:]))
    assert torch.isnan(z[2:, 1]).all()
    assert torch.isfinite(z[:2]).all()
    assert torch.isfinite(z[:, 0]).all()


def test_the_fused_lstm_has_the_values_and_gradients_of_the_loop():
    x, _, _, w_x, bias, _, _, w_h, *_ = tensors(20, 4, 2, 6)
    weight = torch.randn(20, 4, 6, dtype=torch.float64)
    fast, slow = lstm(x, w_x, bias, w_h), lstm_loop(x, w_x, bias, w_h)
    torch.testing.assert_close(fast, slow)
    wanted = [x, w_x, bias, w_h]
    for a, b in zip(torch.autograd.grad((fast * weight).sum(), wanted), torch.autograd.grad((slow * weight).sum(), wanted), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-11)


def test_the_gradients_of_the_fused_recurrence_are_those_of_finite_differences():
    def flat(*inputs):
        return stochastic_lstm(*inputs[:3], LatentWeights(*inputs[3:]))

    assert torch.autograd.gradcheck(flat, tensors(4, 2, 2, 3), raise_exception=True)


def test_the_loop_is_torchs_lstm_when_the_gates_are_put_into_its_order():
    x, _, _, w_x, bias, _, _, w_h, *_ = (t.detach() for t in tensors(9, 3, 2, 5))
    reference = torch.nn.LSTM(3, 5).double()
    g, i, f, o = torch.eye(20, dtype=torch.float64).chunk(4, dim=1)
    order = torch.cat([i, f, g, o], dim=1)
    with torch.no_grad():
        reference.weight_ih_l0.copy_((w_x @ order).t())
        reference.bias_ih_l0.copy_(bias @ order)
        reference.bias_hh_l0.zero_()
        reference.weight_hh_l0.copy_((w_h @ order).t())
    torch.testing.assert_close(lstm_loop(x, w_x, bias, w_h), reference(x)[0])


def test_log_standard_deviations_stay_within_their_bounds_however_far_the_network_goes():
    low, high = LOG_STD_BOUNDS
    values = bounded(torch.tensor([-1e6, -3.0, 0.0, 3.0, 1e6]))
    assert low <= values.min() < values.max() <= high
