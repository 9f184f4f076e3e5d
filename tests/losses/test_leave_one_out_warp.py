"""The loss's kernel for a GPU, there or on Warp's CPU, against the loss in plain torch."""

from contextlib import nullcontext

import pytest
import torch
from helpers.devices import close, on_devices
from helpers.host_questions import no_host_questions

from neurad.losses.leave_one_out import ControlVariate, leave_one_out, leave_one_out_censored
from neurad.runtime import dispatch

pytestmark = pytest.mark.usefixtures("warp_on_cpu")


def random(pixels, samples):
    generator = torch.Generator().manual_seed(samples)
    draw = [torch.randn(pixels, samples, 3, generator=generator) for _ in range(3)]
    rest = [torch.randn(pixels, 3, generator=generator) for _ in range(3)]
    return draw[0].abs(), draw[1].abs(), draw[2] - 0.7, rest[0], rest[1].abs(), rest[2] > 1.0


def derived(device, given, groups, controlled, chroma, weight_of_pixel, censored):
    """Surrogate, loss, and the gradients of samples and deviation."""
    samples, light, deviation, target, weight, mask = (x.to(device, copy=True) for x in given)
    samples.requires_grad_()
    deviation.requires_grad_()
    control = ControlVariate(light, deviation, groups) if controlled else None
    weight = weight[:, :1] if weight_of_pixel else weight
    with no_host_questions() if dispatch.WARP_DEVICES else nullcontext():
        loss = leave_one_out_censored(samples, target, weight, mask if censored else None, control, groups, chroma)
        (3.0 * loss.surrogate).backward()
    assert not loss.value.requires_grad
    return [loss.surrogate, loss.value, samples.grad, *([deviation.grad] if controlled else [])]


@on_devices
@pytest.mark.parametrize(("samples", "groups"), [(2, 2), (5, 5), (8, 4), (6, 2)])
@pytest.mark.parametrize("controlled", [False, True])
@pytest.mark.parametrize("censored", [False, True])
@pytest.mark.parametrize(("chroma", "weight_of_pixel"), [(1.0, True), (6.0, False)])
def test_value_and_gradients_are_those_of_the_reference(
    monkeypatch, device, samples, groups, controlled, censored, chroma, weight_of_pixel
):
    given = random(70, samples)
    settings = groups, controlled, chroma, weight_of_pixel, censored
    found = derived(device, given, *settings)
    monkeypatch.setattr(dispatch, "WARP_DEVICES", ())
    expected = derived("cpu", [x.double() if x.is_floating_point() else x for x in given], *settings)
    for one, other in zip(found, expected, strict=True):
        assert one.device.type == device
        close(one.double(), other, rtol=1e-5, atol=1e-5 * float(other.detach().abs().max()))


@on_devices
def test_other_samples_have_no_kernel(device):
    for channels, dtype in ((1, torch.float32), (3, torch.float64)):
        samples = torch.rand(4, 2, channels, dtype=dtype, device=device, requires_grad=True)
        loss = leave_one_out(samples, samples.detach()[:, 0], torch.ones(4, 1, dtype=dtype, device=device))
        assert loss.surrogate.dtype == dtype
        loss.surrogate.backward()
        assert bool(samples.grad.isfinite().all())


@on_devices
def test_what_is_not_a_number_is_not_hidden(device):
    samples = torch.rand(4, 2, 3, device=device)
    samples[2, 1, 1] = float("nan")
    loss = leave_one_out(samples.requires_grad_(), samples.detach()[:, 0], torch.ones(4, 3, device=device))
    loss.surrogate.backward()
    assert bool(loss.value.isnan())
    assert bool(samples.grad[2].isnan().any())
    assert bool(samples.grad[:2].isfinite().all())
