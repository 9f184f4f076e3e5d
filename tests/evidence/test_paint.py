"""Plain paint: what lies within its own error of its segment's colour is shown as that colour, the rest as it is."""

import numpy as np
import pytest
import torch
from scipy.stats import norm
from torch import nn

from neurad.evidence.paint import MIN_POINTS, find_paint
from neurad.fields.segments import Segments
from neurad.optim.polyak_average import PolyakAverage

POINTS = 4000
WHITE, BROWN = np.array([0.8, 0.78, 0.7]), np.array([0.4, 0.25, 0.15])


class _Parts:
    """Segments by numbers alone."""

    def __init__(self, count):
        self.count = count


def shown(paint, values, segment):
    segments = Segments(_Parts(len(paint)), 3)
    segments.paint.copy_(torch.from_numpy(paint))
    segments.shows_paint = True
    return segments.shown(torch.from_numpy(values), torch.from_numpy(segment)).numpy()


def surfaces(seed=3, error=0.02):
    """A wall, wood, a wall with a picture, and too few points of something: truth, what is found, and segments."""
    rng = np.random.default_rng(seed)
    wall = np.tile(WHITE, (POINTS, 1))
    wood = BROWN * np.exp(0.25 * rng.standard_normal((POINTS, 1)))
    picture = wall.copy()
    picture[:80] = rng.uniform(0.05, 0.5, (80, 3))
    few = np.tile(WHITE, (MIN_POINTS - 1, 1))
    truth = np.concatenate((wall, wood, picture, few)).astype(np.float32)
    segment = np.repeat(np.arange(4), [POINTS, POINTS, POINTS, len(few)])
    clouds = np.sin(0.01 * np.arange(len(truth)))[:, None] * error * 1.2  # of light that is known a little wrong
    return truth, (truth + clouds).astype(np.float32), segment


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def test_paint_comes_out_flat_and_wood_and_pictures_stay():
    truth, found, segment = surfaces()
    std = np.full_like(found, 0.02)
    paint = find_paint(found, std, segment, 5)
    after = shown(paint, found, segment)
    error = [rms((x - truth)[segment == 0]) for x in (found, after)]
    assert error[1] < 0.2 * error[0]
    assert paint[0, :3] == pytest.approx(WHITE, abs=0.005)
    assert rms((after - found)[segment == 1]) < 0.25 * rms((found - truth)[segment == 1])
    in_picture = np.flatnonzero(segment == 2)[:80]
    assert rms((after - found)[in_picture]) < 0.5 * rms((found - truth)[in_picture])
    assert rms((after - truth)[segment == 2]) < 0.3 * rms((found - truth)[segment == 2])
    assert np.array_equal(after[segment == 3], found[segment == 3])
    assert not paint[3:].any()


def test_what_is_known_exactly_is_not_flattened():
    truth, _, segment = surfaces()
    clouds = truth * (1.0 + 0.03 * np.sin(0.01 * np.arange(len(truth)))[:, None]).astype(np.float32)
    paint = find_paint(clouds, np.full_like(clouds, 0.002), segment, 4)
    assert rms((shown(paint, clouds, segment) - clouds)[segment == 0]) < 0.1 * rms((clouds - truth)[segment == 0])


@pytest.mark.parametrize("wide", [1.0, 3.0])
def test_bars_that_are_too_wide_keep_faint_texture(wide):
    """Grain of 0.03 beside walls whose error is 0.01 stays, however wide the bars are that speak of it."""
    rng = np.random.default_rng(5)
    walls = [WHITE + 0.01 * rng.standard_normal((POINTS, 3)) for _ in range(4)]
    grain = BROWN + 0.04 * rng.standard_normal((POINTS, 1)) + 0.01 * rng.standard_normal((POINTS, 3))
    found = np.concatenate((*walls, grain)).astype(np.float32)
    segment = np.repeat(np.arange(5), POINTS)
    after = shown(find_paint(found, np.full_like(found, 0.01 * wide), segment, 5), found, segment)
    assert rms((after - WHITE)[segment < 4]) < 0.4 * 0.01
    assert rms((after - found)[segment == 4]) < 0.35 * rms((found - BROWN)[segment == 4])


def test_one_colour_everywhere_is_paint():
    found = np.tile(WHITE, (POINTS, 1)).astype(np.float32)
    segment = np.zeros(POINTS, np.int64)
    after = shown(find_paint(found, np.full_like(found, 0.01), segment, 1), found, segment)
    assert np.allclose(after, found, atol=1e-6)


def test_what_is_shown_is_the_posterior_mean():
    center, variance, pi, texture = 0.6, 0.0004, 0.7, 0.01
    paint = np.array([[center] * 3 + [variance, pi, texture]], np.float32)
    values = np.linspace(0.3, 0.9, 41, dtype=np.float32)
    spike = pi * norm.pdf(values, center, np.sqrt(variance))
    slab = (1 - pi) * norm.pdf(values, center, np.sqrt(variance + texture))
    expected = center + slab / (spike + slab) * (values - center)
    grey = np.repeat(values[:, None], 3, 1)
    after = shown(paint, grey, np.zeros(len(grey), np.int64))
    assert np.allclose(after, expected[:, None], atol=1e-5)


def test_no_points_no_paint():
    assert not find_paint(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64), 3).any()


def test_paint_is_shown_with_the_averages_alone():
    segments = Segments(_Parts(1), 3)
    part = nn.ModuleList([segments])
    average = PolyakAverage(part, 0.5, every=1)
    average.update(1)
    with average.used(whole=True):
        assert not segments.shows_paint
    with average.used():
        assert segments.shows_paint
    assert not segments.shows_paint
    average.copy_to_module()
    assert segments.shows_paint
    with average.used():
        pass
    assert segments.shows_paint
