"""Gains and response curves that a fit recovers from photographs."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neurad.core.records import PixelBatch
from neurad.core.scene_records import Camera, Development, View
from neurad.fields.development import FittedDevelopment
from neurad.images.development import Photography
from neurad.images.image_io import from_srgb, to_srgb
from neurad.optim.sparse_row_adam import SparseRowAdam


def views(count, exposures=None, levels=255):
    camera = Camera(np.eye(4), 1.0, 8, 8)
    exposures = exposures or [None] * count
    return [View(str(i), camera, development=Development("srgb", levels, None, e)) for i, e in enumerate(exposures)]


def batch_of(view, color):
    nothing = torch.zeros_like(view)
    return PixelBatch(view, nothing, color, torch.ones(len(view)), 0)


def fitted(model, batch, truth, steps, rate):
    optimizer = SparseRowAdam(model.parameters(), lr=rate)
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = rate * 0.02 ** (step / steps)
        optimizer.zero_grad()
        ((model.colors(batch) - truth).square() / (truth.square() + 0.01)).mean().backward()
        optimizer.step()


def test_what_is_known_is_not_recovered_and_at_the_start_photographs_are_as_they_are():
    assert FittedDevelopment.of(views(3), Photography("srgb")) is None
    assert FittedDevelopment.of([], Photography(exposure="fit")) is None

    model = FittedDevelopment(views(3, [0.5, 1, 2]), Photography("fit", None, "fit", "fit"))
    batch = batch_of(torch.arange(3), torch.rand(3, 3) * torch.tensor([[2.0], [1.0], [0.5]]))
    torch.testing.assert_close(model(batch).color, batch.color, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(model.exposures(), [[0.5] * 3, [1] * 3, [2] * 3])


@pytest.mark.parametrize("colours", [False, True])
def test_gains_are_recovered_up_to_a_common_factor(colours):
    torch.manual_seed(1)
    model = FittedDevelopment(views(6), Photography(None, None, "fit", "fit" if colours else "known"))
    log = (torch.rand(6, 3 if colours else 1) - 0.5).expand(-1, 3)
    view, truth = torch.randint(6, (4000,)), torch.rand(4000, 3)
    taken = truth * log.exp()[view]
    batch = batch_of(view, taken * (1 + 0.1 * torch.randn(4000, 3)))
    fitted(model, batch, truth * log.mean(0).exp(), 400, 0.02)
    np.testing.assert_allclose(model.exposures(), (log - log.mean(0)).exp(), rtol=0.01)


def test_colours_of_a_known_exposure_keep_it():
    model = FittedDevelopment(views(2), Photography(white_balance="fit"))
    with torch.no_grad():
        model.values.copy_(torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.0, -1.0]]))
    np.testing.assert_allclose(np.log(model.exposures()).mean(1), 0, atol=1e-6)
    np.testing.assert_allclose(np.log(model.exposures()).mean(0), 0, atol=1e-6)


def test_every_curve_rises():
    model = FittedDevelopment(views(1), Photography("fit"))
    for seed in range(20):
        torch.manual_seed(seed)
        with torch.no_grad():
            model.bend.copy_(3 * torch.randn(len(model.bend)))
            curve = model.curve()
        assert bool((curve.diff() > 0).all())
        assert (curve[0], curve[-1]) == (0, pytest.approx(1, abs=1e-5))


@pytest.mark.parametrize("gamma", [1.0, 1.8, 2.6])
def test_a_gamma_is_recovered(gamma):
    torch.manual_seed(2)
    model = FittedDevelopment(views(2), Photography("fit"))
    truth = torch.rand(5000, 3) ** 2
    code = truth ** (1 / gamma)
    batch = batch_of(torch.randint(2, (5000,)), srgb_decoded(code))
    fitted(model, batch, truth, 600, 0.05)
    with torch.no_grad():
        found = model.colors(batch)
    assert float((found - truth).abs().mean()) < 0.005


def test_noise_of_photographs_does_not_bend_the_curve():
    """Of photographs with 30 % noise, beginning at the truth: the curve stays where the derivative is that of what is
    predicted; otherwise all that is photographed becomes darker.
    """
    torch.manual_seed(3)
    truth = torch.rand(20000, 3) * 0.6
    taken = (truth * (1 + 0.3 * torch.randn(20000, 3))).clamp(0, 1)
    batch = batch_of(torch.zeros(20000, dtype=torch.int64), taken)
    brighter = {}
    for predicted in (False, True):
        model = FittedDevelopment(views(1), Photography("fit"))
        optimizer = SparseRowAdam(model.parameters(), lr=2e-3)
        for _ in range(300):
            optimizer.zero_grad()
            residual = model.colors(batch, truth if predicted else None) - truth
            (residual.square() / (truth.square() + 1e-3)).mean().backward()
            optimizer.step()
        with torch.no_grad():
            middle = batch_of(torch.zeros(1, dtype=torch.int64), torch.full((1, 3), 0.3))
            brighter[predicted] = float(model(middle).color.mean()) / 0.3
    assert brighter[True] == pytest.approx(1.0, abs=0.015), brighter
    assert brighter[False] < 0.97, brighter


def test_what_is_predicted_gives_the_derivative_alone():
    """The values are those that were photographed, and the derivative that of photographs of what is predicted."""
    torch.manual_seed(4)
    model = FittedDevelopment(views(2, [0.5, 2.0]), Photography("fit", None, "fit"))
    with torch.no_grad():
        model.bend.copy_(0.3 * torch.randn(len(model.bend)))
        model.values.copy_(torch.tensor([[0.2], [-0.1]]))
    view, radiance = torch.arange(2), torch.rand(2, 3) * 0.4
    batch = batch_of(view, torch.rand(2, 3) * 0.4)
    torch.testing.assert_close(model.colors(batch, radiance), model.colors(batch))
    there = replace(batch, color=model._photographed(radiance, batch))
    torch.testing.assert_close(model.colors(there), radiance, rtol=1e-3, atol=1e-5)
    found, wanted = (
        torch.autograd.grad(color.sum(), (model.bend, model.values))
        for color in (model.colors(batch, radiance), model.colors(there))
    )
    for a, b in zip(found, wanted, strict=True):
        torch.testing.assert_close(a, b)


def srgb_decoded(code):
    return torch.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def test_linear_photographs_have_no_response_and_curves_are_fitted_where_noise_clips_nothing():
    model = FittedDevelopment(views(2, levels=0), Photography("fit"))
    with torch.no_grad():
        model.bend.fill_(1.0)
    batch = batch_of(torch.zeros(4, dtype=torch.int64), torch.rand(4, 3) * 30)
    assert torch.equal(model(batch).color, batch.color)
    assert to_srgb(np.ones(1))[0] == pytest.approx(1)

    # By what is predicted, of any exposure; of linear photographs everywhere.
    model = FittedDevelopment([*views(2, [0.5, 2.0]), *views(1, levels=0)], Photography("fit"))
    radiance = torch.tensor([[0.1, 0.32, 0.33], [0.1, 1.29, 1.31], [0.1, 1.0, 9.0]])
    exposed = batch_of(torch.tensor([1, 0, 2]), torch.zeros(3, 3))
    assert model.below_ceiling(exposed, radiance).tolist() == [[True, True, False], [True, True, False], [True] * 3]


def test_the_curve_is_fitted_below_a_ceiling_that_is_given():
    """It is one of codes; the curve says which radiance that is."""
    lower = [replace(v, development=replace(v.development, ceiling=0.5)) for v in views(1)]
    model = FittedDevelopment(lower, Photography("fit", ceiling=0.5))
    half, batch = float(srgb_decoded(torch.tensor(0.5))), batch_of(torch.zeros(1, dtype=torch.int64), torch.zeros(1, 3))
    assert model.below_ceiling(batch, half * torch.tensor([[0.1, 0.64, 0.66]])).tolist() == [[True, True, False]]
    with torch.no_grad():
        model.bend[1] = 1.0
    bent = float(model.curve()[128])
    assert bent < 0.95 * half or bent > 1.05 * half
    assert model.below_ceiling(batch, bent * torch.tensor([[0.1, 0.64, 0.66]])).tolist() == [[True, True, False]]


def test_means_around_pixels_are_developed_by_themselves():
    """Of a pixel that is black by noise the mean around it is not."""
    model = FittedDevelopment(views(2), Photography(exposure="fit"))
    model.begin(torch.tensor([[0.7] * 3, [-0.7] * 3]))
    batch = replace(batch_of(torch.tensor([0, 1]), torch.zeros(2, 3)), blurred=torch.full((2, 3), 0.1))
    np.testing.assert_allclose(model(batch).blurred, 0.1 * np.exp([[-0.7] * 3, [0.7] * 3]), rtol=1e-5)


@pytest.mark.parametrize("curve", [False, True])
def test_what_rounding_leaves_open_is_developed_with_the_values(curve):
    """Variances are those of values that differ by little, by finite differences, as if the exposure had been known."""
    photography = Photography("fit" if curve else None, exposure="fit")
    model = FittedDevelopment(views(2, [0.5, 0.8]), photography)
    model.begin(torch.tensor([[1.2] * 3, [-1.2] * 3]))
    if curve:
        torch.nn.init.uniform_(model.bend, -0.4, 0.4)
    view = torch.tensor([0, 1]).repeat(200)
    code = (torch.randint(256, (400, 3)) + 0.5) / 256  # in the middle of an interval of the table
    color = torch.from_numpy(from_srgb(code.numpy())) / torch.tensor([0.5, 0.8])[view, None]
    batch = replace(batch_of(view, color), variance=torch.full((400, 3), 1e-4))
    step = 1e-3 * color
    moved = model(replace(batch, color=color + step)).color - model(replace(batch, color=color - step)).color
    np.testing.assert_allclose(model(batch).variance, 1e-4 * (moved / (2 * step)).square(), rtol=0.05)
