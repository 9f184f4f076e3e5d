"""What the albedo says of light that is not known: one that is wrong is found, texture is none."""

import numpy as np
import pytest
import torch

from neurad.core.records import SurfaceInteraction
from neurad.evidence.light_balance import LitPoints, brightness, factors, needed
from neurad.evidence.shading import parts_of_scan

N, SKY, PARTS = 4000, 12, 20


@pytest.fixture(scope="module")
def room():
    """Irradiance at points of parts of constant albedo, from parts of a sky, and the factors that its light lacks."""
    rng = np.random.default_rng(3)
    part, block = rng.integers(PARTS, size=N), rng.integers(4, size=(N, 3))
    place = rng.random((N, 2))
    centre = rng.random((SKY, 2))
    near = np.exp(-np.square(place[:, None] - centre).sum(-1) / 0.1)  # each part of the sky lights a place
    sky = near[..., None] * rng.uniform(0.2, 1.0, (SKY, 3))
    rest = np.full((N, 3), 0.5)
    paint = rng.uniform(0.2, 0.8, (PARTS, 3))[part]
    return part, block, sky, rest, paint, rng.normal(0.0, 0.5, (SKY, 3))


def _points(room, lacking, texture):
    """As a fit under the wrong sky sees it."""
    part, block, sky, rest, paint, _ = room
    lights = np.concatenate((sky, rest[:, None]), 1)
    color = paint * np.exp(texture) * ((sky * np.exp(lacking)).sum(1) + rest)
    return LitPoints(color, part, block, lights, np.zeros((1, *lights.shape)))


@pytest.mark.parametrize("texture", [0.0, 0.2])
def test_the_factors_that_a_sky_lacks_are_found(room, texture):
    lacking, sky, rest = room[-1], room[2], room[3]
    noise = texture * np.random.default_rng(5).standard_normal((N, 3))
    points = _points(room, lacking, noise)
    found, changed = factors(points)
    change = [np.log((sky * np.exp(logs)).sum(1) + rest) for logs in (lacking, np.zeros((SKY, 3)), found)]
    before, after = (np.std(change[0] - other, 0) for other in change[1:])
    assert (after < (0.1 if texture else 0.02) * before).all()
    assert changed == pytest.approx(np.sqrt(np.mean(before**2)), rel=0.2)


def test_gloss_is_not_taken_for_light(room):
    """One light is five times too dim, its highlights lie where it is bright, and are as wide as each part is rough."""
    part, block, sky, rest, paint, _ = room
    rng = np.random.default_rng(11)
    lights, times = np.stack((sky.sum(1), rest), 1), np.array([5.0, 1.0])[:, None]
    near = (sky.sum((1, 2)) / sky.sum((1, 2)).max())[:, None, None]
    peak = near ** np.array([1.0, 3.0, 9.0])[:, None, None, None]  # [3, N, 1, 1]
    gloss = np.concatenate((peak * lights[:, :1], np.broadcast_to(0.04 * lights[:, 1:], (3, N, 1, 3))), -2)
    paint = paint * np.exp(0.2 * rng.standard_normal((N, 3)))
    color = paint * (times * lights).sum(1) + (times * gloss[part % 3, np.arange(N)]).sum(1)
    known, ignored = (LitPoints(color, part, block, lights, x) for x in (gloss, np.zeros_like(gloss)))
    (found, error), (blind, _) = ((float(x[0, 1]) for x in brightness(points)) for points in (known, ignored))
    assert error < 0.02
    assert abs(found - np.log(5.0)) < 4.0 * error
    assert abs(blind - np.log(5.0)) > 10.0 * error


def test_texture_alone_changes_next_to_nothing(room):
    """Paint whose albedo varies by a fifth, at random: a hundredth of that at most is taken for light."""
    texture = 0.2 * np.random.default_rng(7).standard_normal((N, 3))
    points = _points(room, np.zeros((SKY, 3)), texture)
    assert factors(points)[1] < 0.01


def test_lights_that_are_too_dim_are_selected(room):
    """Two of twelve are, by a factor of ten."""
    texture = 0.2 * np.random.default_rng(7).standard_normal((N, 3))
    lacking = np.zeros((SKY, 3))
    assert needed(_points(room, lacking, texture), 2.0) == []
    lacking[[2, 5]] = np.log(10.0)
    assert sorted(needed(_points(room, lacking, texture), 2.0)) == [2, 5]


def test_a_scan_of_a_room_has_a_surface_for_each_way_that_it_faces():
    """Else a dark floor below a white ceiling would be taken for light that comes from above and is too bright."""
    n = torch.tensor([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.1, 0.9, 0.0], [1.0, 0.0, 0.0]])
    zero = torch.zeros(4, dtype=torch.int64)
    si = SurfaceInteraction(p=n, ng=n, n=n, wo=n, uv=n[:, :2], bary=n[:, :2], prim=zero, valid=zero == 0)
    one = parts_of_scan(zero, si, 4)
    assert one[0] == one[2]
    assert len(set(one.tolist())) == 3
    meshes = torch.tensor([0, 0, 1, 1])
    assert parts_of_scan(meshes, si, 4) is meshes
