"""The control variate by directional albedo: its table, its zero mean, and the unbiased gradient that it leaves."""

from dataclasses import replace

import pytest
import torch
from helpers.method_oracles import Oracle, Textures, camera_vertices, gallery
from helpers.oracles import accept
from scipy import stats

from neurad.assembly.build import build_world
from neurad.bsdf.directional import directional_albedo
from neurad.bsdf.principled import Principled, lobes_pdf
from neurad.core.records import Surface
from neurad.core.reflection import PrincipledModel
from neurad.core.rng import Stream
from neurad.integrators.bounce import bounce
from neurad.integrators.debiased import Debiased
from neurad.integrators.direct import Direct
from neurad.integrators.method import SceneModel
from neurad.integrators.path import PathTracing
from neurad.integrators.prb import PRB
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.stratified import stratified_samples
from neurad.integrators.vertex import DIMENSIONS
from neurad.losses.leave_one_out import ControlVariate, leave_one_out
from neurad.scene.builtin import build_furnace
from neurad.scene.textures import ConstantMaterials


def quadrature(roughness: float, cosine: float) -> torch.Tensor:
    """Diffuse and specular part by a midpoint rule in float64, finer around the mirror direction."""
    n = 1500
    t = (torch.arange(n, dtype=torch.float64) + 0.5) / n
    a, b = torch.meshgrid(t, t, indexing="ij")
    # Angle from the mirror direction, dense where it is small; azimuth around that direction.
    angle, derivative = torch.pi * a**3, 3 * torch.pi * a**2
    turn = 2 * torch.pi * b
    sine = (1 - cosine**2) ** 0.5
    mirror = torch.tensor([-sine, 0.0, cosine], dtype=torch.float64)
    side = torch.tensor([cosine, 0.0, sine], dtype=torch.float64)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    around = turn.cos().flatten()[:, None] * side + turn.sin().flatten()[:, None] * up
    wi = angle.flatten().cos()[:, None] * mirror + angle.flatten().sin()[:, None] * around
    wo = torch.tensor([[sine, 0.0, cosine]], dtype=torch.float64).expand_as(wi)
    d, s, _ = lobes_pdf(torch.full((len(wi), 1), roughness, dtype=torch.float64), wo, wi, 1.5)
    area = (angle.sin() * derivative * 2 * torch.pi / n**2).flatten()
    return torch.stack(((d * area).sum(), (s * area).sum()))


@pytest.mark.parametrize(("roughness", "cosine"), [(0.2, 0.9), (0.3, 0.3), (0.55, 0.6), (0.8, 0.15), (0.95, 0.97)])
def test_directional_albedo_is_the_integral_of_the_lobes(roughness: float, cosine: float) -> None:
    r = torch.tensor([[roughness]], requires_grad=True)
    z = torch.tensor([cosine])
    specular = directional_albedo(Surface(torch.zeros(1, 3), r), z, 1.5)[0, 0]
    both = directional_albedo(Surface(torch.ones(1, 3), r), z, 1.5)[0, 0]
    diffuse, exact = both - specular, quadrature(roughness, cosine)
    assert float(diffuse) == pytest.approx(float(exact[0]), rel=0.005)
    assert float(specular) == pytest.approx(float(exact[1]), rel=0.01, abs=5e-4)
    derivative = (quadrature(roughness + 0.01, cosine) - quadrature(roughness - 0.01, cosine)) / 0.02
    for value, expected in ((diffuse, derivative[0]), (specular, derivative[1])):
        gradient = torch.autograd.grad(value, r, retain_graph=True)[0]
        assert float(gradient) == pytest.approx(float(expected), rel=0.04, abs=0.004)


@pytest.mark.parametrize("lambert", [0.0, 1.0])
def test_weights_of_bsdf_samples_have_this_mean(lambert: float) -> None:
    """One-sample z-tests at 99 % over all (Sidak): value and derivative, over random surfaces and directions."""
    n, cases = 200_000, 12
    stream = Stream(5)
    model = Principled(lambert=lambert)
    scores = []
    for _ in range(cases):
        rough, cosine = 0.15 + 0.85 * float(stream.uniform(1)), 0.1 + 0.9 * float(stream.uniform(1))
        wo = torch.tensor([[(1 - cosine**2) ** 0.5, 0.0, cosine]]).expand(n, 3).contiguous()
        roughness = torch.full((n, 1), rough, requires_grad=True)
        surface = Surface(torch.full((n, 3), 0.6), roughness)
        weight = model.sample(surface, wo, stream.uniform(n, 3)).weight[:, 0]
        derivative = torch.autograd.grad(weight.sum(), roughness)[0][:, 0]
        mean = directional_albedo(surface, wo[:, 2], 1.5, lambert)[:, 0]
        mean_derivative = torch.autograd.grad(mean.sum(), roughness)[0][:, 0]
        for found, expected, slack in ((weight, mean, 2e-3), (derivative, mean_derivative, 1e-2)):
            found, expected = found.detach(), float(expected.detach()[0])
            error = abs(float(found.mean()) - expected) - slack  # of the table
            scores.append(error / float(found.std() / n**0.5))
    limit = 3.4  # two-sided normal quantile for 1 - (1 - 0.01)^(1 / 24)
    assert max(scores) < limit


@pytest.mark.parametrize(("n", "groups"), [(2, 2), (3, 3), (8, 8), (8, 2), (12, 3)])
def test_gradient_keeps_its_mean_and_loses_noise(n: int, groups: int) -> None:
    """Samples ``r x L`` with x uniform and L = 1 + x y / 2, those of a group spread evenly: the gradient of the squared
    mean is known. 99 % confidence. A control variate takes noise away, and so does spreading."""
    pixels, target = 400_000, 0.4
    weight, goal = torch.ones(pixels, 1), torch.full((pixels, 1), target)
    r = torch.full((pixels, 1, 1), 0.7, requires_grad=True)  # one a pixel, so that gradients come a pixel each
    mean = 0.5 + 0.5 / 3 * 0.5  # of x L
    exact = 2 * (0.7 * mean - target) * mean

    def noise(sets: int, controlled: bool) -> float:
        """Deviation of the gradient, ``sets`` independent groups a pixel."""
        u = stratified_samples(pixels * sets, n // sets, Stream(11, n, sets)).view(pixels, n, -1)
        x, y = u[..., 3:4], u[..., 2:3]
        light = 1.0 + 0.5 * x * y
        control = ControlVariate(light, r * (x - 0.5), sets) if controlled else None
        loss = leave_one_out(r * x * light, goal, weight, control, sets).surrogate * pixels
        gradient = torch.autograd.grad(loss, r)[0].flatten()
        z = float((gradient.mean() - exact) / (gradient.std() / pixels**0.5))
        assert abs(z) < 2.81  # 99 % over both
        return float(gradient.std())

    usual, less = (noise(groups, controlled) for controlled in (False, True))
    assert less < (0.8 if groups > 2 or groups == n else 1.01) * usual  # of two groups, derivatives alone have less
    if groups < n:
        assert usual < 0.8 * noise(n, False)


# ---- in the methods


@pytest.mark.parametrize("method", [PathTracing(9, 1, 0.9), PRB(9, 1, 0.9), PathTracing(None, 1, 0.9)])
def test_incident_light_is_what_the_first_weight_multiplies(method) -> None:
    """On the very path, whatever roulette and glass do: nothing is divided by a weight, which may be 0."""
    world, materials, n = build_world(gallery()), Textures(), 3000
    si, u = camera_vertices(world, n, 1), Stream(5).uniform(n, DIMENSIONS)
    surface = materials(si)
    sample = method.reflected(SceneModel(world, materials), si, surface, u, Stream(7))
    first = bounce(world, si, surface, u, sample_stats=True)
    assert sample.Li_bsdf.max() > 0
    assert (first.weight == 0).any()
    torch.testing.assert_close(sample.value, first.direct + first.weight * sample.Li_bsdf, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(sample.sample_stats.deviation, first.sample_stats.deviation)


@pytest.mark.parametrize("method", [PathTracing(), PRB(), Debiased(), Radiometric()])
def test_control_is_given_where_there_are_derivatives_and_it_is_wanted(method) -> None:
    world, materials, n = build_world(gallery()), Textures(), 50
    si, u = camera_vertices(world, n, 1), Stream(5).uniform(n, DIMENSIONS)
    parts = SceneModel(world, materials, lambda si, albedo: torch.full_like(albedo, 0.3))

    def found():
        return method.reflected(parts, si, materials(si), u, Stream(7)).sample_stats

    assert found().deviation.requires_grad
    with torch.no_grad():
        assert found() is None
    method.control_variate = False
    assert found() is None
    assert Direct().reflected(parts, si, materials(si), u, Stream(7)).sample_stats is None


# Variance of the gradient by albedo and by roughness: at most this fraction of that without control.
METHODS = {
    "AD-PT": (PathTracing, {"max_depth": 4}, (0.6, 0.9)),
    "PRB": (PRB, {"max_depth": 4}, (0.6, 0.9)),
    "debiased": (Debiased, {"first_prob": 1.0}, (0.9, 0.98)),
    "ours": (Radiometric, {}, (0.4, 0.4)),
}


@pytest.mark.parametrize("name", METHODS)
def test_methods_keep_the_mean_of_their_gradient_and_lose_noise(name: str) -> None:
    """A closed glossy room that shines everywhere, seen at a slant: light is nearly even. Gradients of leave-one-out
    with and without control from the same random numbers: paired t-tests at 99 % confidence over both parameters, with
    a slack for the table of directional albedos and its derivatives (their errors are tested above)."""
    make, settings, largest = METHODS[name]
    batches, pixels, n = 100, 64, 8
    scene = build_furnace(0.5, 1.0)
    world = build_world(replace(scene, materials=[replace(m, model=PrincipledModel()) for m in scene.materials]))
    found = [torch.tensor(value, requires_grad=True) for value in (0.5, 0.3)]
    materials = ConstantMaterials(*found)
    at = Oracle("furnace", 0.5).vertices(pixels, Stream(1))
    side = torch.nn.functional.normalize(Stream(2).uniform(pixels, 3) - 0.5, dim=-1)
    si = replace(at, wo=torch.nn.functional.normalize(at.n + 0.8 * side, dim=-1)).repeat(n)
    parts = SceneModel(world, materials, lambda si, albedo: torch.full_like(albedo, 1.1))

    def gradient(control: bool, batch: int) -> torch.Tensor:
        stream = Stream(3, batch)
        u = stream.uniform(len(si), DIMENSIONS)
        sample = make(**settings, control_variate=control).reflected(parts, si, materials(si), u, stream)
        value = sample.value.view(pixels, n, 3)
        variate = None
        if control:
            variate = ControlVariate(sample.Li_bsdf.view_as(value), sample.sample_stats.deviation.view_as(value), n)
        loss = leave_one_out(value, torch.full((pixels, 3), 0.3), torch.ones(pixels, 3), variate)
        return torch.stack(torch.autograd.grad(loss.surrogate, found))

    usual, less = (torch.stack([gradient(c, i) for i in range(batches)]).double() for c in (False, True))
    difference = less - usual
    slack = torch.tensor([0.005, 0.04]) * usual.mean(0).abs()
    apart = (difference.mean(0).abs() - slack).clamp_min(0.0)
    t = apart / (difference.std(0) / batches**0.5)
    ratio = less.var(0) / usual.var(0)
    assert accept(2 * stats.t.sf(t.numpy(), batches - 1))
    assert ratio[0] < largest[0]
    assert ratio[1] < largest[1]
