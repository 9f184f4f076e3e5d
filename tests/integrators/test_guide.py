"""What is drawn where it matters: guided directions, of which the histogram draws what it says, and pixels by score.
Both leave every mean alone and take noise away."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.oracles import accept, z_test_samples
from helpers.small_step import SIZE, SmallStep
from helpers.trainer_fit import fit
from scipy.stats import chisquare, norm

from benchmarks.stress.fit import glossy, photographs, resized
from neurad.assembly.build import build_world
from neurad.assembly.settings import Sampling
from neurad.bsdf.principled import Principled
from neurad.core.records import PixelBatch, Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.core.sampling import cosine_hemisphere
from neurad.core.scene_records import Camera
from neurad.integrators.bounce import bounce
from neurad.integrators.direct import Direct
from neurad.integrators.focus import REFRESH, TIMES, PixelImportance
from neurad.integrators.guide import FACINGS, Guide, Guided
from neurad.integrators.method import Method
from neurad.integrators.path import PathTracing
from neurad.integrators.prb import PRB
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.vertex import DIMENSIONS
from neurad.scene import builtin

# ---- directions


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


def test_compiled_records_equal_plain_torch() -> None:
    """Compiled lookups are part of compiled bounces, see test_vertex_kernels.py."""
    guide, reference = trained_guide(), trained_guide(use_kernels=False)
    si, light = points(20_000, 4), torch.rand(20_000, 3)
    far = SurfaceInteraction(**{**si.__dict__, "p": si.p * 3.0 - 4.0})  # outside the box, the nearest cell counts
    wi = cosine_hemisphere(Stream(5).uniform(20_000, 2))
    for lanes in (si, far):
        rows = guide.rows(lanes, lanes.n)
        assert torch.equal(rows, reference.rows(lanes, lanes.n))
        assert int(rows.min()) >= 0
        assert int(rows.max()) < len(guide.counts)
        (places, values), (expected, same) = (g.bin_samples(lanes, wi, light) for g in (guide, reference))
        assert int((places != expected).sum()) < 10  # on the edge of a bin either is right
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


# ---- pixels


FRACTION = 0.5
SIZES = (40, 24), (17, 9)


def cameras():
    pose = np.eye(4, dtype=np.float32)
    return [Camera(pose, 1.0, width, height) for width, height in SIZES]


def uneven(made: PixelImportance) -> PixelImportance:
    """Scores from 0.01 to 100 at random."""
    made.score.copy_(10.0 ** (4.0 * Stream(3).uniform(len(made.score)) - 2.0))
    made.score.div_(made.score.mean())
    return made


def drawn(iteration: int, in_turn: int = 16, focused: int = 16) -> PixelBatch:
    """Uniform pixels of the larger view, the last ones of them candidates."""
    count = in_turn + TIMES * focused
    pixel = Stream(7, iteration).integers(SIZES[0][0] * SIZES[0][1], count)
    view = torch.zeros_like(pixel)
    return PixelBatch(view, pixel, torch.rand(count, 3), torch.ones(count), iteration, candidates=TIMES * focused)


def test_blocks_are_those_of_each_view_and_larger_in_large_photographs():
    made = PixelImportance(cameras(), FRACTION)
    view = torch.tensor([0, 0, 0, 0, 1, 1, 1])
    x, y = torch.tensor([0, 7, 8, 39, 0, 16, 16]), torch.tensor([0, 7, 0, 23, 0, 0, 8])
    width = torch.tensor([SIZES[0][0]] * 4 + [SIZES[1][0]] * 3)
    assert made.blocks(view, y * width + x).tolist() == [0, 0, 1, 14, 15, 17, 20]
    assert len(made.score) == 21

    wide = [Camera(np.eye(4, dtype=np.float32), 1.0, 4000, 3000)] * 20
    made = PixelImportance(wide, FRACTION)
    assert len(made.score) <= 1 << 18
    last = made.blocks(torch.tensor([19]), torch.tensor([4000 * 3000 - 1]))
    assert int(last) == len(made.score) - 1


def test_means_over_chosen_pixels_are_those_of_all():
    """Mean of a fixed quantity of pixels, of which most lies in few: a z-test at 99 %."""
    made = uneven(PixelImportance(cameras(), FRACTION))
    pixels = SIZES[0][0] * SIZES[0][1]
    quantity = 10.0 ** (3.0 * Stream(5).uniform(pixels).double() - 2.0)
    found = []
    for i in range(4000):
        batch = made.choose(drawn(i), Stream(8, i))
        assert batch.candidates == 0
        assert len(batch.view) == 32
        found.append((batch.weight.double() * quantity[batch.pixel]).mean())
    means = torch.stack(found)
    z = float((means.mean() - quantity.mean()) / (means.std() / len(means) ** 0.5))
    assert accept([2.0 * norm.sf(abs(z))]), z


def test_no_weight_is_large():
    made = uneven(PixelImportance(cameras(), FRACTION))
    for i in range(50):
        before = drawn(i)
        batch = made.choose(before, Stream(8, i))
        among = float(made.score[made.blocks(before.view[16:], before.pixel[16:])].mean())
        assert float(batch.weight.max()) <= max(1.0, among) / (1.0 - FRACTION) + 1e-6
        assert float(batch.highlight.min()) >= 0.0
        assert float(batch.highlight.max()) < 1.0


def test_scores_follow_the_gradients_and_take_noise_away():
    """What lies in one block of pixels is found with less than a third of the variance, and the scores say where."""
    made, pixels = PixelImportance(cameras(), FRACTION), SIZES[0][0] * SIZES[0][1]
    view, pixel = torch.zeros(pixels, dtype=torch.int64), torch.arange(pixels)
    size = torch.where(made.blocks(view, pixel) == 6, 50.0, 0.5)

    def estimates(count: int) -> torch.Tensor:
        rows = []
        for i in range(count):
            batch = made.choose(drawn(i), Stream(9, i))
            rows.append((batch.weight * size[batch.pixel]).mean())
            gradient = (batch.weight * size[batch.pixel] / len(batch.view)).view(-1, 1).repeat_interleave(2, 0) / 2
            made.record(*made.rows(batch, gradient))
            if (i + 1) % REFRESH == 0:
                made.update()
        return torch.stack(rows)

    before = estimates(REFRESH)
    made.sums.zero_()
    estimates(4 * REFRESH)
    after = estimates(REFRESH)
    assert int(made.score.argmax()) == 6
    assert float(after.var()) < float(before.var()) / 3.0


def test_gradients_are_undone_of_their_weights():
    """A pixel's recorded size is that of its own gradient, whatever it counted for."""
    made = PixelImportance(cameras(), FRACTION)
    batch = replace(drawn(0), candidates=0)
    weight = 0.1 + Stream(4).uniform(len(batch.view))
    plain = Stream(5).uniform(len(batch.view), 3)
    blocks, values = made.rows(replace(batch, weight=weight), (plain * weight.unsqueeze(-1)).view(-1, 1))
    again, unweighted = made.rows(batch, plain.view(-1, 1))
    assert torch.equal(blocks, again)
    torch.testing.assert_close(values, unweighted)


def test_the_step_s_gradient_keeps_its_mean():
    """Photometric gradients of focused batches against those of uniform ones, projected on a mean gradient of other
    seeds: z-tests at 99 %.
    """
    made = SmallStep(Sampling(spp=8, samples_per_vertex=1, cached_spp=8))
    focus = PixelImportance([view.camera for view in made.scene.train], FRACTION)
    focus.score.copy_(4.0 * Stream(6).uniform(len(focus.score)) ** 2)
    focus.score.div_(focus.score.mean())
    views, cut = len(made.scene.train), SIZE * SIZE
    photographs = Stream(11).uniform(views * cut, 3)

    def gradients(seeds: range, focused: bool) -> dict[str, torch.Tensor]:
        candidates, rows = (TIMES * 16 if focused else 0), []
        for seed in seeds:
            index = Stream(12, seed, focused).integers(views * cut, 16 + (candidates or 16))
            ones, colours = torch.ones(len(index)), photographs[index]
            batch = PixelBatch(index // cut, index % cut, colours, ones, 0, candidates=candidates)
            terms = made.step(focus.choose(batch, Stream(13, seed)), Stream(14, seed)).materials
            rows.append(made.gradients(terms["photometric"][1].surrogate))
        return {name: torch.stack([row[name] for row in rows]).double() for name in ("albedo", "roughness")}

    other, plain, focused = (
        gradients(range(a, b), f) for a, b, f in ((900, 930, False), (0, 120, False), (0, 120, True))
    )
    along = {name: torch.nn.functional.normalize(x.mean(0), dim=0) for name, x in other.items()}
    assert accept([float(z_test_samples(plain[name] @ a, focused[name] @ a)) for name, a in along.items()])
