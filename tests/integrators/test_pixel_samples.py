"""What the samples of a pixel begin with: evenly spread uniform numbers, and first hits that are kept."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.cameras import film
from helpers.devices import on_devices
from helpers.object_scene import object_scene
from helpers.object_scene import sky as sky_map
from helpers.oracles import accept, pooled_chi2
from helpers.pathtraced import paths
from helpers.small_step import SmallStep

from neurad.assembly.build import build_world
from neurad.assembly.settings import Objective, Sampling
from neurad.core.records import PixelBatch
from neurad.core.rng import Stream
from neurad.integrators.film import render
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.stratified import stratified_samples
from neurad.integrators.vertex import DIMENSIONS
from neurad.runtime.threads import GRAIN
from neurad.scene.builtin import build, build_cornell

# ---- uniform numbers: each is uniform whatever its place in the group, and groups are even


GROUPS = 40_000


@pytest.mark.parametrize("count", [1, 2, 4, 6, 16])
def test_numbers_of_a_bounce_are_uniform_and_independent(count: int) -> None:
    """Chi-square on 8 x 8 cells of all pairs of numbers, for the first, a middle and the last bounce of the groups."""
    u = stratified_samples(GROUPS, count, Stream(1, count)).view(GROUPS, count, DIMENSIONS)
    assert float(u.min()) >= 0.0
    assert float(u.max()) < 1.0
    cells = (u * 8).long()
    p = []
    for place in sorted({0, count // 2, count - 1}):
        for first in range(DIMENSIONS):
            for second in range(first):
                joint = torch.bincount(cells[:, place, first] * 8 + cells[:, place, second], minlength=64)
                p.append(pooled_chi2(joint.numpy(), np.full(64, GROUPS / 64)))
    assert accept(np.array(p))


@on_devices
@pytest.mark.parametrize("count", [1, 2, 3, 4, 8, 16])
def test_each_number_stands_once_in_every_part_of_its_range(device: str, count: int) -> None:
    u = stratified_samples(1000, count, Stream(2, count, device=device))
    assert u.device.type == device
    assert 0.0 <= float(u.min()) < 0.01
    assert 0.99 < float(u.max()) < 1.0
    assert float((u.mean(0) - 0.5).abs().max()) < 0.06
    u = u.cpu().view(1000, count, DIMENSIONS).sort(1).values
    if count == 3:  # the second ones of pairs are for powers of two
        u = u[..., [0, 2, 3, 4, 6]]
    gaps = torch.cat((u, u[:, :1] + 1.0), 1).diff(dim=1)
    torch.testing.assert_close(gaps, torch.full_like(gaps, 1.0 / count), rtol=0, atol=1e-5)


@pytest.mark.parametrize(("pair", "least"), [((0, 1), 12.0), ((4, 5), 12.0), ((2, 3), 9.8)])
def test_pairs_spread_over_the_square(pair: tuple[int, int], least: float) -> None:
    """16 points of a pair reach far more of 4 x 4 cells than 16 random ones, of which 10.3 do on average."""
    u = stratified_samples(4000, 16, Stream(3)).view(4000, 16, DIMENSIONS)[..., list(pair)]
    cells = (u * 4).long()
    filled = torch.zeros(4000, 16).scatter_(1, cells[..., 0] * 4 + cells[..., 1], 1.0).sum(1).mean()
    assert float(filled) > least


def test_groups_are_independent() -> None:
    """A smooth function's mean over one group is uncorrelated with the next: |r| below 4 standard errors."""
    u = stratified_samples(GROUPS, 4, Stream(4)).view(GROUPS, 4, DIMENSIONS)
    means = (u[..., 4] * u[..., 5] + u[..., 3]).mean(1)
    r = torch.corrcoef(torch.stack((means[::2], means[1::2])))[0, 1]
    assert abs(float(r)) < 4.0 / (GROUPS / 2) ** 0.5


@pytest.mark.parametrize("count", [2, 3, 8, 30])
def test_the_compiled_form_gives_the_same_numbers(count: int) -> None:
    assert torch.equal(
        stratified_samples(500, count, Stream(5)), stratified_samples(500, count, Stream(5), use_kernels=False)
    )


def test_pictures_with_spread_first_bounces_have_the_same_mean_and_less_noise() -> None:
    scene = build("patterns")
    plain = paths(scene)
    camera = replace(scene.test[0].camera, width=12, height=12)
    mean, error, noise = {}, {}, {}
    for spread in (1, 16):
        pictures = torch.stack([render(camera, replace(plain, spread=spread), 16, seed) for seed in range(16)])
        means = pictures.mean((1, 2, 3))
        mean[spread], error[spread] = float(means.mean()), float(means.std()) / 4
        noise[spread] = float((pictures.var(0) / pictures.mean(0) ** 2).median())
    assert abs(mean[1] - mean[16]) < 4 * (error[1] ** 2 + error[16] ** 2) ** 0.5  # by chance once in 16000 runs
    assert noise[16] < 0.85 * noise[1], noise


# ---- kept first hits: where they lie, and the kernel that recomputes their points


@pytest.mark.parametrize(("positions", "cached"), [(1, 1), (2, 2), (2, 4), (3, 4), (5, 8)])
def test_positions_lie_in_their_pixel_and_are_independent(positions, cached):
    """All kept positions are in use, spread over the pixel, and pairs are as often equal as independent draws are:
    leave-one-out would be biased if they were always different. 99.9 % confidence."""
    made = SmallStep(Sampling(spp=positions, cached_spp=cached), Objective(estimator="two_pass"))
    n = 600
    batch = made.batch(n)
    camera = made.scene.train[0].camera
    corner = torch.stack((batch.pixel % camera.width, batch.pixel // camera.width), -1).repeat_interleave(positions, 0)
    si = made.primary(batch, positions, Stream(2)).si
    assert si.valid.all()
    place = film(made.scene, batch.view.repeat_interleave(positions), si.p) - corner
    assert place.min() > -1e-3
    assert place.max() < 1 + 1e-3
    assert place.std(0).min() > 0.2, "never the centre alone"
    assert (place.mean(0) - 0.5).abs().max() < 0.06
    place = place.view(n, positions, 2)
    if positions > 1:
        equal = ((place[:, 0] - place[:, 1]).abs().amax(-1) < 1e-5).float().mean().item()
        assert abs(equal - 1 / cached) < 3.3 * math.sqrt((1 - 1 / cached) / cached / n)
    again = made.primary(batch, positions, Stream(3)).si.p
    assert torch.equal(again, si.p) == (cached == 1)


@pytest.mark.parametrize("sky", [False, True])
@pytest.mark.usefixtures("three_threads")
def test_compiled_points_of_kept_hits_are_the_plain_ones(sky):
    scene = object_scene(sky_map()) if sky else build_cornell()
    world = build_world(scene, "embree")
    cameras = [view.camera for view in scene.train]
    made = [PrimaryHits(world, cameras, 4, 0, torch.device("cpu"), use_kernels) for use_kernels in (True, False)]
    view, pixel = (
        x.flatten()
        for x in torch.meshgrid(torch.arange(len(cameras)), torch.arange(made[0].pixels)[::7], indexing="ij")
    )
    batch = PixelBatch(view, pixel, torch.zeros(len(view), 3), torch.ones(len(view)), 0)
    kernel, reference = (primary(batch, 40, Stream(1)).si for primary in made)
    assert len(kernel) == 40 * len(view) >= 2 * GRAIN
    assert kernel.valid.all() != sky
    assert torch.equal(kernel.prim, reference.prim)
    assert torch.equal(kernel.valid, reference.valid)
    for key in ("p", "ng", "n", "wo", "uv", "bary"):
        torch.testing.assert_close(getattr(kernel, key), getattr(reference, key), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(kernel.wo.norm(dim=-1), torch.ones(len(kernel)), atol=1e-3, rtol=0)  # float16 in the sky


def test_positions_that_were_drawn_more_than_once_are_known():
    made, n = SmallStep(Sampling(cached_spp=4)), 50
    hit = made.primary(made.batch(n), 6, Stream(2))
    lanes, source = hit.distinct.lanes, hit.distinct.source
    assert 2 * n < len(lanes) <= 4 * n
    assert torch.equal(hit.si.p[lanes][source], hit.si.p)
    assert torch.equal(hit.si.wo[lanes][source], hit.si.wo)
    assert torch.equal(lanes, lanes.unique())
    for pixel in hit.si.bary[lanes].split(lanes.div(6, rounding_mode="floor").bincount().tolist()):
        assert len(pixel.unique(dim=0)) == len(pixel)
    values, outer = Stream(3).uniform(len(lanes), 3).requires_grad_(), Stream(4).uniform(6 * n, 3)
    found = hit.distinct.spread(values)
    assert torch.equal(found, values[source])
    expected, gradient = torch.zeros_like(values).index_add(0, source, outer), torch.autograd.grad(found, values, outer)
    torch.testing.assert_close(gradient[0], expected)
    assert made.primary(made.batch(n), 1, Stream(2)).distinct is None
    cameras = [view.camera for view in made.scene.train]
    reference = PrimaryHits(made.estimator.world, cameras, 4, 0, torch.device("cpu"), use_kernels=False)
    assert reference(made.batch(n), 6, Stream(2)).distinct is None


def test_kept_positions_of_a_pixel_are_distinct():
    """Four cells of a pixel hold one position each."""
    made = SmallStep(Sampling(cached_spp=4))
    camera = made.scene.train[0].camera
    pixels = torch.arange(camera.width * camera.height)
    count = len(pixels)
    view = torch.zeros(4 * count, dtype=torch.int64)
    si = made.estimator.world.geometry.interact_at(
        made.primary.prim[: 4 * count].long(), *made.primary.bary[: 4 * count].unbind(-1), torch.zeros(4 * count, 3),
        torch.ones(4 * count, dtype=torch.bool),
    )  # fmt: skip
    corner = torch.stack((pixels % camera.width, pixels // camera.width), -1).repeat_interleave(4, 0)
    place = film(made.scene, view, si.p) - corner
    cell = (place.clamp(0, 0.9999) * 2).long()
    found = (cell[:, 0] + 2 * cell[:, 1]).view(count, 4).sort(-1).values
    assert (found == torch.arange(4)).all(-1).float().mean() > 0.99  # rounding may push one over the line
