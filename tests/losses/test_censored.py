"""The one-sided loss of clipped photographs."""

import pytest
import torch

from neurad.losses.censored import leave_one_out_censored
from neurad.losses.leave_one_out import ControlVariate, leave_one_out
from neurad.losses.relative import NOISE, relative_weight, two_pass


def problem(b=40, n=8):
    torch.manual_seed(4)
    samples = torch.rand(b, n, 3).requires_grad_()
    target, weight = torch.rand(b, 3), torch.rand(b, 3) + 0.5
    deviation = (torch.rand(b, n, 3) - 0.5).requires_grad_()
    return samples, target, weight, ControlVariate(torch.rand(b, n, 3), deviation, n // 2)


def gradients(loss, *tensors):
    return loss.value, *torch.autograd.grad(loss.surrogate, tensors)


@pytest.mark.parametrize("controlled", [False, True])
def test_below_the_ceiling_it_is_the_two_sided_loss(controlled):
    samples, _, weight, control = problem()
    target = torch.full((len(samples), 3), 9.0)  # above all renders
    control = control if controlled else None
    groups = 4 if controlled else None
    wanted = (samples, control.deviation) if controlled else (samples,)
    plain = gradients(leave_one_out(samples, target, weight, control, groups, use_kernels=False), *wanted)
    some = torch.rand(len(samples), 3) < 0.3
    for mask in (None, torch.zeros_like(some), some, torch.ones_like(some)):
        found = gradients(leave_one_out_censored(samples, target, weight, mask, control, groups), *wanted)
        for a, b in zip(found, plain, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6)


def test_above_the_ceiling_nothing_is_wrong():
    samples, target, weight, _ = problem()
    clipped = torch.rand(len(samples), 3) < 0.3
    low = torch.where(clipped, -1.0, target)  # renders lie above
    value, gradient = gradients(leave_one_out_censored(samples, low, weight, clipped), samples)
    want, expected = gradients(leave_one_out(samples, target, weight * ~clipped), samples)
    torch.testing.assert_close(value, want)
    torch.testing.assert_close(gradient, expected)
    assert not bool((gradient * clipped.unsqueeze(1)).any())


def test_the_second_rendering_is_censored_too():
    samples, target, weight, _ = problem()
    other = torch.rand_like(samples)
    clipped = torch.ones(len(samples), 3, dtype=torch.bool)
    assert not bool(gradients(two_pass(samples, other, target - 9, weight, clipped), samples)[1].any())
    _, one = gradients(two_pass(samples, other, target + 9, weight, clipped), samples)
    _, two = gradients(two_pass(samples, other, target + 9, weight), samples)
    torch.testing.assert_close(one, two)


def test_rounding_counts_where_it_is_coarser_than_noise():
    value = torch.tensor([1.0, 1e-3])
    fine, coarse = relative_weight(value, 1e-6), relative_weight(value, 1e-6, torch.full((2,), 1e-7))
    assert coarse[0] / fine[0] == pytest.approx(1, abs=1e-4)
    assert coarse[1] / fine[1] == pytest.approx(2e-6 / (2e-6 + 1e-7 / NOISE**2), rel=1e-4)
