"""Evenly spread uniform numbers: each is uniform whatever its place in the group, and groups are even."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.devices import on_devices
from helpers.oracles import accept, pooled_chi2

from neurad.assembly.build import build_world
from neurad.core.rng import Stream
from neurad.integrators.film import render
from neurad.integrators.renderer import path_tracer
from neurad.integrators.stratified import stratified_samples
from neurad.integrators.vertex import DIMENSIONS
from neurad.scene.builtin import build
from neurad.scene.textures import TrueMaterials

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


def test_double_precision_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    single = stratified_samples(50, 4, Stream(6))
    uniform = Stream.uniform
    monkeypatch.setattr(Stream, "uniform", lambda self, *shape: uniform(self, *shape).double())
    double = stratified_samples(50, 4, Stream(6))
    assert double.dtype == torch.float64
    torch.testing.assert_close(double.float(), single)


def test_pictures_with_spread_first_bounces_have_the_same_mean_and_less_noise() -> None:
    scene = build("patterns")
    world = build_world(scene)
    plain = path_tracer(world, TrueMaterials(scene, world.geometry), scene.max_depth, scene.rr_depth)
    camera = replace(scene.test[0].camera, width=12, height=12)
    mean, error, noise = {}, {}, {}
    for spread in (1, 16):
        pictures = torch.stack([render(camera, replace(plain, spread=spread), 16, seed) for seed in range(16)])
        means = pictures.mean((1, 2, 3))
        mean[spread], error[spread] = float(means.mean()), float(means.std()) / 4
        noise[spread] = float((pictures.var(0) / pictures.mean(0) ** 2).median())
    assert abs(mean[1] - mean[16]) < 4 * (error[1] ** 2 + error[16] ** 2) ** 0.5  # by chance once in 16000 runs
    assert noise[16] < 0.85 * noise[1], noise
