"""Reflection models against Mitsuba, against statistics and against closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.directions import directions, toward, uniform
from helpers.oracles import accept, z_test_samples

from neurad.bsdf.delta import Smooth, scatter
from neurad.bsdf.diffuse import Diffuse
from neurad.bsdf.directional import directional_albedo
from neurad.bsdf.microfacet import fresnel_dielectric, reflectance
from neurad.bsdf.principled import Principled, lobes_pdf
from neurad.core.records import Surface

GRAZING = 0.02


def surface(count, albedo=0.5, roughness=0.5, dtype=torch.float32):
    return Surface(torch.full((count, 3), albedo, dtype=dtype), torch.full((count, 1), roughness, dtype=dtype))


def random_surface(count, seed=0, dtype=torch.float32):
    return Surface(uniform(count, 3, seed=seed, dtype=dtype), uniform(count, 1, seed=seed + 1, dtype=dtype))


def mitsuba_reference(mi, kind, surf, wo, wi, u=None):
    """Value, pdf and (from ``u``) the sampled direction, its pdf and its weight. Mitsuba's wi is our wo."""
    si, context = mi.SurfaceInteraction3f(), mi.BSDFContext()
    rows = []
    for i in range(len(surf)):
        colour = {"type": "rgb", "value": surf.albedo[i].tolist()}
        spec = {"type": "diffuse", "reflectance": colour}
        if kind == "principled":
            spec = {"type": "principled", "base_color": colour, "roughness": float(surf.roughness[i])}
        bsdf = mi.load_dict(spec)
        si.wi = mi.Vector3f(wo[i].tolist())
        value, pdf = bsdf.eval_pdf(context, si, mi.Vector3f(wi[i].tolist()))
        row = [*value, pdf]
        if u is not None:
            sample, weight = bsdf.sample(context, si, float(u[i, 0]), mi.Point2f(u[i, 1:].tolist()))
            row += [*sample.wo, sample.pdf, *weight]
        rows.append(row)
    table = torch.tensor(np.array(rows, np.float64))
    return table[:, :3], table[:, 3], table[:, 4:7], table[:, 7:8], table[:, 8:]


# Mitsuba


@pytest.mark.parametrize("bsdf", [Principled(), Principled(use_kernels=False), Diffuse()])
def test_values_and_densities_equal_mitsubas(mi, bsdf):
    n = 3000
    surf, wo, wi = random_surface(n), directions(n, 1), directions(n, 2, upper=False)
    near = torch.arange(n) % 3 == 0  # a third of the directions inside the lobe, where it is steep
    drawn = (
        Principled(use_kernels=False)
        .sample(surf, wo, uniform(n, 3, seed=3) * torch.tensor([0.0, 1.0, 1.0]) + 0.5e-3)
        .wi
    )
    mirror = wo * torch.tensor([-1.0, -1.0, 1.0])  # where the specular lobe is about largest
    drawn = torch.where((torch.arange(n) % 2 == 0).unsqueeze(-1), drawn, mirror)
    wi = torch.where(near.unsqueeze(-1), drawn, wi)
    value, pdf = bsdf.eval_pdf(surf, wo, wi)
    kind = "diffuse" if bsdf.is_diffuse else "principled"
    expected, expected_pdf, *_ = mitsuba_reference(mi, kind, surf, wo, wi)
    below = wi[:, 2] <= 0
    assert (value[below] == 0).all()
    assert (pdf[below] == 0).all()
    assert (expected[below] == 0).all()
    assert (expected_pdf[below] == 0).all()
    top, top_pdf = Principled(use_kernels=False).eval_pdf(surf, wo, mirror)
    smooth = (surf.roughness.squeeze(-1) < 0.1) & (not bsdf.is_diffuse)
    scale = torch.where(smooth, torch.maximum(top.amax(-1), expected.amax(-1)), expected.amax(-1)).clamp_min(1e-6)
    scale_pdf = torch.where(smooth, torch.maximum(top_pdf, expected_pdf), expected_pdf).clamp_min(1e-6)
    assert ((value - expected).abs().amax(-1) / scale).max() < 1e-4
    assert ((pdf - expected_pdf).abs() / scale_pdf).max() < 1e-4


@pytest.mark.parametrize("use_kernels", [True, False])
def test_same_numbers_draw_mitsubas_directions(mi, use_kernels):
    n = 2000
    surf, wo, u = random_surface(n, 5), directions(n, 6), uniform(n, 3, seed=7)
    sample = Principled(use_kernels=use_kernels).sample(surf, wo, u)
    _, _, wi, pdf, weight = mitsuba_reference(mi, "principled", surf, wo, wo, u)
    valid = pdf.squeeze(-1) > 0
    assert ((sample.pdf > 0) == valid).float().mean() > 0.998  # a lane at the horizon may round to the other side
    both = valid & (sample.pdf > 0)
    assert 0.8 < both.float().mean() < 1.0
    # For narrow lobes Mitsuba rounds the stretched direction to the normal, which only turns the sample about it; and
    # weights follow rounding errors of the direction.
    narrow = surf.roughness.squeeze(-1) < 0.1
    assert (sample.wi - wi)[both & ~narrow].abs().max() < 1e-4
    assert (sample.wi - wi)[both & narrow].abs().max() < 0.05
    torch.testing.assert_close(sample.weight[both & ~narrow].double(), weight[both & ~narrow], rtol=1e-2, atol=1e-4)
    assert (sample.weight[both] - weight[both]).abs().median() < 1e-5


# Physics


def test_reciprocity():
    n = 4096
    wo, wi = directions(n, 1, dtype=torch.float64), directions(n, 2, dtype=torch.float64)
    rough = uniform(n, 1, seed=3, dtype=torch.float64)
    surf = Surface(uniform(n, 3, dtype=torch.float64), rough)
    there, back = (b / w[:, 2:] for b, w in ((Diffuse().eval(surf, wo, wi), wi), (Diffuse().eval(surf, wi, wo), wo)))
    torch.testing.assert_close(there, back)
    there, back = lobes_pdf(rough, wo, wi, 1.5)[1] / wi[:, 2], lobes_pdf(rough, wi, wo, 1.5)[1] / wo[:, 2]
    torch.testing.assert_close(there, back)


def mean_over(bsdf, albedo, roughness, cos, pick, count=100_000):
    """Directional albedo of one lobe and its standard error."""
    wo, surf = toward(cos, count=count), surface(count, albedo, roughness)
    sample = bsdf.sample(surf, wo, uniform(count, 3, seed=11))
    lobe = bsdf.lobes_pdf(surf, wo, sample.wi)[pick] / sample.pdf.clamp_min(1e-30)
    return float(lobe.mean()), float(lobe.std() / math.sqrt(count))


@pytest.mark.parametrize("cos", [1.0, 0.5, GRAZING])
def test_energy(cos):
    sample = Diffuse().sample(surface(1000, 1.0), toward(cos, count=1000), uniform(1000, 3))
    assert (sample.weight <= 1).all()
    for roughness in (0.05, 0.3, 0.6, 1.0):
        specular, error = mean_over(Principled(), 1.0, roughness, cos, 1)
        assert 0 < specular <= 1 + 4 * error
    diffuse, error = mean_over(Principled(), 1.0, 1.0, cos, 0)
    if cos == GRAZING:  # Burley's lobe reflects more than it receives here; pinned so that nobody is surprised
        assert 1.3 < diffuse < 1.6
    else:
        assert diffuse <= 1.1


# Gradients


def test_gradients_equal_central_differences():
    n, step = 512, 1e-6
    wo, wi = directions(n, 1, dtype=torch.float64), directions(n, 2, dtype=torch.float64)
    surf = random_surface(n, 3, dtype=torch.float64)
    rough = (0.05 + 0.95 * surf.roughness).requires_grad_()
    albedo = surf.albedo.requires_grad_()
    metal = uniform(n, 1, seed=5, dtype=torch.float64).requires_grad_()
    cotangent = uniform(n, 3, seed=9, dtype=torch.float64)

    def value(a, r, m):
        return (Principled().eval(Surface(a, r, metallic=m), wo, wi) * cotangent).sum(-1)

    given = albedo, rough, metal
    grads = torch.autograd.grad(value(*given).sum(), given)
    with torch.no_grad():
        shifts = torch.eye(5, dtype=torch.float64).split((3, 1, 1), -1)
        for index, grad in enumerate(torch.cat(grads, -1).T):
            high, low = (value(*(x + k * step * e[index] for x, e in zip(given, shifts, strict=True))) for k in (1, -1))
            torch.testing.assert_close(grad, (high - low) / (2 * step), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("metal", "lambert"), [(False, False), (True, False), (False, True), (True, True)])
def test_kernel_equals_its_torch_twin(metal, lambert):
    n = 8192
    wo, wi = directions(n, 1), directions(n, 2, upper=False)
    wo[:64, 2] = -wo[:64, 2]
    rough = uniform(n, 1, seed=3)
    rough[::16] = uniform(n // 16, 1, seed=4) * 0.1
    near = Principled(use_kernels=False).sample(surface(n, 0.5), wo, uniform(n, 3, seed=5)).wi
    wi = torch.where((torch.arange(n) % 2 == 0).unsqueeze(-1), near, wi)
    cotangent = uniform(2, n, seed=6) + 0.5
    part = uniform(n, 1, seed=9)
    part[:8] = torch.tensor([0.0, 1.0]).repeat(4).unsqueeze(-1)
    results = []
    for use_kernels in (True, False):
        given = {"roughness": rough, "metallic": part if metal else None}
        given["lambert"] = torch.full((n, 1), 0.3) if lambert else None
        leaves = {name: x.clone().requires_grad_() for name, x in given.items() if x is not None}
        surf = Surface(wo, **leaves)
        d, s, pdf = Principled(use_kernels=use_kernels).lobes_pdf(surf, wo, wi)
        assert not pdf.requires_grad
        gradients = torch.autograd.grad((d * cotangent[0] + s * cotangent[1]).sum(), list(leaves.values()))
        results.append((d.detach(), s.detach(), pdf, *(x.squeeze(-1) for x in gradients)))
    names = ("d", "s", "pdf", *(f"by {name}" for name in leaves))
    for name, use_kernels, slow in zip(names, *results, strict=False):
        torch.testing.assert_close(use_kernels, slow, rtol=1e-4, atol=2e-5, msg=lambda m, name=name: f"{name}: {m}")
    for use_kernels, slow in zip(*(found[3:] for found in results), strict=True):
        fast, slow = use_kernels.double(), slow.double()
        assert torch.dot(fast, slow) / (fast.norm() * slow.norm()) > 1 - 1e-8
    u = uniform(n, 3, seed=7)
    up = directions(n, 8)
    pair = [Principled(use_kernels=f)._direction(Surface(wo, rough), up, u) for f in (True, False)]
    torch.testing.assert_close(*pair, rtol=0, atol=1e-4)


@pytest.mark.parametrize("use_kernels", [True, False])
def test_lamberts_lobe_under_a_coat_sends_back_what_the_coat_leaves(use_kernels):
    """White furnace: with albedo 1 all light comes back, whatever roughness and viewer; with albedo 0 the coat's."""
    bsdf = Principled(use_kernels=use_kernels, lambert=1.0)
    n, u = 1 << 15, uniform(1 << 15, 3, seed=3)
    for roughness, cos in ((0.1, 0.9), (0.3, 0.3), (0.7, 0.6), (1.0, 0.2)):
        white, black = (Surface(torch.full((n, 3), a), torch.full((n, 1), roughness)) for a in (1.0, 0.0))
        wo = toward(cos, count=n)
        weight = bsdf.sample(white, wo, u).weight[:, 0]
        assert abs(float(weight.mean()) - 1.0) < 4 * float(weight.std()) / n**0.5 + 5e-3  # the tables' error
        torch.testing.assert_close(bsdf.mean_weight(white, wo)[:1], torch.ones(1, 3))
        cosine, alpha = torch.tensor([cos], dtype=torch.float64), roughness**2
        coat = reflectance(cosine, alpha, lambda c: fresnel_dielectric(c, 1.5)[:, None], correlated=True)
        assert abs(float(bsdf.mean_weight(black, wo)[0, 0] - coat)) < 0.02 * float(coat)


def test_the_coat_is_that_of_cycles():
    """Blender 4.5 in a white furnace (GGX, base colour 0, 1024 samples): the light that its coat sends back."""
    measured = {0.3: (0.0397, 0.0417, 0.0868, 0.2037, 0.3114), 0.58: (0.0344, 0.0363, 0.0571, 0.0935, 0.1293),
                0.9: (0.0173, 0.0191, 0.0292, 0.0455, 0.0641)}  # fmt: skip
    cosine = torch.tensor([0.0, 30.0, 60.0, 75.0, 83.0]).deg2rad().cos()
    for roughness, expected in measured.items():
        surf = Surface(torch.zeros(5, 3), torch.full((5, 1), roughness))
        found = directional_albedo(surf, cosine, 1.5, 1.0)[:, 0]
        torch.testing.assert_close(found, torch.tensor(expected), rtol=0.02, atol=0)
        separate = directional_albedo(surf, cosine, 1.5)[:, 0]
        assert float(separate[4]) < float(found[4])


def test_half_of_a_lobe_is_the_mean_of_both():
    n = 4096
    surf, wo, u = random_surface(n), directions(n, 1), uniform(n, 3, seed=2)
    surf = replace(surf, metallic=uniform(n, 1, seed=4))
    wi = Principled().sample(surf, wo, u).wi
    burley, half, lambert = (Principled(lambert=part).lobes_pdf(surf, wo, wi)[:2] for part in (0.0, 0.5, 1.0))
    torch.testing.assert_close(half[0], 0.5 * (burley[0] + lambert[0]))
    assert float((burley[0] - lambert[0]).abs().max()) > 0.05
    torch.testing.assert_close(half[1], 0.5 * (burley[1] + lambert[1]))
    searched = Principled().lobes_pdf(replace(surf, lambert=torch.full((n, 1), 0.5)), wo, wi)[:2]
    torch.testing.assert_close(searched, half)


def test_no_metal_is_to_the_bit_what_it_is_without_a_metalness():
    n = 4096
    surf, wo, u = random_surface(n), directions(n, 1), uniform(n, 3, seed=2)
    none = replace(surf, metallic=torch.zeros(n, 1))
    for use_kernels in (True, False):
        bsdf = Principled(use_kernels=use_kernels, specular_fraction=0.25)
        plain, same = bsdf.sample(surf, wo, u), bsdf.sample(none, wo, u)
        for name in ("wi", "pdf", "weight"):
            assert torch.equal(getattr(plain, name), getattr(same, name)), name
        assert torch.equal(bsdf.mean_weight(surf, wo), bsdf.mean_weight(none, wo))


def test_extremes_survive_every_pair_of_numbers():
    corner = torch.tensor([0.0, 1e-8, 0.25, 0.5, 1.0 - 2**-24])
    u, cos = torch.cartesian_prod(corner, corner, corner), (1.0, 0.5, 1e-3, 1e-7)
    for use_kernels in (True, False):
        for roughness in (0.0, 0.5, 1.0):
            for c in cos:
                surf = surface(len(u), 1.0, roughness)
                sample = Principled(use_kernels=use_kernels).sample(surf, toward(c, count=len(u)), u)
                assert torch.isfinite(sample.wi).all()
                assert torch.isfinite(sample.weight).all()
                assert (sample.weight <= 8).all()


# Smooth surfaces


def smooth(n, eta=1.5, tint=None, dielectric=True, thin=False):
    lanes = torch.full((n,), dielectric), torch.full((n,), thin), torch.full((n,), eta)
    return Smooth(*lanes, torch.ones(n, 3) if tint is None else tint)


def test_conductor_is_a_tinted_mirror():
    wo = directions(64, 1, upper=False)
    tint = uniform(64, 3, seed=2)
    wi, weight = scatter(smooth(64, tint=tint, dielectric=False), wo, uniform(64))
    torch.testing.assert_close(wi, wo * torch.tensor([-1.0, -1.0, 1.0]))
    torch.testing.assert_close(weight, tint)


@pytest.mark.parametrize("kind", ["dielectric", "thindielectric"])
def test_dielectric_equals_mitsuba(mi, kind):
    n = 1000
    wo, u = directions(n, 1, upper=False), uniform(n, seed=2)
    si, context = mi.SurfaceInteraction3f(), mi.BSDFContext()
    for eta in (1.5, 1.33):
        bsdf = mi.load_dict({"type": kind, "int_ior": eta, "ext_ior": 1.0})
        rows = []
        for i in range(n):
            si.wi = mi.Vector3f(wo[i].tolist())
            sample, weight = bsdf.sample(context, si, float(u[i]), mi.Point2f(0.5, 0.5))
            rows.append([*sample.wo, *weight])
        expected = torch.tensor(np.array(rows, np.float32))
        wi, weight = scatter(smooth(n, eta, thin=kind == "thindielectric"), wo, u)
        torch.testing.assert_close(wi, expected[:, :3], rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(weight, expected[:, 3:], rtol=1e-4, atol=1e-4)


def test_dielectric_conserves_power_in_the_mean():
    n = 50_000
    p = []
    for i, cos in enumerate((0.9, 0.3, -0.9, -0.3)):  # the last is beyond the critical angle
        wo = toward(cos, count=n)
        wi, weight = scatter(smooth(n), wo, uniform(n, seed=i))
        through = wi[:, 2] * cos < 0
        unscaled = weight[:, 0] * torch.where(through, 2.25 if cos > 0 else 1 / 2.25, 1.0)
        torch.testing.assert_close(unscaled, torch.ones(n))
        torch.testing.assert_close(wi.norm(dim=-1), torch.ones(n))
        c_t2 = 1 - (1 - cos * cos) * (1 / 2.25 if cos > 0 else 2.25)
        eta_i = 1.5 if cos > 0 else 1 / 1.5
        if c_t2 <= 0:
            assert not through.any()
            continue
        a, b = abs(cos), math.sqrt(c_t2)
        reflected = 0.5 * (((a - eta_i * b) / (a + eta_i * b)) ** 2 + ((eta_i * a - b) / (eta_i * a + b)) ** 2)
        p.append(z_test_samples((~through).double().numpy(), np.float64(reflected)))
    assert accept(p)


@pytest.mark.parametrize("use_kernels", [True, False])
def test_every_lane_can_have_its_own_fraction_of_the_specular_lobe(use_kernels):
    """Directions, values and densities are those of a BSDF with that fraction for all."""
    count, choices = 3000, (0.1, 0.25, 0.7)
    wo, surf, u = directions(count, 3, upper=True), random_surface(count, 5), uniform(count, 3, seed=8)
    kind = torch.arange(count) % len(choices)
    own = replace(surf, specular_fraction=torch.tensor(choices)[kind].unsqueeze(-1))
    made = Principled(use_kernels=use_kernels)
    sample = made.sample(own, wo, u)
    value, pdf = made.eval_pdf(own, wo, sample.wi)
    for k, fraction in enumerate(choices):
        there = (kind == k).nonzero().squeeze(-1)
        plain = Principled(use_kernels=use_kernels, specular_fraction=fraction)
        expected = plain.sample(surf[there], wo[there], u[there])
        torch.testing.assert_close(sample.wi[there], expected.wi)
        torch.testing.assert_close(sample.pdf[there], expected.pdf)
        torch.testing.assert_close(value[there], plain.eval(surf[there], wo[there], expected.wi))
        torch.testing.assert_close(pdf[there], expected.pdf)
        assert float(made.diffuse_fraction(own, wo)[there].float().mean()) == pytest.approx(1.0 - fraction, abs=1e-6)


def test_kernels_refuse_fractions_of_other_lanes():
    own = replace(surface(4), specular_fraction=torch.full((3, 1), 0.5))
    with pytest.raises(ValueError, match="specular_fraction 3, others 4"):
        Principled().sample(own, directions(4, 1), uniform(4, 3))
