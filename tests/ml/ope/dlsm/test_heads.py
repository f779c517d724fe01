"""The fused log density of a Gaussian head against the readable one."""

from __future__ import annotations

import pytest
import torch

from ml.ope.dlsm import heads as dlsm_heads
from ml.ope.dlsm.heads import GaussianHead


def head_and_data(hidden, rows=(7, 3), dtype=torch.float64):
    torch.manual_seed(1)
    head = GaussianHead(4, 2, hidden).to(dtype)
    with torch.no_grad():
        for parameter in head.parameters():
            parameter.copy_(0.5 * torch.randn_like(parameter))  # the last layer starts at zero, which would hide it
    x = torch.randn(*rows, 4, dtype=dtype, requires_grad=True)
    return head, x, torch.randn(*rows, 2, dtype=dtype)


@pytest.mark.parametrize("hidden", [(), (5,), (6, 3)])
@pytest.mark.parametrize("rows_at_once", [4, 1024])
def test_the_fused_head_has_the_values_and_gradients_of_the_readable_one(hidden, rows_at_once, monkeypatch):
    monkeypatch.setattr(dlsm_heads, "ROWS", rows_at_once)
    head, x, target = head_and_data(hidden)
    weight = torch.randn(7, 3, dtype=torch.float64)
    wanted = [x, *head.parameters()]
    fast, slow = (head.log_prob(x, target, fast=fast) for fast in (True, False))
    torch.testing.assert_close(fast, slow, rtol=1e-10, atol=1e-12)
    grads = [torch.autograd.grad((log_prob * weight).sum(), wanted) for log_prob in (fast, slow)]
    for a, b in zip(*grads, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-11)


def test_the_gradients_of_the_fused_head_are_those_of_finite_differences():
    head, x, target = head_and_data((5, 3), rows=(3,))
    assert torch.autograd.gradcheck(lambda given: head.log_prob(given, target), (x,), raise_exception=True)


def test_in_single_precision_the_fused_head_is_within_its_rounding():
    head, x, target = head_and_data((32, 16), rows=(500,), dtype=torch.float32)
    fast, slow = (head.log_prob(x, target, fast=fast) for fast in (True, False))
    assert (fast - slow).abs().max() < 1e-4 * slow.abs().max()


def test_what_is_no_number_stays_visible_in_its_row_alone():
    head, x, target = head_and_data((5,), rows=(6,))
    with torch.no_grad():
        x[2, 1] = float("nan")
    found = head.log_prob(x, target)
    assert torch.isnan(found[2])
    assert torch.isfinite(found[[0, 1, 3, 4, 5]]).all()
