"""Emitters: their samplers against their densities, their light against closed forms and against Mitsuba."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from neurad.core.colour import luminance
from neurad.core.errors import InputError
from neurad.core.records import SurfaceInteraction
from neurad.core.reflection import DiffuseModel
from neurad.core.rng import Stream
from neurad.core.scene_records import Constant, EnvironmentMap, Material, Mesh
from neurad.emitters.area import AreaLights
from neurad.emitters.environment import Environment
from neurad.emitters.lights import MIN_PROBABILITY, Lights, make_lights
from neurad.scene.description import Scene

RECTANGLE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int64)
Z999 = float(stats.norm.ppf(0.9995))
"""Two-sided 99.9 % confidence."""


def geometry_of(vertices: np.ndarray, faces: np.ndarray, emission: np.ndarray) -> SimpleNamespace:
    """What an emitter reads of a Geometry, from plain arrays."""
    v, f = torch.from_numpy(vertices), torch.from_numpy(faces)
    p = v[f]
    cross = torch.linalg.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    area = cross.norm(dim=1)
    return SimpleNamespace(
        vertices=v,
        faces=f,
        face_normal=cross / area.clamp_min(1e-30)[:, None],
        face_area=area / 2,
        emission=torch.from_numpy(emission.astype(np.float32)),
    )


def rectangle(corner: tuple[float, float, float], a: tuple[float, float, float], b: tuple[float, float, float]):
    """Vertices of a rectangle that shines along a x b."""
    o, a, b = np.array(corner, np.float32), np.array(a, np.float32), np.array(b, np.float32)
    return np.stack((o, o + a, o + a + b, o + b))


def arrive(p: Tensor, wi: Tensor, distance: Tensor, prim: Tensor, normal: Tensor) -> SurfaceInteraction:
    """Where rays from ``p`` along ``wi`` ended; infinite distances end nowhere."""
    n = len(p)
    valid = torch.isfinite(distance)
    at = p + wi * torch.where(valid, distance, 1.0)[:, None]
    zeros = torch.zeros(n, 2)
    return SurfaceInteraction(at, normal, normal, -wi, zeros, zeros, torch.where(valid, prim, -1), valid)


def chi_square(observed: np.ndarray, expected: np.ndarray) -> float:
    """p-value of counts against expected counts, small cells pooled."""
    small = expected < 5
    observed = np.append(observed[~small], observed[small].sum())
    expected = np.append(expected[~small], expected[small].sum())
    keep = expected > 0
    assert observed[~keep].sum() == 0
    statistic = ((observed[keep] - expected[keep]) ** 2 / expected[keep]).sum()
    return float(stats.chi2.sf(statistic, keep.sum() - 1))


def environment(seed: int = 0, h: int = 5, w: int = 8, rotate: bool = False) -> EnvironmentMap:
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(0, 1, (h, w, 3)).astype(np.float32) ** 4
    pixels[0] = pixels[0, :1]  # one value at each pole
    pixels[-1] = pixels[-1, :1]
    matrix = np.eye(4, dtype=np.float32)
    if rotate:
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        matrix[:3, :3] = q * np.sign(np.linalg.det(q))
    return EnvironmentMap(pixels, matrix)


def sphere_grid(rows: int, columns: int) -> tuple[Tensor, float]:
    """Directions at the middles of ``rows`` x ``columns`` cells of equal solid angle, and that solid angle."""
    z = 1 - 2 * (torch.arange(rows, dtype=torch.float64) + 0.5) / rows
    phi = 2 * math.pi * (torch.arange(columns, dtype=torch.float64) + 0.5) / columns
    z, phi = (t.reshape(-1) for t in torch.meshgrid(z, phi, indexing="ij"))
    s = (1 - z * z).sqrt()
    return torch.stack((s * phi.cos(), s * phi.sin(), z), -1).float(), 4 * math.pi / (rows * columns)


def equal_cells(wi: Tensor, rows: int, columns: int) -> np.ndarray:
    """Counts of directions in the cells of :func:`sphere_grid`."""
    row = ((1 - wi[:, 2].double()) / 2 * rows).long().clamp(0, rows - 1)
    turn = torch.atan2(wi[:, 1], wi[:, 0]).double() / (2 * math.pi) % 1.0
    column = (turn * columns).long().clamp(0, columns - 1)
    return torch.bincount(row * columns + column, minlength=rows * columns).numpy()


# --- area lights


def test_triangles_are_chosen_by_power_and_points_uniformly() -> None:
    vertices = np.concatenate((rectangle((0, 0, 2), (0, 1, 0), (2, 0, 0)), rectangle((3, 0, 2), (0, 1, 0), (1, 0, 0))))
    faces = np.concatenate((FACES, FACES + 4))
    emission = np.array([[1, 1, 1], [3, 3, 3], [0, 0, 0], [2, 2, 2]])
    light = AreaLights(geometry_of(vertices, faces, emission))
    area = np.array([1, 1, 0.5, 0.5])
    power = area * emission[:, 0]
    np.testing.assert_allclose(light.pdf_area.numpy() * area, power / power.sum(), rtol=1e-6)
    assert light.power == pytest.approx(math.pi * power.sum(), rel=1e-5)
    n = 60_000
    p = torch.zeros(n, 3)
    s = light.sample(p, Stream(1).uniform(n, 3))
    at = p + s.wi * s.distance[:, None]
    np.testing.assert_allclose(at[:, 2].numpy(), 2, atol=1e-5)
    # cells of a 16 x 4 grid over x in 0..4, y in 0..1: each triangle's density is a constant, cut by its diagonal
    fine = 40
    x = (torch.arange(16 * fine) + 0.5) / (4 * fine)
    y = (torch.arange(4 * fine) + 0.5) / (4 * fine)
    gx, gy = torch.meshgrid(x, y, indexing="ij")
    first = gx / 2 < gy  # triangle 0 of the left rectangle holds the corner (0, 1)
    density = torch.where(gx < 2, torch.where(first, power[0] / 1.0, power[1] / 1.0), 0.0)
    density = torch.where((gx >= 3) & (gx - 3 >= gy), power[3] / 0.5, density) / power.sum()
    expected = density.reshape(16, fine, 4, fine).sum((1, 3)) / (4 * fine) ** 2 * n
    cell = (at[:, 0] * 4).long().clamp(0, 15) * 4 + (at[:, 1] * 4).long().clamp(0, 3)
    assert chi_square(torch.bincount(cell, minlength=64).numpy(), expected.reshape(-1).numpy()) > 1e-3


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("lit", [1, 2, 5])
def test_sample_agrees_with_pdf_and_eval(lit: int, turned: bool) -> None:
    rng = np.random.default_rng(lit)
    vertices = rng.normal(size=(3 * 6, 3)).astype(np.float32)
    faces = np.arange(18).reshape(6, 3)
    emission = np.zeros((6, 3))
    emission[:lit] = rng.uniform(0.1, 2, (lit, 3))
    geometry = geometry_of(vertices, faces, emission)
    light = AreaLights(geometry, turned=torch.arange(6) % 2 == 0 if turned else None)
    n = 4000
    p = torch.from_numpy(rng.normal(size=(n, 3)).astype(np.float32)) * 3
    s = light.sample(p, Stream(lit).uniform(n, 3))
    assert torch.isfinite(s.pdf).all()
    assert 0.1 < (s.pdf > 0).float().mean() < 0.9  # the others see the light from behind
    # the triangle that a point lies on, by the smallest distance from its plane among those that contain it
    at = p + s.wi * s.distance[:, None]
    t = geometry.vertices[geometry.faces[:lit]]
    e1, e2, r = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0], at[:, None] - t[:, 0]
    solve = torch.linalg.lstsq(torch.stack((e1, e2), -1)[None].expand(n, -1, -1, -1), r[..., None]).solution[..., 0]
    residual = (solve[..., :1] * e1 + solve[..., 1:] * e2 - r).norm(dim=-1)
    inside = (solve > -1e-4).all(-1) & (solve.sum(-1) < 1 + 1e-4)
    prim = torch.where(inside, residual, math.inf).argmin(1)
    si = arrive(p, s.wi, s.distance, prim, geometry.face_normal[prim])
    torch.testing.assert_close(light.eval(si), s.radiance)
    graze = (si.ng * si.wo).sum(-1).abs() > 1e-3
    torch.testing.assert_close(light.pdf(p, si)[graze], s.pdf[graze], rtol=2e-3, atol=1e-6)
    assert (s.radiance[s.pdf == 0] == 0).all()


def test_compiled_emission_is_the_plain_one() -> None:
    vertices = np.concatenate((RECTANGLE, RECTANGLE + 5))
    emission = np.array([[1, 2, 3], [4, 5, 6], [0, 0, 0], [0, 0, 0]])
    light = AreaLights(geometry_of(vertices, np.concatenate((FACES, FACES + 4)), emission))
    n = 500
    prim = torch.arange(n) % 5 - 1
    normal, wo = torch.nn.functional.normalize(torch.randn(2, n, 3), dim=-1)
    si = arrive(torch.zeros(n, 3), -wo, torch.where(prim < 0, math.inf, 1.0), prim, normal)
    assert torch.equal(light.eval(si), light.eval_reference(si))
    assert 0 < (light.eval(si) > 0).sum() < n


def test_degenerate_triangles_are_never_chosen() -> None:
    vertices = np.concatenate((RECTANGLE, np.zeros((3, 3), np.float32)))
    faces = np.concatenate((FACES, [[4, 5, 6]]))
    light = AreaLights(geometry_of(vertices, faces, np.ones((3, 3))))
    assert light.pdf_area.tolist() == [1.0, 1.0, 0.0]
    s = light.sample(torch.tensor([[0.5, 0.5, 3.0]]).repeat(1000, 1), Stream(3).uniform(1000, 3))
    assert (s.pdf > 0).all()
    with pytest.raises(InputError, match="zero area"):
        AreaLights(geometry_of(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]]), np.ones((1, 3))))


def test_irradiance_below_a_rectangle_is_the_closed_form() -> None:
    """E / L below the corner of a parallel rectangle a x b at height h, four times for the middle."""
    a, b, h, radiance = 1.0, 0.5, 0.7, 3.0
    x, y = a / h, b / h
    sx, sy = math.sqrt(1 + x * x), math.sqrt(1 + y * y)
    exact = radiance * 4 * 0.5 * (x / sx * math.atan(y / sx) + y / sy * math.atan(x / sy))
    vertices = rectangle((-a, -b, h), (0, 2 * b, 0), (2 * a, 0, 0))
    light = AreaLights(geometry_of(vertices, FACES, np.full((2, 3), radiance)))
    n = 100_000
    s = light.sample(torch.zeros(n, 3), Stream(5).uniform(n, 3))
    value = (s.radiance[:, 0] * s.wi[:, 2].clamp_min(0) / s.pdf).double()
    error = value.std() / math.sqrt(n)
    assert abs(value.mean() - exact) < Z999 * error
    assert error < 0.01 * exact


# --- environment


@pytest.mark.parametrize("rotate", [False, True])
def test_environment_agrees_with_mitsuba(mi, rotate: bool) -> None:
    emap = environment(4, h=6, w=9, rotate=rotate)
    plugin = mi.load_dict(
        {
            "type": "envmap",
            "bitmap": mi.Bitmap(emap.pixels),
            "scale": 1.0,
            "to_world": mi.ScalarTransform4f(emap.to_world.astype(float).tolist()),
        }
    )
    scene = mi.load_dict({"type": "scene", "emitter": plugin})
    d, _ = sphere_grid(12, 16)
    expected = []
    for w in d.numpy().astype(float).tolist():
        ray = mi.Ray3f([0, 0, 0], w)
        si = scene.ray_intersect(ray)
        expected.append(list(scene.environment().eval(si)))
    ours = Environment(emap).radiance(d)
    np.testing.assert_allclose(ours.numpy(), np.array(expected), rtol=2e-3, atol=2e-4)


@pytest.mark.parametrize("shape", [(5, 8), (2, 1), (1, 4), (64, 128)])
def test_environment_samples_follow_their_pdf(shape: tuple[int, int]) -> None:
    light = Environment(environment(7, *shape, rotate=True))
    n, rows, columns, fine = 100_000, 10, 20, 12
    s = light.sample(torch.zeros(n, 3), Stream(8).uniform(n, 3))
    torch.testing.assert_close(s.wi.norm(dim=1), torch.ones(n))
    assert torch.isinf(s.distance).all()
    d, angle = sphere_grid(rows * fine, columns * fine)
    nowhere = arrive(torch.zeros_like(d), d, torch.full((len(d),), math.inf), torch.zeros(len(d)).long(), d)
    pdf = light.pdf(torch.zeros_like(d), nowhere).double()
    assert (pdf * angle).sum().item() == pytest.approx(1.0, abs=2e-3)
    assert (pdf > 0).all()
    expected = (pdf * angle).reshape(rows, fine, columns, fine).sum((1, 3)).reshape(-1).numpy()
    assert chi_square(equal_cells(s.wi, rows, columns), expected / expected.sum() * n) > 1e-3
    ended = arrive(torch.zeros(n, 3), s.wi, s.distance, torch.zeros(n).long(), s.wi)
    torch.testing.assert_close(light.pdf(torch.zeros(n, 3), ended), s.pdf)
    torch.testing.assert_close(light.eval(ended), s.radiance)


def test_environment_integral_is_estimated_without_bias() -> None:
    emap = environment(9, 12, 20, rotate=True)
    emap.pixels[4, 7] = 50.0  # a sun
    light = Environment(emap)
    d, angle = sphere_grid(800, 800)
    exact = light.radiance(d).double().sum(0) * angle
    n = 40_000
    s = light.sample(torch.zeros(n, 3), Stream(10).uniform(n, 3))
    value = (s.radiance / s.pdf[:, None]).double()
    error = value.std(0) / math.sqrt(n)
    assert ((value.mean(0) - exact).abs() < Z999 * error + 1e-4 * exact).all()
    assert luminance(exact).item() == pytest.approx(light.integral, rel=0.02)  # the table takes cell means
    # importance sampling is worth having: its variance lies well below that of uniform directions
    assert (value.std(0) < 0.5 * light.radiance(d).double().std(0) * 4 * math.pi).all()


def test_poles_are_sampled_with_all_their_digits() -> None:
    pixels = np.full((2048, 2, 3), 1e-6, np.float32)
    pixels[0] = pixels[-1] = 1e6
    light = Environment(EnvironmentMap(pixels))
    s = light.sample(torch.zeros(20_000, 3), Stream(11).uniform(20_000, 3))
    off = torch.hypot(s.wi[:, 0], s.wi[:, 2]) / (math.pi / 2047)  # in rows from a pole
    cap = off[off < 1]
    assert len(cap) > 18_000
    assert stats.kstest((cap**2).numpy(), "uniform").pvalue > 1e-3
    assert 0.45 < (s.wi[:, 1] > 0).float().mean() < 0.55


def test_environment_is_dark_on_surfaces() -> None:
    light = Environment(environment())
    d, _ = sphere_grid(4, 4)
    si = arrive(torch.zeros_like(d), d, torch.ones(16), torch.zeros(16).long(), -d)
    assert (light.eval(si) == 0).all()
    assert (light.pdf(torch.zeros_like(d), si) == 0).all()


# --- both


def test_both_kinds_together_estimate_the_sum() -> None:
    """Irradiance at the origin, facing the lamp: lamp (it hides nothing here) plus upper half of the environment."""
    radiance, vertices = np.array([5, 4, 3], np.float32), rectangle((-0.5, -0.5, 1), (0, 1, 0), (1, 0, 0))
    grey = Constant(np.array([0.5, 0.5, 0.5], np.float32))
    mesh = Mesh("lamp", vertices, FACES, 0, radiance=radiance)
    scene = Scene("s", [mesh], [Material("m", DiffuseModel(), grey, grey)], environment(12, rotate=True))
    lights = make_lights(scene, geometry_of(vertices, FACES, np.stack((radiance, radiance))))
    assert isinstance(lights, Lights)
    assert MIN_PROBABILITY <= lights.probability <= 1 - MIN_PROBABILITY
    n = 100_000
    p = torch.zeros(n, 3)
    s = lights.sample(p, Stream(13).uniform(n, 3))
    x = 0.5
    form = 2 * x / math.sqrt(1 + x * x) * math.atan(x / math.sqrt(1 + x * x))
    d, angle = sphere_grid(600, 600)
    far = (lights.second.radiance(d) * d[:, 2:].clamp_min(0)).double().sum(0) * angle
    exact = 2 * form * torch.tensor([5.0, 4.0, 3.0], dtype=torch.float64) + far
    value = (s.radiance * s.wi[:, 2:].clamp_min(0) / s.pdf[:, None]).double()
    error = value.std(0) / math.sqrt(n)
    assert ((value.mean(0) - exact).abs() < Z999 * error + 1e-3 * far).all()
    three = torch.isfinite(s.distance)
    assert three.float().mean().item() == pytest.approx(lights.probability, abs=0.01)
    down = torch.tensor([[0.0, 0.0, -1.0]]).repeat(n, 1)
    si = arrive(p, s.wi, s.distance, torch.zeros(n).long(), down)
    torch.testing.assert_close(lights.pdf(p, si), s.pdf, rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(lights.eval(si), s.radiance)
