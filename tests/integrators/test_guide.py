"""Guided directions: the histogram draws what it says, leaves every mean alone, and takes noise away."""

from dataclasses import replace

import pytest
import torch
from helpers.oracles import accept
from helpers.trainer_fit import fit
from scipy.stats import chisquare, norm

from benchmarks.stress.fit import glossy, photographs, resized
from neurad.assembly.build import build_world
from neurad.assembly.settings import Sampling
from neurad.bsdf.principled import Principled
from neurad.core.records import Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.core.sampling import concentric_disk, cosine_hemisphere, disk_to_square
from neurad.integrators.bounce import bounce
from neurad.integrators.direct import Direct
from neurad.integrators.guide import FACINGS, Guide, Guided
from neurad.integrators.method import Method
from neurad.integrators.path import PathTracing
from neurad.integrators.prb import PRB
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.vertex import DIMENSIONS
from neurad.scene import builtin

BOX = torch.tensor([[-1.0, 0.0, 2.0], [1.0, 1.0, 5.0]])


def points(n: int, seed: int) -> SurfaceInteraction:
    """Lanes anywhere in the box, facing anywhere."""
    stream = Stream(seed)
    normal = torch.nn.functional.normalize(2.0 * stream.uniform(n, 3) - 1.0, dim=-1)
    p = BOX[0] + stream.uniform(n, 3) * (BOX[1] - BOX[0])
    flat = torch.zeros(n, 2)
    return SurfaceInteraction(
        p, normal, normal, normal, flat, flat, torch.zeros(n, dtype=torch.int64), torch.ones(n) > 0
    )


def trained_guide(use_kernels: bool = True) -> Guide:
    """A guide with samples of light from one side of the square."""
    guide = Guide(BOX, cells=4, bins=4, use_kernels=use_kernels)
    si, u = points(60_000, 1), Stream(2).uniform(60_000, 2)
    guide.record(*guide.bin_samples(si, cosine_hemisphere(u), (20.0 * u[:, :1] ** 3).expand(-1, 3)))
    guide.update()
    return guide


def test_the_square_of_a_disk_and_back() -> None:
    u = Stream(3).uniform(10_000, 2)
    torch.testing.assert_close(disk_to_square(concentric_disk(u)), u, atol=2e-5, rtol=0)
    assert disk_to_square(torch.zeros(1, 2)).tolist() == [[0.5, 0.5]]


def test_compiled_lookups_equal_plain_torch() -> None:
    guide, reference = trained_guide(), trained_guide(use_kernels=False)
    si, u, fraction = points(20_000, 4), Stream(5).uniform(20_000, 3), Stream(6).uniform(20_000)
    far = SurfaceInteraction(**{**si.__dict__, "p": si.p * 3.0 - 4.0})  # outside the box, the nearest cell counts
    for lanes in (si, far):
        rows = guide.rows(lanes, lanes.n)
        assert torch.equal(rows, reference.rows(lanes, lanes.n))
        assert int(rows.min()) >= 0
        assert int(rows.max()) < len(guide.counts)
        for some in (0.6, fraction):
            compiled, plain = Guided(guide, rows, some), Guided(reference, rows, some)
            warped = compiled.warp(u)
            torch.testing.assert_close(warped, plain.warp(u), atol=1e-6, rtol=0)
            wi, pdf = cosine_hemisphere(warped[:, 1:]), torch.full((len(u),), 2.0)
            pdf[::3] = 0.0
            compiled.add_pdf(wi, pdf)
            assert not pdf[::3].any()
            different = (pdf - 2.0 - plain.pdf_delta(wi))[torch.arange(len(u)) % 3 > 0].abs() > 1e-4
            assert int(different.sum()) < 10  # on the edge of a bin either is right
        light = torch.rand(len(wi), 3)
        (places, values), (expected, same) = (g.bin_samples(lanes, wi, light) for g in (guide, reference))
        assert int((places != expected).sum()) < 10
        torch.testing.assert_close(values, same)
    assert guide.shape == [3, 2, 4]
    assert len(guide.counts) == 24 * FACINGS


@pytest.mark.parametrize("use_kernels", [True, False])
def test_chi_square_of_the_bins(use_kernels: bool) -> None:
    guide = trained_guide(use_kernels)
    p = []
    for row in (0, 17, 100):
        rows = torch.full((80_000,), row)
        drawn = Guided(guide, rows, 1.0).warp(Stream(6, row).uniform(80_000, 3))[:, 1:]
        wi = cosine_hemisphere(drawn)
        bins = (drawn * 8).long()  # finer than the guide's own: inside a bin it must be even
        observed = torch.bincount(bins[:, 0] * 8 + bins[:, 1], minlength=64).double()
        centres = cosine_hemisphere((torch.cartesian_prod(torch.arange(8.0), torch.arange(8.0)) + 0.5) / 8)
        expected = guide.density(torch.full((64,), row), centres).double() / 64
        assert float(expected.sum()) == pytest.approx(1.0, abs=1e-5)
        assert float(expected.max() / expected.min()) > 2.0  # it has learned something
        p.append(float(chisquare(observed.numpy(), (expected / expected.sum() * 80_000).numpy()).pvalue))
        assert float(guide.density(rows, wi).min()) > 0.3 - 1e-4  # the fraction that is drawn uniformly
    assert accept(p), p
    even = Guide(BOX, 4, 4, use_kernels=use_kernels)
    p = float(chisquare(observed.numpy(), torch.full((64,), 80_000 / 64).numpy()).pvalue)
    assert not accept([p])
    assert torch.equal(even.density(rows, wi), torch.ones(len(wi)))


def lamp_lit(seed: int, count: int):
    """The cornell box and lanes on its surfaces."""
    scene = builtin.build("cornell")
    world = build_world(scene, specular_fraction=0.25)
    world.bsdf = Principled(specular_fraction=0.25)
    stream = Stream(seed)
    triangle = stream.integers(len(world.geometry.faces), count)
    u = stream.uniform(count, 2)
    fold = u.sum(1) > 1
    u[fold] = 1 - u[fold]
    away = torch.nn.functional.normalize(stream.uniform(count, 3) - 0.5, dim=-1)
    si = world.geometry.interact_at(triangle, u[:, 0], u[:, 1], away, torch.ones(count) > 0)
    return world, si


def light_at(si: SurfaceInteraction) -> torch.Tensor:
    """A made-up radiance: one part of the scene is far brighter than the rest."""
    bright = (si.p[:, :1] > 0.7) & (si.p[:, 1:2] > 0.7)
    return (0.05 + 4.0 * bright.float()).expand(-1, 3) * si.valid.unsqueeze(-1)


@pytest.mark.parametrize("known", ["random", "learned"])
def test_means_stay_and_noise_falls(known: str) -> None:
    """Two-sample z-tests of direct light and of light by the BSDF, for 24 lanes and a whole, 99 % over all (Sidak)."""
    world, si = lamp_lit(7, 24)
    corners = world.geometry.vertices.view(-1, 3)
    guide = Guide(torch.stack((corners.amin(0), corners.amax(0))), 4)
    if known == "random":
        guide.counts += 100.0
        guide.squares += 100.0 * (4.0 * Stream(8).uniform(*guide.squares.shape)).exp()
    else:
        _, other = lamp_lit(9, 60_000)
        surface = Surface(torch.full((len(other), 3), 0.6), torch.full((len(other), 1), 0.4))
        step = bounce(world, other, surface, Stream(10).uniform(len(other), DIMENSIONS), sample_stats=True)
        assert step.sample_stats is not None
        guide.record(*guide.bin_samples(other, step.sample_stats.wi, light_at(step.next)))
    guide.update()
    count = 30_000
    many = si.repeat(count)
    surface = Surface(torch.full((len(many), 3), 0.6), torch.full((len(many), 1), 0.4))
    found = []
    for use in (None, guide):
        world.guide = use
        step = bounce(world, many, surface, Stream(11).uniform(len(many), DIMENSIONS), sample_stats=True)
        assert step.sample_stats is not None
        light = step.weight * light_at(step.next)
        found.append([x.mean(-1).view(24, count).double() for x in (step.direct, light, step.sample_stats.deviation)])
    scores = []
    for plain, guided in zip(*found, strict=True):
        error = ((plain.var(1) + guided.var(1)) / count).sqrt().clamp_min(1e-12)
        scores.append((guided.mean(1) - plain.mean(1)) / error)
    z = torch.cat(scores)
    bound = norm.ppf(1 - 0.5 * (1 - 0.99 ** (1 / len(z))))
    assert float(z.abs().max()) < bound, z
    if known == "learned":
        plain, guided = (values[1].var(1) for values in found)
        noisy = plain > 1e-3  # lanes that look towards the bright part
        ratio = (guided[noisy] / plain[noisy]).median()
        assert float(ratio) < 0.7


def test_a_guide_that_saw_no_light_stays_even() -> None:
    guide = Guide(BOX, 4, 4)
    si, u = points(1000, 12), Stream(13).uniform(1000, 2)
    guide.record(*guide.bin_samples(si, cosine_hemisphere(u), torch.zeros(1000, 3)))
    guide.update()
    assert bool(torch.isfinite(guide.cdf).all())
    assert float((guide.density(guide.rows(si, si.n), cosine_hemisphere(u)) - 1.0).abs().max()) < 1e-4


@pytest.mark.parametrize(
    "method", [Radiometric(control_variate=False), PathTracing(4, control_variate=False), PRB(4), Direct()]
)
def test_a_guide_learns_in_a_fit_of_a_glossy_scene(method: Method) -> None:
    """With or without a control variate; direct light needs none, and neither does a Lambertian scene."""
    scene = resized(builtin.build("cornell"), 8, 2)
    images = photographs(replace(scene, max_depth=3), 2)
    module, _ = fit(glossy(scene), images, 3, method=method, sampling=Sampling(guide=4))
    if isinstance(method, Direct):
        assert module.assembly.world.guide is None
        return
    assert module.assembly.world.guide is not None
    assert float(module.assembly.world.guide.counts.sum()) > 100
    assert float(module.assembly.world.guide.squares.sum()) > 0
    assert fit(scene, images, 1, method=method)[0].assembly.world.guide is None
    # A checkpoint with another guide, or with none, is as good.
    for other in ({}, {"world.guide.counts": torch.zeros(3, 3)}):
        kept = {name: value for name, value in module.state_dict().items() if ".guide." not in name}
        checkpoint = {"state_dict": kept | other}
        module.on_save_checkpoint(checkpoint)
        module.on_load_checkpoint(checkpoint)
        assert checkpoint["state_dict"].keys() == module.state_dict().keys()
        assert checkpoint["state_dict"]["world.guide.counts"].shape == module.assembly.world.guide.counts.shape
