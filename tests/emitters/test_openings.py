"""Directions drawn towards openings and towards the sun: samplers against their densities, and what they estimate."""

import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from neurad.core.colour import luminance
from neurad.core.records import Rays
from neurad.core.rng import Stream
from neurad.core.scene_records import EnvironmentMap
from neurad.emitters.area import AreaLights
from neurad.emitters.environment import Environment
from neurad.emitters.fitted import FittedEnvironment
from neurad.emitters.lights import Lights
from neurad.emitters.openings import Openings
from neurad.scene.builtin.plain import diffuse
from neurad.scene.builtin.shapes import quad
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry

BOUNDS = torch.tensor([[-1.0, 0.0, -2.0], [3.0, 2.5, 1.0]])
POINT = torch.tensor([0.4, 0.7, -0.3])
TOWARDS = np.array([0.6, 0.48, 0.64])
ROWS, COLUMNS = 24, 48
N = 200_000


def through_a_window(seed: int = 1, n: int = 4000) -> Rays:
    """Rays that leave by a window in the wall at x = 3."""
    u = Stream(seed).uniform(n, 5)
    window = torch.stack((torch.full((n,), 3.0), 1.0 + u[:, 0], -1.0 + u[:, 1]), -1)
    o = BOUNDS[0] + u[:, 2:] * (torch.tensor([2.0, 2.5, 1.0]) - BOUNDS[0])
    return Rays(o, torch.nn.functional.normalize(window - o, dim=-1))


def openings() -> Openings:
    return Openings(through_a_window(), BOUNDS)


def fitted(sun: bool) -> FittedEnvironment:
    """A map of no particular form, seen through the window, with the sun or without."""
    environment = FittedEnvironment(EnvironmentMap(np.ones((2, 4, 3), np.float32)), 16, 8)
    with torch.no_grad():
        environment.values.copy_(Stream(5).uniform(128, 3))
    environment.enter_by(openings())
    if sun:
        environment.sun.rise(TOWARDS, 0.2, np.array([3.0, 2.0, 1.0]))
    environment.refresh()
    return environment


def cells_of(d: Tensor) -> np.ndarray:
    """Cell of equal solid angle that directions lie in."""
    row = ((d[:, 1].double() + 1) / 2 * ROWS).long().clamp(0, ROWS - 1)
    column = ((torch.atan2(d[:, 0], d[:, 2]).double() / (2 * math.pi) + 0.5) * COLUMNS).long() % COLUMNS
    return (row * COLUMNS + column).numpy()


def uniform_sphere(n: int, seed: int) -> Tensor:
    u = Stream(seed).uniform(n, 2).double()
    y, phi = 2 * u[:, 0] - 1, 2 * math.pi * u[:, 1]
    r = (1 - y * y).sqrt()
    return torch.stack((r * phi.sin(), y, r * phi.cos()), -1).float()


def follows(drawn: Tensor, pdf, seed: int) -> float:
    """p value of a chi-square test of directions against their density, integrated by 4 million uniform ones; their
    own noise is part of the expected variance.
    """
    uniform = uniform_sphere(4_000_000, seed)
    density = torch.cat([pdf(part).double() for part in uniform.split(1 << 18)])
    cell, weight = cells_of(uniform), density.numpy() * (4 * math.pi / len(uniform))
    share = np.bincount(cell, weight, ROWS * COLUMNS)
    error = np.bincount(cell, weight**2, ROWS * COLUMNS) - share**2 / len(uniform)
    assert share.sum() == pytest.approx(1.0, abs=5 * math.sqrt(error.sum()) + 1e-3)
    count = np.bincount(cells_of(drawn), None, ROWS * COLUMNS)
    keep = share * len(drawn) > 10
    statistic = (count - share * len(drawn))[keep] ** 2 / (share * len(drawn) + error * len(drawn) ** 2)[keep]
    return float(stats.chi2.sf(statistic.sum(), keep.sum()))


def test_directions_towards_openings_follow_their_density() -> None:
    made, p = openings(), POINT.expand(N, 3)
    d = made.direction(p, Stream(2).uniform(N, 3))
    torch.testing.assert_close(d.norm(dim=-1), torch.ones(N))
    assert follows(d, lambda x: made.pdf(POINT.expand(len(x), 3), x), 3) > 1e-3
    at = POINT + (3.0 - POINT[0]) / d[:, :1] * d  # where they meet the wall with the window
    inside = (d[:, 0] > 0) & (at[:, 1] > 0.95) & (at[:, 1] < 2.05) & (at[:, 2] > -1.1) & (at[:, 2] < 0.1)
    assert 0.85 < float(inside.float().mean()) < 0.95


def test_openings_follow_the_radiance_behind_them() -> None:
    rays = through_a_window()
    made = Openings(rays, BOUNDS)
    made.tabulate(
        (rays.o[:, 2:] + rays.d[:, 2:] * ((3.0 - rays.o[:, :1]) / rays.d[:, :1]) > -0.5).float().expand(-1, 3)
    )
    d = made.direction(POINT.expand(N, 3), Stream(2).uniform(N, 3))
    z = POINT[2] + (3.0 - POINT[0]) / d[:, 0] * d[:, 2]
    dark = (d[:, 0] > 0) & (z < -0.6) & (z > -1.0)
    assert float(dark.float().mean()) < 0.02


@pytest.mark.parametrize("sun", [False, True])
def test_directions_of_all_kinds_follow_their_density(sun: bool) -> None:
    made, p = fitted(sun), POINT.expand(N, 3)
    sample = made.sample(p, Stream(7).uniform(N, 3))

    def pdf(d: Tensor) -> Tensor:
        return made._mixed(POINT.expand(len(d), 3), d, made._lookup(d)[1])

    torch.testing.assert_close(sample.pdf, pdf(sample.wi), rtol=1e-3, atol=0.0)
    assert follows(sample.wi, pdf, 8) > 1e-3


def test_the_sun_sends_what_it_is_said_to() -> None:
    """Its irradiance is the integral of its radiance; the map with it in has as much light, from there."""
    made, plain = fitted(True), fitted(False)
    assert made.sun.solid_angle == pytest.approx(2 * math.pi * (1 - math.cos(0.2)), rel=1e-5)
    d = made.sun.direction(POINT.expand(N, 3), Stream(3).uniform(N, 3))
    torch.testing.assert_close(made.sun.radiance(d)[0] * made.sun.solid_angle, torch.tensor([3.0, 2.0, 1.0]))
    assert bool((made.sun.pdf(d, d) > 0).all())
    assert float(torch.arccos((d @ torch.from_numpy(TOWARDS).float()).clamp(-1, 1)).max()) <= 0.2 + 1e-3
    light = [Environment(EnvironmentMap(x.map(4))).integral for x in (made, plain)]
    assert light[0] - light[1] == pytest.approx(0.212671 * 3 + 0.715160 * 2 + 0.072169, rel=2e-3)


def test_the_sun_is_differentiable() -> None:
    made = fitted(True)
    d = torch.from_numpy(TOWARDS).float()[None]
    made.radiance(d).sum().backward()
    torch.testing.assert_close(made.sun.values.grad, made.sun.values.detach().exp())


def test_openings_estimate_an_irradiance_without_bias_and_with_less_noise() -> None:
    """Of a known map through the window, against uniform directions, in a 99.9 % interval of both."""
    pixels = np.random.default_rng(0).uniform(0.5, 2.0, (8, 16, 3)).astype(np.float32)
    found = []
    for draws in (False, True):
        environment = Environment(EnvironmentMap(pixels))
        if draws:
            environment.enter_by(openings())
        sample = environment.sample(POINT.expand(N, 3), Stream(4).uniform(N, 3))
        at = POINT + (3.0 - POINT[0]) / sample.wi[:, :1] * sample.wi
        seen = (sample.wi[:, 0] > 0) & (at[:, 1] > 1) & (at[:, 1] < 2) & (at[:, 2] > -1) & (at[:, 2] < 0)
        value = torch.where(seen, sample.radiance[:, 0] / sample.pdf, 0.0).double()
        found.append((value.mean(), value.std() / math.sqrt(N)))
    (a, da), (b, db) = found
    assert abs(float(a - b)) < 3.29 * math.hypot(da, db)
    assert db < 0.4 * da


def test_a_map_begins_with_what_was_seen_of_it_and_with_the_nearest_elsewhere() -> None:
    made = FittedEnvironment(EnvironmentMap(np.ones((2, 4, 3), np.float32)), 64, 32)
    made.set_unit(0.5)
    before = made.values.clone()
    made.begin(torch.zeros(0, 3), torch.zeros(0, 3))
    assert torch.equal(made.values, before)
    d = uniform_sphere(20_000, 1)
    strip = d[(d[:, 0] > 0.7) & (d[:, 1].abs() < 0.3)]
    seen = torch.where(strip[:, 1:2] > 0, 8.0, 0.5).expand(-1, 3)
    made.begin(strip, seen)
    up, down = torch.tensor([[0.95, 0.3, 0.0], [0.6, 0.8, 0.0]]), torch.tensor([[0.95, -0.3, 0.0], [0.6, -0.8, 0.0]])
    unit = torch.nn.functional.normalize
    torch.testing.assert_close(made.radiance(unit(up)), torch.full((2, 3), 8.0), rtol=0.05, atol=0.0)
    torch.testing.assert_close(made.radiance(unit(down)), torch.full((2, 3), 0.5), rtol=0.05, atol=0.0)


def test_lamps_beside_a_sky_leave_its_samples_their_density() -> None:
    """The light of a sky through the window, drawn by power among lamps and sky: the map's own integral."""
    environment = Environment(EnvironmentMap(np.random.default_rng(0).uniform(0.5, 2.0, (8, 16, 3)).astype(np.float32)))
    environment.enter_by(openings())
    lamp = quad((-1, 2, -2), (0, 0, 2), (2, 0, 0)).mesh(
        "lamp", 0, smooth_shading=False, radiance=np.full(3, 25, np.float32)
    )
    lights = Lights(AreaLights(Geometry(Scene("lamp", [lamp], [diffuse("white", 0.5)]))), environment, 3.0)
    assert 0.2 < lights.probability < 0.8
    sample = lights.sample(POINT.expand(N, 3), Stream(6).uniform(N, 3))
    far = torch.isinf(sample.distance)
    found = torch.where(far, luminance(sample.radiance) / sample.pdf, 0.0)
    assert float(found.mean()) == pytest.approx(environment.integral, abs=4 * float(found.std()) / math.sqrt(N))
