"""What the albedo says of light that is not known: one that is wrong is found, texture is none."""

import numpy as np
import pytest
import torch

from neurad.core.records import SurfaceInteraction
from neurad.evidence.light_balance import LitPoints, change_of_light, factors, needed
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
    """As a fit under the wrong sky sees it: photographs are right, so the albedo is not."""
    part, block, sky, rest, paint, _ = room
    right = LitPoints(paint, part, block, sky, rest)
    logs = np.stack([change_of_light(right, channel, lacking[:, channel]) for channel in range(3)], -1)
    return LitPoints(paint * np.exp(logs + texture), part, block, sky, rest)


@pytest.mark.parametrize("texture", [0.0, 0.2])
def test_the_factors_that_a_sky_lacks_are_found(room, texture):
    lacking = room[-1]
    noise = texture * np.random.default_rng(5).standard_normal((N, 3))
    points = _points(room, lacking, noise)
    for channel in range(3):
        found, changed = factors(points, channel)
        before, after = (
            np.std(change_of_light(points, channel, lacking[:, channel]) - change_of_light(points, channel, logs))
            for logs in (np.zeros(SKY), found)
        )
        assert after < (0.15 if texture else 0.1) * before  # the albedo's floor against darkness makes it a little less
        assert changed == pytest.approx(before, rel=0.2)


def test_texture_alone_changes_next_to_nothing(room):
    """Paint whose albedo varies by a fifth, at random: a hundredth of that at most is taken for light."""
    texture = 0.2 * np.random.default_rng(7).standard_normal((N, 3))
    points = _points(room, np.zeros((SKY, 3)), texture)
    assert max(factors(points, channel)[1] for channel in range(3)) < 0.01


def test_lights_that_are_too_dim_are_selected(room):
    """Two of twelve are, by a factor of ten."""
    texture = 0.2 * np.random.default_rng(7).standard_normal((N, 3))
    lacking = np.zeros((SKY, 3))
    assert needed(_points(room, lacking, texture)) == []
    lacking[[2, 5]] = np.log(10.0)
    assert sorted(needed(_points(room, lacking, texture))) == [2, 5]


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
