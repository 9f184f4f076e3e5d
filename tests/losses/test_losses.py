"""Unbiased gradients of the relative L2 loss, against closed forms."""

import pytest
import torch

from neurad.losses.leave_one_out import ControlVariate, leave_one_out, leave_one_out_censored
from neurad.losses.relative import (
    NOISE,
    full_gradient_prior,
    relative_weight,
    semi_gradient_prior,
    total,
    two_pass,
    weighted,
)

TRIALS = 40_000


def noisy(parameter, n, generator):
    """Samples with mean ``parameter`` and a noise that grows with it, so that naive gradients are biased."""
    return parameter * (1.0 + torch.randn(TRIALS, n, 1, generator=generator))


def gradient_statistics(make_loss):
    """Mean and standard error of the gradient with respect to a parameter that all trials share."""
    parameter = torch.full((TRIALS, 1, 1), 0.7, requires_grad=True)
    loss = make_loss(parameter)
    loss.surrogate.backward()
    each = parameter.grad.flatten() * TRIALS
    return each.mean().item(), (each.std() / TRIALS**0.5).item(), loss


TARGET, WEIGHT = 0.4, 2.0
TRUE_GRADIENT = 2 * WEIGHT * (0.7 - TARGET)


def test_both_forms_of_the_photometric_gradient_are_unbiased_and_agree():
    generator = torch.Generator().manual_seed(1)
    target = torch.full((TRIALS, 1), TARGET)
    weight = torch.full((TRIALS, 1), WEIGHT)
    once, once_error, loss = gradient_statistics(lambda p: leave_one_out(noisy(p, 2, generator), target, weight))
    twice, twice_error, _ = gradient_statistics(
        lambda p: two_pass(noisy(p, 2, generator), noisy(p.detach(), 2, generator), target, weight)
    )
    # 99.9 % confidence: 3.3 standard errors.
    assert abs(once - TRUE_GRADIENT) < 3.3 * once_error
    assert abs(twice - TRUE_GRADIENT) < 3.3 * twice_error
    assert abs(once - twice) < 3.3 * (once_error**2 + twice_error**2) ** 0.5
    assert once_error < 0.05 * TRUE_GRADIENT  # the test could see a bias
    assert abs(loss.value.item() - WEIGHT * (0.7 - TARGET) ** 2) < 0.02


def test_the_naive_gradient_is_biased_so_the_test_above_can_fail():
    generator = torch.Generator().manual_seed(2)
    parameter = torch.full((TRIALS, 1, 1), 0.7, requires_grad=True)
    mean = noisy(parameter, 2, generator).mean(1)
    (WEIGHT * (mean - TARGET) ** 2).mean().backward()
    each = parameter.grad.flatten() * TRIALS
    assert each.mean() - TRUE_GRADIENT > 10 * each.std() / TRIALS**0.5


def test_leave_one_out_formula_on_three_samples_and_on_two_groups_of_two():
    samples = torch.tensor([[[1.0], [2.0], [6.0]]], requires_grad=True)
    leave_one_out(samples, torch.tensor([[0.5]]), torch.tensor([[3.0]])).surrogate.backward()
    others = torch.tensor([4.0, 3.5, 1.5])
    torch.testing.assert_close(samples.grad.flatten(), 2 / 3 * 3.0 * (others - 0.5))

    samples = torch.tensor([[[1.0], [2.0], [6.0], [7.0]]], requires_grad=True)
    leave_one_out(samples, torch.tensor([[0.5]]), torch.tensor([[3.0]]), groups=2).surrogate.backward()
    others = torch.tensor([6.5, 6.5, 1.5, 1.5])
    torch.testing.assert_close(samples.grad.flatten(), 2 / 4 * 3.0 * (others - 0.5))


def test_chroma_counts_more_than_what_channels_share():
    """Relative to the normaliser a grey residual counts as ever and one without grey ``chroma`` times; it is the
    gradient of a quadratic form, and with samples that do not scatter that of both estimators.
    """
    weight = torch.tensor([[4.0, 1.0, 0.25]])
    root = weight.sqrt()
    for relative, factor in ([1.0, 1.0, 1.0], 1.0), ([1.0, -1.0, 0.0], 6.0), ([1.0, 1.0, -2.0], 6.0):
        residual = torch.tensor([relative]) / root
        torch.testing.assert_close(weighted(residual, weight, 6.0), factor * weight * residual)
    relative = torch.randn(5, 3, dtype=torch.float64, requires_grad=True)
    grey = relative.mean(-1, keepdim=True)
    form = (grey**2).expand_as(relative).sum() + 6.0 * ((relative - grey) ** 2).sum()
    (gradient,) = torch.autograd.grad(form, relative)
    torch.testing.assert_close(2.0 * weighted(relative.detach(), torch.ones(5, 1, dtype=torch.float64), 6.0), gradient)
    samples = torch.randn(5, 1, 3).expand(5, 4, 3)
    target, weight = torch.randn(5, 3), torch.rand(5, 3)
    found = []
    for loss in (
        lambda x: leave_one_out(x, target, weight, chroma=6.0),
        lambda x: two_pass(x, samples, target, weight, chroma=6.0),
    ):
        x = samples.clone().requires_grad_()
        value = loss(x)
        found.append((value.value, torch.autograd.grad(value.surrogate, x)[0]))
    torch.testing.assert_close(found[0], found[1])


def test_prior_gradients_reach_the_sides_that_they_should():
    field = torch.tensor([[2.0, 2.0, 2.0]], requires_grad=True)
    right = torch.tensor([[1.0, 1.0, 1.0]], requires_grad=True)
    other = torch.tensor([[1.5, 1.5, 1.5]], requires_grad=True)
    mask = torch.tensor([True])
    semi_gradient_prior(field, right, 0.0, mask).surrogate.backward()
    assert right.grad is None
    torch.testing.assert_close(field.grad, torch.full((1, 3), 2 * (2 - 1) / 4 / 3))
    field.grad = None
    full_gradient_prior(field, right, other, 0.0, mask).surrogate.backward()
    torch.testing.assert_close(right.grad, torch.full((1, 3), -(2 - 1.5) / 4 / 3))
    torch.testing.assert_close(field.grad, torch.full((1, 3), ((2 - 1.5) + (2 - 1)) / 4 / 3))


def test_masked_lanes_and_weights_count_nothing():
    field = torch.ones(2, 3, requires_grad=True)
    loss = semi_gradient_prior(field, torch.zeros(2, 3), 0.01, torch.tensor([True, False]))
    total({"a": (2.0, loss)}).backward()
    assert (field.grad[1] == 0).all()
    assert (field.grad[0] > 0).all()
    assert not relative_weight(field, 0.01).requires_grad


@pytest.mark.parametrize(("samples", "groups"), [(2, 2), (5, 5), (8, 4), (6, 2)])
@pytest.mark.parametrize("controlled", [False, True])
@pytest.mark.parametrize("pixels", [7, 7000])  # the latter are shared among threads
@pytest.mark.parametrize("chroma", [1.0, 6.0])
@pytest.mark.usefixtures("three_threads")
def test_the_compiled_leave_one_out_is_the_plain_one(
    samples: int, groups: int, controlled: bool, pixels: int, chroma: float
) -> None:
    generator = torch.Generator().manual_seed(samples)

    def numbers(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    value, light, deviation = numbers(3, pixels, samples, 3).abs().unbind()
    target, weight = numbers(pixels, 3), numbers(pixels, 1).abs()

    def found(use_kernels: bool) -> list[torch.Tensor]:
        s, z = value.clone().requires_grad_(), (deviation - 0.7).requires_grad_()
        control = ControlVariate(light, z, groups) if controlled else None
        loss = leave_one_out(s, target, weight, control, groups, use_kernels, chroma)
        (3.0 * loss.surrogate).backward()
        assert not loss.value.requires_grad
        return [loss.surrogate.detach(), loss.value, s.grad, *([z.grad] if controlled else [])]

    for kernel, reference in zip(found(True), found(False), strict=True):
        torch.testing.assert_close(kernel, reference, rtol=1e-5, atol=1e-6 * chroma)


@pytest.mark.parametrize(("samples", "groups", "of_control"), [(5, 2, None), (4, 1, None), (8, 4, 2)])
def test_leave_one_out_refuses_uneven_groups(samples: int, groups: int, of_control: int | None) -> None:
    x = torch.ones(3, samples, 3)
    control = None if of_control is None else ControlVariate(x, x, of_control)
    with pytest.raises(ValueError, match="groups"):
        leave_one_out(x, x[:, 0], x[:, 0], control, groups)


# ---- values that are clipped


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
