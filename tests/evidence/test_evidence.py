"""What pixels ask of the roughness: right in the mean with noisy derivatives, and sure of nothing that is noise."""

import numpy as np
import pytest
from helpers.highlight_pixels import CHANGE, PATCHES, SIDE, means

from neurad.evidence.roughness_evidence import evidence, patches_of


def asked(found):
    return found.gradient.sum() / found.information.sum()


def of_patches(pixels):
    patch, count = patches_of(pixels.p.astype(np.float64), np.zeros(len(pixels), np.int64), PATCHES)
    return evidence(pixels, patch, count)


def test_the_change_is_right_where_derivatives_are_noisy():
    """Over 20 draws within four standard errors, while least squares with the noisy derivatives is drawn to zero."""
    draws = [means(seed=k) for k in range(20)]
    found = np.array([asked(of_patches(draw)) for draw in draws])
    assert abs(found.mean() - CHANGE) < 4 * found.std() / np.sqrt(20) + 0.03 * CHANGE
    assert found.std() < 0.3 * CHANGE
    naive = np.mean([(draw.r * draw.e).sum() / np.square(draw.r).sum() for draw in draws])
    assert abs(naive) < 0.5 * CHANGE


def test_how_sure_it_is():
    """One over the information of all patches is the variance over 30 draws, within a factor of two: a smooth
    instrument has a part of its noise in common with its neighbours'."""
    draws = [of_patches(means(seed=k)) for k in range(30)]
    scatter = np.var([asked(draw) for draw in draws])
    claimed = np.mean([1.0 / draw.information.sum() for draw in draws])
    assert 0.5 < scatter / claimed < 2.0, (scatter, claimed)


def test_nothing_is_known_of_a_steady_sheen_and_of_noise():
    known = of_patches(means()).information.sum()
    assert of_patches(means(steady=True)).information.sum() < 0.05 * known
    assert of_patches(means(derivatives=False)).information.sum() < 0.1 * known


def test_noise_that_all_channels_share_costs_little_where_the_sheen_does_not():
    """Noise of light is grey in units of the brightness. A sheen ``s`` on a red wall is not, and keeps the part of its
    information that lies across grey, ``1 - (s . g)^2 / s^2`` with ``g`` of length 1: a sixth. So it is, and the change
    scatters no more than is claimed (its variance within a factor of two).
    """
    red = np.array((0.3, 1.0, 1.0))
    found = {grey: [of_patches(means(grey=grey, sheen=red, seed=k)) for k in range(20)] for grey in (0.0, 1.0)}
    claimed = {grey: np.mean([draw.information.sum() for draw in draws]) for grey, draws in found.items()}
    across = 1.0 - (red @ np.full(3, 3**-0.5)) ** 2 / (red @ red)
    assert claimed[1.0] / claimed[0.0] == pytest.approx(across, rel=0.2)
    assert np.var([asked(draw) for draw in found[1.0]]) * claimed[1.0] < 2.0


def test_boxes_grow_where_a_part_of_the_pixels_is_drawn():
    """The change is right in the mean with a twentieth of the pixels, too, of which few have one beside them."""
    found = []
    for k in range(20):
        draw = means(seed=k)
        part = np.sort(np.random.default_rng(k).permutation(len(draw))[: len(draw) // 20])
        found.append(asked(of_patches(draw[part])))
    assert abs(np.mean(found) - CHANGE) < 4 * np.std(found) / np.sqrt(20) + 0.05 * CHANGE
    assert np.std(found) < CHANGE


def test_patches_that_ask_for_the_impossible_are_left_out():
    """Four pixels in a patch of their own, whose neighbours have a highlight that they lack: what little they know of
    the roughness is noise, and what is left of their residuals asks for changes of tens.
    """
    draw = means()
    few = np.flatnonzero(draw.r[: SIDE * SIDE, 0] > 1.2)[:4]
    for values, change in ((draw.p, 0.4), (draw.e, 5.0)):
        values[few] += np.float32(change)
    draw.r[few] = 0.01 * np.sign(draw.r[few])
    found = of_patches(draw)
    patch, count = patches_of(draw.p.astype(np.float64), np.zeros(len(draw), np.int64), PATCHES)
    there = np.isin(np.arange(count), patch[few])
    assert there.any()
    assert not found.gradient[there].any()
    assert not found.information[there].any()
    assert asked(found) == pytest.approx(CHANGE, rel=0.3)
