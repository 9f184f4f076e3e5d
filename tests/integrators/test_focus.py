"""Pixels drawn by score: means stay, noise falls, and a batch without candidates stays as it is."""

from dataclasses import replace

import numpy as np
import torch
from helpers.oracles import accept, z_test_samples
from helpers.small_step import SIZE, SmallStep
from scipy.stats import norm

from neurad.assembly.settings import Sampling
from neurad.core.records import PixelBatch
from neurad.core.rng import Stream
from neurad.core.scene_records import Camera
from neurad.integrators.focus import REFRESH, TIMES, PixelImportance

FRACTION = 0.5
SIZES = (40, 24), (17, 9)


def cameras():
    pose = np.eye(4, dtype=np.float32)
    return [Camera(pose, 1.0, width, height) for width, height in SIZES]


def uneven(made: PixelImportance, seed: int = 3) -> PixelImportance:
    """Scores from 0.01 to 100 at random."""
    made.score.copy_(10.0 ** (4.0 * Stream(seed).uniform(len(made.score)) - 2.0))
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


def test_without_candidates_nothing_changes():
    batch = replace(drawn(0), candidates=0)
    assert PixelImportance(cameras(), FRACTION).choose(batch, Stream(1)) is batch
