"""What all models share, and those with constants of their own: against Mitsuba, statistics, and in a table."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.directions import directions, toward, uniform
from helpers.oracles import accept, chi2_test, z_test_samples

from neurad.bsdf.diffuse import Diffuse
from neurad.bsdf.principled import Principled
from neurad.bsdf.table import IMPLEMENTATIONS, make_bsdf
from neurad.core.records import Surface
from neurad.core.reflection import (
    DiffuseModel,
    PrincipledModel,
    ReflectionModel,
    RoughConductorModel,
    RoughPlasticModel,
    UnsupportedModel,
)
from neurad.scene.description import Features

COPPER = (0.2, 0.92, 1.1), (3.91, 2.45, 2.14)
WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
MODELS = {
    "diffuse": DiffuseModel(),
    "metal": PrincipledModel(),
    "half a metal": PrincipledModel(eta=1.3),
    "dense": PrincipledModel(eta=2.0),
    "copper": RoughConductorModel(*COPPER, 0.15),
    "rough copper": RoughConductorModel(*COPPER, 0.6),
    "white metal": RoughConductorModel(*WHITE, 0.3),
    "plastic": RoughPlasticModel(1.49, 0.2),
    "tinted plastic": RoughPlasticModel(1.9, 0.5, (0.9, 0.6, 0.3)),
    "saturated plastic": RoughPlasticModel(1.5, 0.1, nonlinear=True),
}

METALS = {"metal": 1.0, "half a metal": 0.4}
"""How much of a metal the surfaces of a model are."""


GRAZING = 0.02


def bsdf_of(model, specular_fraction=0.5):
    return IMPLEMENTATIONS[type(model)](model, specular_fraction)


ALL = {
    "principled": Principled(),
    "principled in torch": Principled(use_kernels=False),
    **{name: bsdf_of(model) for name, model in MODELS.items()},
}


def of(name, surface):
    """The surface with the metalness that goes with a model."""
    metallic = METALS.get(name)
    return surface if metallic is None else replace(surface, metallic=torch.full_like(surface.roughness, metallic))


def surfaces(model, count):
    """Random roughness from 0.15 and random base colours, those of metals at most the reflectance of the bare metal."""
    limit = torch.tensor(getattr(model, "normal_reflectance", (1.0, 1.0, 1.0)))
    return Surface((0.05 + 0.9 * uniform(count, 3)) * limit, 0.15 + 0.85 * uniform(count, 1, seed=1))


# Mitsuba


@pytest.mark.parametrize("name", MODELS)
def test_value_and_density_equal_mitsuba(mi, name):
    model, n = MODELS[name], 600
    few, bsdf, metallic = of(name, surfaces(model, 5)), bsdf_of(model), METALS.get(name, 0.0)
    surf = few[torch.arange(n) % 5]
    theirs = [
        mi.load_dict(model.mitsuba(rgb(few.albedo[i].tolist()), float(few.roughness[i]), metallic)) for i in range(5)
    ]
    wo, wi = directions(n, 1), directions(n, 2, upper=False)
    near = bsdf.sample(surf, wo, uniform(n, 3, seed=3)).wi
    wi = torch.where((torch.arange(n) % 2 == 0).unsqueeze(-1), near, wi)
    value, pdf = bsdf.eval_pdf(surf, wo, wi)
    torch.testing.assert_close(bsdf.eval(surf, wo, wi), value)
    torch.testing.assert_close(bsdf.pdf(surf, wo, wi), pdf)
    si, context, rows = mi.SurfaceInteraction3f(), mi.BSDFContext(), []
    for i in range(n):
        si.wi = mi.Vector3f(wo[i].tolist())  # Mitsuba's wi is our wo
        their_value, their_pdf = theirs[i % 5].eval_pdf(context, si, mi.Vector3f(wi[i].tolist()))
        rows.append([*their_value, their_pdf])
    expected = torch.tensor(np.array(rows, np.float32))
    assert (expected[:, 3] > 0).float().mean() > 0.5
    scale = expected.abs().clamp_min(1e-3)
    assert ((torch.cat((value, pdf.unsqueeze(-1)), -1) - expected).abs() / scale).max() < 1e-3


@pytest.mark.parametrize("use_kernels", [True, False])
def test_the_derivative_by_the_metalness_equals_mitsubas(mi, use_kernels):
    """Mitsuba's model is linear in the metalness, so that its derivative is what metal has more than a dielectric."""
    model, n = PrincipledModel(), 400
    few, wo = surfaces(model, 5), directions(n, 1)
    surf = few[torch.arange(n) % 5]
    metal = uniform(n, 1, seed=7).requires_grad_()
    bsdf = Principled(model.eta, use_kernels=use_kernels)
    near = bsdf.sample(surf, wo, uniform(n, 3, seed=3)).wi
    wi = torch.where((torch.arange(n) % 2 == 0).unsqueeze(-1), near, directions(n, 2))
    value = bsdf.eval(replace(surf, metallic=metal), wo, wi)
    found = torch.cat([torch.autograd.grad(value[:, c].sum(), metal, retain_graph=c < 2)[0] for c in range(3)], -1)
    by_metal = [
        [mi.load_dict(model.mitsuba(rgb(few.albedo[i].tolist()), float(few.roughness[i]), m)) for m in (0.0, 1.0)]
        for i in range(5)
    ]
    si, context, rows = mi.SurfaceInteraction3f(), mi.BSDFContext(), []
    for i in range(n):
        si.wi = mi.Vector3f(wo[i].tolist())
        none, all_ = (np.array(x.eval(context, si, mi.Vector3f(wi[i].tolist()))) for x in by_metal[i % 5])
        rows.append([none, all_])
    none, all_ = torch.tensor(np.array(rows, np.float32)).unbind(1)
    scale = torch.maximum(none, all_).clamp_min(1e-3)  # of what the difference is taken
    assert ((found - (all_ - none)).abs() / scale).max() < 1e-3
    assert ((all_ - none).abs() > 0.1 * scale).float().mean() > 0.5


def rgb(value):
    return {"type": "rgb", "value": value}


# Sampling


def draw(name, bsdf, roughness, cos, seed):
    """What draws directions of one viewer, and their density."""

    def alike(count, dtype):
        values = torch.full((count, 3), 0.4, dtype=dtype), torch.full((count, 1), roughness, dtype=dtype)
        return of(name, Surface(*values)), toward(cos, count=count, dtype=dtype)

    def sample_fn(count):
        sample = bsdf.sample(*alike(count, torch.float32), uniform(count, 3, seed=seed))
        assert torch.equal(sample.pdf > 0, sample.weight.amax(-1) > 0)
        return sample.wi.numpy(), (sample.pdf > 0).numpy()

    def pdf_fn(w):
        return bsdf.pdf(*alike(len(w), torch.float64), torch.as_tensor(w)).numpy()

    return sample_fn, pdf_fn


CASES = [(r, c) for r in (0.1, 0.3, 0.6, 1.0) for c in (1.0, 0.8, 0.3, GRAZING)]
DRAWN = [("diffuse", Diffuse(), [(0.5, 1.0), (0.5, GRAZING)], 60_000)]
DRAWN += [("principled", Principled(use_kernels=use, specular_fraction=fraction), CASES, 60_000)
          for use in (True, False) for fraction in (0.5, 0.2)]  # fmt: skip
DRAWN += [(name, bsdf_of(model, fraction), [(0.5, c) for c in (1.0, 0.7, 0.2)], 40_000)
          for name, model in MODELS.items() for fraction in (0.5, 0.25)]  # fmt: skip


@pytest.mark.parametrize(("name", "bsdf", "cases", "count"), DRAWN)
def test_chi_square(name, bsdf, cases, count):
    p = [chi2_test(*draw(name, bsdf, r, c, seed), count=count) for seed, (r, c) in enumerate(cases)]
    assert accept(p), dict(zip(cases, p, strict=True))


def test_chi_square_notices_a_wrong_density():
    sample_fn, _ = draw("principled", Principled(), 0.5, 0.8, 0)
    _, other = draw("principled", Principled(), 0.52, 0.8, 0)
    assert not accept(chi2_test(sample_fn, other, count=60_000))


@pytest.mark.parametrize("name", ALL)
def test_weight_is_value_over_pdf(name):
    n, bsdf = 4096, ALL[name]
    surf = of(name, Surface(surfaces(MODELS.get(name), n).albedo, uniform(n, 1, seed=1)))
    wo, u = directions(n, 1), uniform(n, 3, seed=2)
    sample = bsdf.sample(surf, wo, u)
    value, pdf = bsdf.eval(surf, wo, sample.wi), bsdf.pdf(surf, wo, sample.wi)
    valid = pdf > 0
    torch.testing.assert_close(sample.pdf, pdf)
    torch.testing.assert_close(sample.weight[valid] * pdf[valid].unsqueeze(-1), value[valid], rtol=1e-5, atol=1e-7)
    assert (sample.weight[~valid] == 0).all()
    assert (value[~valid] == 0).all()
    torch.testing.assert_close(sample.wi.norm(dim=-1), torch.ones(n), rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", MODELS)
def test_the_mean_of_weights_is_the_directional_albedo_that_the_model_gives(name):
    model, n, p = MODELS[name], 40_000, []
    bsdf, limit = bsdf_of(model, 0.25), torch.tensor(getattr(model, "normal_reflectance", (1.0, 1.0, 1.0)))
    for seed, cos in enumerate((0.9, 0.5, 0.15)):
        surf = of(name, Surface((torch.tensor([0.2, 0.5, 0.8]) * limit).expand(n, 3), torch.full((n, 1), 0.45)))
        wo = toward(cos, count=n)
        sample = bsdf.sample(surf, wo, uniform(n, 3, seed=seed))
        mean = bsdf.mean_weight(surf, wo)[0].double().numpy()
        assert (mean <= 1.05).all()  # Burley's diffuse lobe, under a specular one, reflects a little more than it gets
        for channel, expected in enumerate(mean):
            found = sample.weight[:, channel].double().numpy()
            off = max(0.0, abs(found.mean() - expected) - 0.01 * expected)  # the table's error
            p.append(z_test_samples(found, found.mean() + off))
    assert accept(p)


@pytest.mark.parametrize("name", [n for n, m in MODELS.items() if not isinstance(m, PrincipledModel)])
def test_no_more_light_leaves_than_arrives(name):
    """For the whitest surface that there is; Burley's dielectric is measured in test_bsdf.py."""
    model, cosines = MODELS[name], torch.linspace(0.01, 1.0, 50)
    wo = torch.stack(((1 - cosines**2).sqrt(), 0 * cosines, cosines), -1)
    limit = torch.tensor(getattr(model, "normal_reflectance", (1.0, 1.0, 1.0)), dtype=torch.float32)
    surf = Surface(limit.expand(50, 3), torch.full((50, 1), 0.3))
    assert (bsdf_of(model).mean_weight(surf, wo) <= 1.0).all()


def test_no_sample_of_a_metal_brings_more_than_arrives():
    """Metal is drawn by its visible normals, so that a weight is Fresnel times masking."""
    n = 1 << 14
    surf, bsdf = of("metal", Surface(torch.ones(n, 3), uniform(n, 1, seed=1))), bsdf_of(MODELS["metal"], 0.25)
    weight = bsdf.sample(surf, directions(n, 2), uniform(n, 3, seed=3)).weight
    assert float(weight.max()) <= 1.0 + 1e-4
    assert float(weight.mean()) > 0.7


@pytest.mark.parametrize("name", ["metal", "white metal"])
def test_a_white_metal_loses_little(name):
    """All light comes back from a narrow lobe; a wide one loses what would hit a second facet."""
    lost = []
    for alpha in (0.01, 0.3, 0.9):
        model = MODELS[name] if name == "metal" else RoughConductorModel(*WHITE, alpha)
        surf = of(name, Surface(torch.ones(1, 3), torch.full((1, 1), math.sqrt(alpha))))
        lost.append(1.0 - float(bsdf_of(model).mean_weight(surf, toward(0.8))[0, 0]))
    assert -1e-6 <= lost[0] < 2e-3 < lost[1] < lost[2] < 0.7


# Gradients and extremes


@pytest.mark.parametrize("name", ALL)
def test_gradients_hold_direction_and_density(name):
    bsdf, n, wo = ALL[name], 256, directions(256, 1)
    surf = surfaces(MODELS.get(name), n)
    leaf = of(name, Surface(surf.albedo.requires_grad_(), surf.roughness.requires_grad_()))
    leaves = [leaf.albedo, *([leaf.roughness] if isinstance(bsdf, Principled) else [])]
    sample = bsdf.sample(leaf, wo, uniform(n, 3, seed=2))
    assert not sample.wi.requires_grad
    assert not sample.pdf.requires_grad
    ratio = bsdf.eval(leaf, wo, sample.wi) / sample.pdf.clamp_min(1e-30).unsqueeze(-1)
    expected = torch.autograd.grad(ratio.sum(), leaves)
    torch.testing.assert_close(torch.autograd.grad(sample.weight.sum(), leaves), expected, rtol=1e-4, atol=1e-5)
    assert all(float(gradient.abs().max()) > 0.0 for gradient in expected)


@pytest.mark.parametrize("name", ALL)
def test_finite_at_extremes(name):
    cosines = torch.tensor([1.0, 1 - 1e-7, 0.5, 1e-3, 1e-6, 1e-9, 0.0, -1e-9, -0.5, -1.0])
    corner = torch.tensor([0.0, 1e-8, 0.5, 1.0 - 2**-24])
    azimuths, widths = torch.tensor([0.0, math.pi / 2, math.pi]), torch.tensor([0.0, 0.3, 0.5, 1.0])
    co, ci, phi, rough = torch.cartesian_prod(cosines, cosines, azimuths, widths).unbind(-1)
    so, si = (1 - co * co).clamp_min(0).sqrt(), (1 - ci * ci).clamp_min(0).sqrt()
    wo, wi = torch.stack((so, 0 * so, co), -1), torch.stack((si * phi.cos(), si * phi.sin(), ci), -1)
    u = torch.cartesian_prod(corner, corner, corner)[torch.arange(len(co)) % 64]
    surf = of(name, Surface(torch.ones(len(co), 3).requires_grad_(), rough.unsqueeze(-1).clone().requires_grad_()))
    value, pdf = ALL[name].eval_pdf(surf, wo, wi)
    sample = ALL[name].sample(surf, wo, u)
    (1e4 * (value.sum() + sample.weight.sum())).backward()
    grads = [g for g in (surf.albedo.grad, surf.roughness.grad) if g is not None]
    for x in (value, pdf, sample.wi, sample.pdf, sample.weight, ALL[name].mean_weight(surf, wo), *grads):
        assert torch.isfinite(x).all()
    for x in (value, pdf, sample.pdf, sample.weight, ALL[name].mean_weight(surf, wo)):
        assert (x >= 0).all()
    dark = (co <= 0) | (ci <= 0)
    assert (value[dark] == 0).all()
    assert (pdf[dark] == 0).all()
    assert (sample.pdf[co <= 0] == 0).all()


# The table


def table_of(*models, specular_fraction=0.5):
    return make_bsdf(Features(False, True, False, False, False, models), specular_fraction)


def test_a_table_is_each_model_on_its_own_lanes():
    models, n = (DiffuseModel(), PrincipledModel(), *MODELS.values()), 4000
    table, plain = table_of(*models, specular_fraction=0.25), surfaces(None, n)
    wo, wi, u = directions(n, 1), directions(n, 2, upper=False), uniform(n, 3, seed=3)
    which = torch.randint(0, len(models), (n,), generator=torch.Generator().manual_seed(4))
    surf = Surface(plain.albedo, plain.roughness, which)
    value, pdf = table.eval_pdf(surf, wo, wi)
    sample = table.sample(surf, wo, u)
    assert table.varying_weight
    assert table.kernels(surf) is None
    for index, model in enumerate(models):
        bsdf, lanes = bsdf_of(model, 0.25), which == index
        alone = (plain[lanes], wo[lanes])
        torch.testing.assert_close((value[lanes], pdf[lanes]), bsdf.eval_pdf(*alone, wi[lanes]))
        torch.testing.assert_close(table.eval(surf, wo, wi)[lanes], value[lanes])
        torch.testing.assert_close(table.pdf(surf, wo, wi)[lanes], pdf[lanes])
        torch.testing.assert_close(vars(sample[lanes]), vars(bsdf.sample(*alone, u[lanes])))
        torch.testing.assert_close(table.mean_weight(surf, wo)[lanes], bsdf.mean_weight(*alone))
        fraction = torch.as_tensor(bsdf.diffuse_fraction(*alone), dtype=torch.float32).expand(int(lanes.sum()))
        torch.testing.assert_close(table.diffuse_fraction(surf, wo)[lanes], fraction)


def test_a_table_takes_fitted_surfaces_to_be_principled():
    table, n = table_of(*MODELS.values()), 500
    surf, wo, wi = surfaces(None, n), directions(n, 1), directions(n, 2)
    principled = bsdf_of(PrincipledModel())
    torch.testing.assert_close(table.eval_pdf(surf, wo, wi), principled.eval_pdf(surf, wo, wi))
    assert table.kernels(surf) == principled.kernels(surf)
    assert table.diffuse_fraction(surf, wo) == 0.5
    one = Surface(surf.albedo, surf.roughness, torch.full((n,), list(MODELS).index("copper")))
    torch.testing.assert_close(table.eval(one, wo, wi), bsdf_of(MODELS["copper"]).eval(surf, wo, wi))
    none = Surface(surf.albedo, surf.roughness, torch.full((n,), -1))
    assert table.eval(none, wo, wi).abs().max() == 0


def test_gradients_pass_the_table():
    table, n = table_of(DiffuseModel(), PrincipledModel(), MODELS["copper"]), 300
    plain, wo, wi = surfaces(None, n), directions(n, 1), directions(n, 2)
    leaf = Surface(plain.albedo.requires_grad_(), plain.roughness.requires_grad_(), torch.arange(n) % 3)
    table.eval(leaf, wo, wi).sum().backward()
    assert (leaf.albedo.grad > 0).all()
    assert (leaf.roughness.grad.squeeze(-1)[leaf.model != 1] == 0).all()
    assert (leaf.roughness.grad.squeeze(-1)[leaf.model == 1] != 0).float().mean() > 0.9


def test_a_model_that_nothing_evaluates_is_not_black_without_a_word():
    class Dusty(ReflectionModel):
        plugin = "dusty"

    known = (PrincipledModel(), DiffuseModel(), UnsupportedModel("hair", "hair is not supported"))
    make_bsdf(Features(False, True, False, False, False, known))  # a scene is refused for the last
    with pytest.raises(NotImplementedError, match="Dusty has no line"):
        make_bsdf(Features(False, True, False, False, False, (*known, Dusty())))
