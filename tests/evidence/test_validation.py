"""Factors of levels from pixels that were never drawn: found where they are known, left alone where all is right."""

import numpy as np
import pytest
import torch

from neurad.assembly.fitted_materials import FittedMaterials
from neurad.core.parameters import ALBEDO, ROUGHNESS
from neurad.evidence.pixel_derivatives import PixelDerivatives
from neurad.evidence.validation import _cross_validated, _Response, fit_levels
from neurad.fields.material import MaterialField
from neurad.fields.settings import FieldConfig, GridConfig, RoughnessConfig
from neurad.optim.polyak_average import LevelFactors

GRID = GridConfig(levels=3, coarsest=2, finest=12, log2_size=12)
BOUNDS = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
PIXELS, SAMPLES = 2000, 2
TRUE = (1.0, 0.8, 0.3), (1.0, 1.3, 0.5)


def fields(glossy):
    """Fields that differ from place to place at every level."""
    torch.manual_seed(3)
    made = {"albedo": MaterialField(ALBEDO, FieldConfig(grid=GRID, width=32), BOUNDS)}
    if glossy:
        config = RoughnessConfig(grid=GRID, width=32, reads_albedo=True)
        made["roughness"] = MaterialField(ROUGHNESS, config, BOUNDS)
    for field in made.values():
        torch.nn.init.normal_(field.grid.table, std=1.0)
        with torch.no_grad():  # far from flat
            [p for p in field.mlp.parameters() if p.dim() == 2][-1].mul_(8.0)
    return FittedMaterials(made)


def photographed(materials, true, noise, seed=5):
    """Pixels whose photographs show the fields with the factors ``true`` of their levels, and noise."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(PIXELS, 1, 3, generator=generator) + 1e-3 * torch.rand(PIXELS, SAMPLES, 3, generator=generator)
    by_albedo = 0.5 + torch.rand(2, PIXELS, 3, generator=generator)
    by_roughness = torch.randn(PIXELS, 3, generator=generator) + 0.3 * torch.randn(2, PIXELS, 3, generator=generator)

    def values(factors):
        def scaled(field, of):
            return field.features(points.view(-1, 3)) * torch.tensor(of).repeat_interleave(2)

        albedo = materials.fields["albedo"].of_features(scaled(materials.fields["albedo"], factors[0]))
        rough = materials.recovered.get("roughness")
        found = None if rough is None else rough.of_features(scaled(rough, factors[1]), albedo)
        return [None if x is None else x.view(PIXELS, SAMPLES, -1).mean(1) for x in (albedo, found)]

    with torch.no_grad():
        now, meant = values(((1.0,) * 3,) * 2), values(true)
        residual = by_albedo * (meant[0] - now[0]) + noise * torch.randn(2, PIXELS, 3, generator=generator)
        if now[1] is not None:
            residual += by_roughness * (meant[1] - now[1])
    one = np.ones((PIXELS, 3), np.float32)
    return PixelDerivatives(
        p=points[:, 0].numpy(), area=one[:, 0], odd=np.arange(PIXELS) % 2 == 0, residual=residual.numpy(),
        by={"albedo": by_albedo.numpy(), "roughness": by_roughness.numpy()}, misfit=one, predicted=one,
        albedo=now[0].numpy(), detail=0 * one, points=points.numpy(),
        prims=np.zeros(points.shape[:2], np.int64),
    )  # fmt: skip


@pytest.mark.parametrize("glossy", [False, True])
def test_factors_that_photographs_show_are_found(glossy):
    materials = fields(glossy)
    levels = LevelFactors(materials)
    found = fit_levels(photographed(materials, TRUE, 0.02), materials.recovered, levels, 1e-3)
    assert len(found) == 1 + glossy
    for fit, true in zip(found, TRUE, strict=False):
        assert fit.holds
        assert fit.factors.tolist() == pytest.approx(list(true), abs=0.04)
    assert all(bool((factors == 1.0).all()) for _, factors in levels.items())


@pytest.mark.parametrize("glossy", [False, True])
def test_one_set_of_derivatives_comes_near(glossy):
    """Of the albedo alone: nearer than whole levels are, and what it finds is as clear; fields that are as far from
    linear as these take more sets to be right.
    """
    materials, true = fields(glossy), (TRUE[0], (1.0,) * 3)
    (fit,) = fit_levels(
        photographed(materials, true, 0.02), materials.recovered, LevelFactors(materials), 1e-3, quick=True
    )
    assert fit.is_clear
    off = (fit.factors - torch.tensor(TRUE[0])).abs().max()
    assert float(off) < 0.5 * (1.0 - min(TRUE[0]))


def test_a_field_that_is_asked_again_is_judged_by_the_same():
    """Factors that it had from the first time do not become what others have to be better than."""
    materials = fields(glossy=False)
    levels, pixels = LevelFactors(materials), photographed(materials, TRUE, 0.02)
    with torch.no_grad():
        response = _Response(pixels, materials.recovered, levels, 1e-3)
        first = _cross_validated(response, [torch.ones(3)], 0, torch.from_numpy(pixels.odd), 0.0)
        again = _cross_validated(response, [first.factors], 0, torch.from_numpy(pixels.odd), 0.0)
    assert first.is_clear
    assert (again.gain, again.error) == (first.gain, first.error)
    assert torch.equal(again.factors, first.factors)


def test_fields_that_are_right_are_left_alone():
    """Noise alone: what fits one half of the pixels raises the loss of the other in the mean. Factors change next to
    nothing, and more than three of 16 are clear, at 2 sigma, once in 3000 times (2.3 % each).
    """
    materials = fields(glossy=True)
    fits = [
        fit
        for seed in range(8)
        for fit in fit_levels(
            photographed(materials, ((1.0,) * 3,) * 2, 0.3, seed), materials.recovered, LevelFactors(materials), 1e-3
        )
    ]
    assert sum(fit.is_clear for fit in fits) <= 3
    assert all(fit.holds == fit.is_clear for fit in fits[1::2])  # roughness
    assert all(float((fit.factors - 1.0).abs().max()) < 0.1 for fit in fits)
    assert all(fit.holds or bool((fit.factors == 1.0).all()) for fit in fits)


def test_half_of_the_samples_being_wrong_changes_nothing():
    """Noise of one half alone: the product of halves has none of it in its mean."""
    materials = fields(glossy=False)
    pixels = photographed(materials, TRUE, 0.0)
    generator = np.random.default_rng(1)
    pixels.residual[0] += 0.5 * generator.standard_normal(pixels.residual[0].shape).astype(np.float32)
    found = fit_levels(pixels, materials.recovered, LevelFactors(materials), 1e-3)
    assert found[0].factors.tolist() == pytest.approx(list(TRUE[0]), abs=0.1)
