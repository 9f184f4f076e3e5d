"""Lamps that are recovered: derivatives by their radiance, how they are sampled, and what photographs say of them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.lamp_scene import LAMPS, with_lamps
from helpers.method_oracles import Oracle, Textures, camera_vertices, gallery
from helpers.object_scene import sky
from helpers.random_vertices import random_vertices

from neurad.assembly.build import build_world
from neurad.assembly.lighting import lamps_of_scene, unknown_lamps
from neurad.assembly.settings import Lighting
from neurad.checkpoints.state import fitting, scene_state
from neurad.core.errors import InputError
from neurad.core.reflection import PrincipledModel
from neurad.core.rng import Stream
from neurad.emitters.area import AreaLights
from neurad.emitters.fitted_lamps import UNIFORM_FRACTION, FittedLamps
from neurad.integrators.bounce import bounce
from neurad.integrators.debiased import Debiased
from neurad.integrators.direct import Direct
from neurad.integrators.path import PathTracing
from neurad.integrators.prb import PRB
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.vertex import DIMENSIONS
from neurad.scene.builtin import build_cornell

RHO = 0.5


def glossy(scene):
    return replace(scene, materials=[replace(m, model=PrincipledModel()) for m in scene.materials])


def name_of(method):
    return type(method).__name__ + str(getattr(method, "k", ""))


# ---- derivatives


@pytest.mark.parametrize(
    ("method", "series"),
    [
        (Direct(), RHO),
        (Radiometric(), RHO),
        (Radiometric(k=3), RHO + RHO**2 + RHO**3),
        (PathTracing(None), RHO / (1 - RHO)),
        (PRB(None), RHO / (1 - RHO)),
        (Debiased(), RHO / (1 - RHO)),
    ],
    ids=lambda x: name_of(x) if not isinstance(x, float) else "",
)
def test_derivative_by_the_radiance_is_the_closed_form_of_the_furnace(method, series):
    """With emission E = 1 a pixel shows ``1 + series``, the derivative of each method by the radiance; the field of the
    methods that read one is right, and fixed. Independent batches: 99.9 % confidence, and half a per cent in any case.
    """
    oracle = Oracle("furnace", RHO)
    geometry = oracle.world.geometry
    oracle.world.lights = lamps = FittedLamps(geometry, [0], np.ones((1, 3)))
    found = []
    for index in range(8):
        stream = Stream(11, index)
        si = oracle.vertices(2500, stream)
        u = stream.uniform(len(si), DIMENSIONS)
        value = method.reflected(oracle.parts(), si, oracle.materials(si), u, stream).value
        shown = (oracle.world.emitted(si) + value).mean(0).sum() / 3
        (gradient,) = torch.autograd.grad(shown, [lamps.values])
        found.append(float(gradient.sum()))
    mean, error = np.mean(found), np.std(found, ddof=1) / np.sqrt(len(found))
    assert abs(mean - (1 + series)) < 5.4 * error + 1e-5  # Student's t of 7
    assert abs(mean / (1 + series) - 1) < 5e-3


@pytest.mark.parametrize("scene", [build_cornell(), glossy(build_cornell())], ids=["diffuse", "principled"])
def test_kernels_and_reference_have_the_same_derivatives(scene):
    world, lamps = with_lamps(scene)
    si = random_vertices(world, 600, 3)
    u = Stream(4).uniform(len(si), DIMENSIONS)
    weight = Stream(6).uniform(len(si), 3)
    found = []
    for kernels in (True, False):
        albedo = torch.full_like(si.p, 0.6).requires_grad_()
        surface = replace(Textures()(si), albedo=albedo)
        step = bounce(world, si, surface, u, use_kernels=kernels)
        total = (step.direct * weight).sum()
        found.append((step.direct.detach(), *torch.autograd.grad(total, [lamps.values, albedo])))
    for kernel, reference in zip(*found, strict=True):
        torch.testing.assert_close(kernel, reference, rtol=2e-3, atol=2e-4)
    assert float(found[0][1].abs().sum()) > 1.0


def test_known_lamps_and_evaluations_have_no_gradient():
    world, lamps = with_lamps(gallery())
    si = camera_vertices(world, 50, 1)
    with torch.no_grad():
        assert not world.emitted(si).requires_grad
    assert world.emitted(si).requires_grad
    lamps.values.requires_grad_(False)
    assert not world.emitted(si).requires_grad


# ---- sampling


def test_light_of_fitted_lamps_is_that_of_known_ones_whatever_the_tables():
    """Direct light by the tables of another radiance: 99.9 % confidence."""
    scene = gallery()
    world, lamps = with_lamps(scene)
    si = camera_vertices(world, 200, 1)
    surface = Textures()(si)
    lamps.sampled.copy_(torch.tensor([[50.0, 50.0, 50.0], [0.01, 0.01, 0.01]]))
    lamps.tabulate()

    def means(world):
        rows = []
        with torch.no_grad():
            for seed in range(60):
                rows.append(bounce(world, si, surface, Stream(seed, 2).uniform(len(si), DIMENSIONS)).direct.mean())
        return float(np.mean(rows)), float(np.std(rows, ddof=1) / np.sqrt(len(rows)))

    (a, da), (b, db) = means(world), means(build_world(scene))
    assert abs(a - b) < 3.5 * np.hypot(da, db)
    assert db < 0.02 * b


def test_tables_follow_the_radiance_and_leave_no_lamp_out():
    _, lamps = with_lamps(gallery())
    u = Stream(1).uniform(20000)

    def fractions():
        return torch.bincount(lamps.lamp[lamps.chosen(u)], minlength=2) / len(u)

    light = lamps.found() @ [0.212671, 0.715160, 0.072169] * lamps.area.numpy()
    expected = (1 - UNIFORM_FRACTION) * light / light.sum() + UNIFORM_FRACTION / 2
    np.testing.assert_allclose(fractions(), expected, atol=0.01)
    lamps.set_radiance(np.array([[1e-6, 1e-6, 1e-6], [5.0, 0.0, 0.0]]))
    np.testing.assert_allclose(fractions(), [UNIFORM_FRACTION / 2, 1 - UNIFORM_FRACTION / 2], atol=0.01)
    assert lamps.found()[1, 1] == pytest.approx(5e-4, rel=1e-3)  # positive, and as good as black
    torch.testing.assert_close(lamps.emission[lamps.lit], lamps.radiance.detach()[lamps.lamp[lamps.lit]])


def test_state_brings_radiance_and_tables_back():
    world, lamps = with_lamps(gallery(), sky())
    lamps.set_radiance(np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
    with torch.no_grad():
        lamps.values += 0.1  # since the last refresh
    other, fresh = with_lamps(gallery(), sky())
    other.load_state_dict(world.state_dict())
    lamps.update()
    for name in ("emission", "pdf_area", "cdf", "values"):
        assert torch.equal(getattr(lamps, name), getattr(fresh, name)), name
    assert other.lights.probability == world.lights.probability


def test_what_cannot_be_recovered_is_said():
    scene = gallery()
    dark = replace(scene, meshes=[replace(m, radiance=None) for m in scene.meshes])
    assert lamps_of_scene(dark) == []
    with pytest.raises(InputError, match=r"no shape of scene\.xml has an area emitter"):
        unknown_lamps(dark, build_world(scene).geometry, LAMPS)
    assert unknown_lamps(scene, build_world(scene).geometry, Lighting()) is None
    assert isinstance(build_world(scene).lights, AreaLights)


def test_in_another_light_radiance_goes_to_the_lamps_that_it_was_found_of():
    """Not to those that stand at the same place in a list."""
    scene = gallery()
    first, second = lamps_of_scene(scene)

    def lit(*meshes):
        chosen = {index: np.full(3, 1.0 + index, np.float32) for index in meshes}
        return replace(scene, meshes=[replace(m, radiance=chosen.get(i)) for i, m in enumerate(scene.meshes)])

    def state_of(scene):
        world, lamps = with_lamps(scene)
        return lamps, {f"world.{name}": value for name, value in world.state_dict().items()}

    fit, weights = state_of(lit(second))
    fit.set_radiance(np.array([[7.0, 8.0, 9.0]]))
    weights = {name: value.clone() for name, value in weights.items()}

    def taken_over(other):
        checkpoint = {"neurad": scene_state(lit(second)), "state_dict": dict(weights)}
        fitting(checkpoint, state_of(other)[1], other, None)
        world, lamps = with_lamps(other)
        state = {name.removeprefix("world."): value for name, value in checkpoint["state_dict"].items()}
        world.load_state_dict(state)
        return lamps.found()

    np.testing.assert_allclose(taken_over(lit(second)), [[7, 8, 9]], rtol=1e-5)
    np.testing.assert_allclose(taken_over(lit(first)), [[1.0 + first] * 3], rtol=1e-5)
    np.testing.assert_allclose(taken_over(lit(first, second)), [[1.0 + first] * 3, [7, 8, 9]], rtol=1e-5)
