"""What pixels ask of the roughness: right in the mean with noisy derivatives, and sure of nothing that is noise."""

import itertools

import numpy as np
import pytest
import torch

from neurad.bsdf.microfacet import ggx_reflection
from neurad.core.protocols import PhotoSource
from neurad.core.records import PixelBatch
from neurad.evidence.metal import ALIKE, PRIOR, ROUGHNESS, SPLIT, MetalPixels, MetalTree, log_odds
from neurad.evidence.pixel_derivatives import batches_without_replacement
from neurad.evidence.pixel_means import PixelMeans
from neurad.evidence.roughness_evidence import asked_about, evidence, patches_of

SIDE, SEEN = 48, 6
CHANGE, PATCHES = 0.08, 128


def means(change=CHANGE, noise=0.25, steady=False, derivatives=True, grey=0.0, sheen=(1.0, 1.0, 1.0), seed=0):
    """Views of a square of a patch and more, seen with highlights at different places; the roughness is ``change``
    more than what was taken for it, the albedo of each patch another by chance. Of the photographs' noise a part is
    the same in all channels (``grey``), of the derivatives by roughness what ``sheen`` says is in each of them.
    """
    rng = np.random.default_rng(seed)
    row, column = np.divmod(np.arange(SIDE * SIDE), SIDE)
    p = np.stack((0.3 + 0.2 * column / SIDE, 0.3 + 0.2 * row / SIDE, np.full(SIDE * SIDE, 0.5001)), -1)
    patch = (p * PATCHES).astype(int)
    albedo = np.random.default_rng(7).normal(0.0, 0.05, (PATCHES, PATCHES, 3))[patch[:, 0], patch[:, 1]]
    parts = []
    for view in range(SEEN):
        d = 1.0 + 0.3 * np.sin(column / 9.0 + view)[:, None] * np.ones(3)
        centre = 0.0 if steady else 12.0 * np.cos(2.0 * view)
        r = 0.8 * np.exp(-((column - SIDE / 2 - centre) ** 2 + (row - SIDE / 2 + centre) ** 2) / 150.0)[:, None]
        r = (0.4 * d if steady else r * np.array(sheen)) * derivatives
        photograph = r * change + d * albedo + grey * rng.standard_normal((len(p), 1))
        r, d, e = (
            value + size * rng.standard_normal(d.shape) for value, size in ((r, noise), (d, 0.1), (photograph, 0.15))
        )
        corner = np.stack((column, row), -1)
        prim = np.zeros(len(p), np.int64)
        parts.append(
            [np.full(len(p), view), corner, p.astype(np.float32), prim, *(x.astype(np.float32) for x in (r, d, e))]
        )
    return PixelMeans(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def of_all(found):
    """The change that all patches together ask for, and its information."""
    one = np.zeros(len(found.slope), np.int64)
    (change,), (information,) = found.of_groups(one, 1).changes(one[:1])
    return change, information


def asked(found):
    return found.gradient.sum() / found.slope.sum()


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
    claimed = np.mean([1.0 / of_all(draw)[1] for draw in draws])
    assert 0.5 < scatter / claimed < 2.0, (scatter, claimed)


def test_nothing_is_known_of_a_steady_sheen_and_of_noise():
    _, known = of_all(of_patches(means()))
    assert of_all(of_patches(means(steady=True)))[1] < 0.05 * known
    assert of_all(of_patches(means(derivatives=False)))[1] < 0.1 * known


def test_noise_that_all_channels_share_costs_little_where_the_sheen_does_not():
    """Noise of light is grey in units of the brightness. A sheen ``s`` on a red wall is not, and keeps the part of its
    information that lies across grey, ``1 - (s . g)^2 / s^2`` with ``g`` of length 1: a sixth. So it is, and the change
    scatters no more than is claimed (its variance within a factor of two).
    """
    red = np.array((0.3, 1.0, 1.0))
    found = {grey: [of_patches(means(grey=grey, sheen=red, seed=k)) for k in range(20)] for grey in (0.0, 1.0)}
    slope = {grey: np.mean([draw.slope.sum() for draw in draws]) for grey, draws in found.items()}
    across = 1.0 - (red @ np.full(3, 3**-0.5)) ** 2 / (red @ red)
    assert slope[1.0] / slope[0.0] == pytest.approx(across, rel=0.2)
    change, information = np.transpose([of_all(draw) for draw in found[1.0]])
    assert 0.5 < change.var() * information.mean() < 2.0


def test_matt_paint_is_not_drawn_to_what_was_taken_for_it():
    """Of patches of six pixels a third have a slope below zero, by noise. All together ask for what is right, in the
    mean of 20 draws within four standard errors, and places of eight patches for four fifths of it; those above zero
    alone would ask for little more than half.
    """
    together, apart, above = [], [], []
    for k in range(20):
        draw = means(noise=0.5, sheen=(0.6, 0.6, 0.6), seed=k)
        patch, count = patches_of(draw.p.astype(np.float64), np.zeros(len(draw), np.int64), 400)
        found = evidence(draw, patch, count)
        positive = found.slope > 0.0
        assert positive.mean() < 0.75
        together.append(of_all(found)[0])
        cell = np.arange(count) // 8
        change, information = found.of_groups(cell, cell[-1] + 1).changes(np.zeros(cell[-1] + 1, np.int64))
        apart.append((change * information).sum() / information.sum())
        above.append(found.gradient[positive].sum() / found.slope[positive].sum())
    assert abs(np.mean(together) - CHANGE) < 4 * np.std(together) / np.sqrt(20) + 0.03 * CHANGE
    assert np.mean(apart) > 0.8 * CHANGE
    assert np.mean(above) < 0.65 * CHANGE


def ask(present, truth):
    """The change of roughness that the peak of GGX's highlight asks for, looked at with another roughness than it has;
    light and viewer stand upright.
    """
    upright = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    r = torch.tensor([present], dtype=torch.float64, requires_grad=True)
    peak, _, _ = ggx_reflection(upright, upright, r * r)
    true, _, _ = ggx_reflection(upright, upright, torch.tensor([truth], dtype=torch.float64) ** 2)
    (derivative,) = torch.autograd.grad(peak.sum(), r)
    return float((true - peak).detach() / derivative)


@pytest.mark.parametrize("present", [0.2, 0.5, 0.7])
@pytest.mark.parametrize("further", [0.05, 0.2, 0.3])
def test_matt_surfaces_are_found_from_glossier_ones(present, further):
    """What the peak of a highlight asks for leads to the truth, in a few steps without another look."""
    r0, change, known = np.array([present]), np.array([ask(present, present + further)]), np.ones(1)
    assert change[0] < 0.8 * further or further < 0.1
    target, _ = asked_about(r0, change, known, None)
    for _ in range(8):
        target, left = asked_about(r0, change, known, target)
    assert target[0] == pytest.approx(present + further, abs=1e-3)
    assert left[0] == pytest.approx((1.0 + further / present) ** -10, rel=0.01)


def test_from_there_to_glossier_ones_pixels_are_linear():
    r0, change, known = np.array([0.5, 0.5]), np.array([-0.2, 0.1]), np.array([3.0, 4.0])
    for value in (None, np.array([0.3, 0.4])):
        target, left = asked_about(r0, change, known, value)
        assert target == pytest.approx(r0 + change)
        assert left == pytest.approx(known)


def test_no_roughness_above_one_is_asked_about():
    target, known = asked_about(np.array([0.5]), np.array([0.2]), np.ones(1), np.array([3.0]))
    again, _ = asked_about(np.array([0.5]), np.array([0.2]), np.ones(1), np.array([1.0]))
    assert target == pytest.approx(again)
    assert np.isfinite(known).all()


def test_boxes_grow_where_a_part_of_the_pixels_is_drawn():
    """The change is right in the mean with a twentieth of the pixels, too, of which few have one beside them."""
    found = []
    for k in range(20):
        draw = means(seed=k)
        part = np.sort(np.random.default_rng(k).permutation(len(draw))[: len(draw) // 20])
        found.append(asked(of_patches(draw[part])))
    assert abs(np.mean(found) - CHANGE) < 4 * np.std(found) / np.sqrt(20) + 0.05 * CHANGE
    assert np.std(found) < CHANGE


def test_what_an_albedo_makes_of_noise_is_left_out():
    """Patches of one pixel each, whose derivative by the albedo has the wrong sign by noise: an albedo with it would
    add to what they know of the roughness, where one can but take from that. They say nothing.
    """
    draw = means()
    few = np.flatnonzero(draw.r[: SIDE * SIDE, 0] > 1.2)[:4]
    draw.p[few] += np.float32(0.4)
    draw.d[few] = -0.3
    found = of_patches(draw)
    patch, count = patches_of(draw.p.astype(np.float64), np.zeros(len(draw), np.int64), PATCHES)
    there = np.isin(np.arange(count), patch[few])
    assert there.any()
    assert not found.gradient[there].any()
    assert not found.slope[there].any()
    assert asked(found) == pytest.approx(CHANGE, rel=0.3)


# ---- whether surfaces are metals: what is right predicts views that were left out, and few views say little


VIEWS, PLACES, PIXELS = 8, 6, 4
RIGHT = 2  # index of the roughness that surfaces have


def surface(is_metal, color, views=VIEWS, seed=0, noise=0.1, texture=0.0):
    """Pixels of one group: each patch in each view, a few times.

    Diffuse light is the same in all views; what is mirrored is not, and a wrong roughness shows another place.
    """
    rng = np.random.default_rng(seed)
    patch, view = (x.ravel().repeat(PIXELS) for x in np.meshgrid(np.arange(PLACES), np.arange(views)))
    n, half = len(patch), len(ROUGHNESS)
    lit = rng.uniform(0.5, 2.0, PLACES)[patch]
    mirrored = rng.lognormal(-0.5, 1.0, (half, PLACES, views))[:, patch, view]
    a = np.concatenate((np.broadcast_to(lit, (half, n)), mirrored))
    b = np.concatenate((0.05 * mirrored, 0.05 * mirrored))
    base = np.clip(np.array(color) + texture * rng.normal(size=(PLACES, 1)), 0, 1)[patch]
    index = RIGHT + half * is_metal
    photograph = a[index][:, None] * base + b[index][:, None] + noise * rng.normal(size=(n, 3))
    a, e = np.repeat(a[..., None], 3, -1), photograph - b[..., None]
    a, e = (np.stack([x + 0.05 * rng.normal(size=x.shape) for _ in range(2)]).astype(np.float32) for x in (a, e))
    pixels = MetalPixels(view, np.zeros((n, 3), np.float32), np.zeros(n, np.int64), a, e)
    return pixels, patch


def odds(pixels, patch):
    return log_odds(pixels, np.zeros(len(pixels), np.int64), patch)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("texture", [0.0, 0.15])
def test_metals_are_told_from_paint(seed, texture):
    """Whatever the paint's colour, and whether or not it is the same all over."""
    for color in ((0.7, 0.5, 0.2), (0.8, 0.8, 0.8)):
        assert odds(*surface(True, color, seed=seed, texture=texture))[0] > 3.0
        assert odds(*surface(False, color, seed=seed, texture=texture))[0] < -3.0


@pytest.mark.parametrize("seed", range(5))
def test_a_dark_varnish_is_no_metal(seed):
    """It mirrors as a metal that reflects a twentieth would, which there is none of."""
    pixels, patch = surface(False, (0.0, 0.0, 0.0), seed=seed, noise=0.02)
    assert odds(pixels, patch)[0] < -3.0


def test_what_few_views_show_is_not_sure():
    """Views count, not pixels: the same views a hundred times say no more, two of them little, one nothing."""
    pixels, patch = surface(True, (0.7, 0.5, 0.2))
    many = MetalPixels(
        *(np.tile(x, (9, *[1] * (x.ndim - 1))) for x in (pixels.view, pixels.p, pixels.prim)),
        *(np.tile(x, (1, 1, 9, 1)) for x in (pixels.a, pixels.e)),
    )  # fmt: skip
    assert odds(many, np.tile(patch, 9))[0] == pytest.approx(odds(pixels, patch)[0], rel=0.15)
    few = [odds(*surface(True, (0.7, 0.5, 0.2), views=n)).get(0, 0.0) for n in (1, 2, VIEWS)]
    assert few[0] == 0.0
    assert few[1] < few[2] / 2


def test_groups_are_told_apart():
    parts = [surface(metal, (0.6, 0.6, 0.5), seed=k) for k, metal in enumerate((True, False, True))]
    joined = MetalPixels(
        *(np.concatenate([getattr(part, name) for part, _ in parts]) for name in ("view", "p", "prim")),
        *(np.concatenate([getattr(part, name) for part, _ in parts], 2) for name in ("a", "e")),
    )  # fmt: skip
    patch = np.concatenate([patch + 100 * k for k, (_, patch) in enumerate(parts)])
    found = log_odds(joined, np.repeat([7, 3, 5], len(parts[0][1])), patch)
    assert {group: value > 0 for group, value in found.items()} == {7: True, 3: False, 5: True}
    for k, group in enumerate((7, 3, 5)):
        assert found[group] == pytest.approx(odds(*parts[k])[0], rel=0.2)


@pytest.mark.parametrize("seed", range(5))
def test_a_few_pixels_are_not_sure(seed):
    """One in each of three views, which noise alone may predict well; the same surfaces as a whole are told apart."""
    wall, patch = surface(False, (0.5, 0.5, 0.5), seed=seed)
    few = np.flatnonzero((patch == 0) & (wall.view < 3))[::PIXELS]
    assert len(few) == 3
    part = MetalPixels(wall.view[few], wall.p[few], wall.prim[few], wall.a[:, :, few], wall.e[:, :, few])
    assert abs(odds(part, patch[few])[0]) < 3.0


def flat(*odds):
    """Meshes of one part of one region each."""
    one = np.arange(len(odds))
    return MetalTree((np.array(odds), np.zeros(len(odds)), np.zeros(len(odds))), one, one, np.ones_like(one))


def test_a_tree_of_groups_is_a_mixture_over_all_ways_to_prune_it():
    """Against a sum over all of them, at a given fraction of metals; another mesh is half of what is seen. Siblings are
    metal as balls of an urn are red to which one of the same colour is added after each draw.
    """
    odds = np.array([0.5, 0.0]), np.array([-0.7, 1.1, 0.2, 0.0]), np.array([-0.4, 2.5, 0.3, 1.5, -3.0, 0.0])
    part_of, pixels, fraction = np.array([0, 0, 1, 1, 2, 3]), np.array([1, 3, 2, 2, 2, 10]), 0.2
    tree = MetalTree(odds, np.array([0, 0, 0, 1]), part_of, pixels)

    def share(seen):
        return SPLIT + (1.0 - SPLIT) * seen / pixels.sum()

    def urn(kinds):
        red, probability = ALIKE * fraction, 1.0
        for n, kind in enumerate(kinds):
            probability *= (red if kind else ALIKE + n - red) / (ALIKE + n)
            red += kind
        return probability

    total, metal = 0.0, np.zeros(5)
    ways = [(1.0 - share(10), [[(0, 0)]], [(0, 0)] * 5)]  # probability, siblings, and the group that each region is in
    for split in itertools.product((False, True), repeat=3):
        each = [share(seen) if s else 1.0 - share(seen) for s, seen in zip(split, (4, 4, 2), strict=True)]
        group = [(2, i) if split[j] else (1, int(j)) for i, j in enumerate(part_of[:5])]
        siblings = [[(1, j) for j in range(3) if not split[j]]]
        siblings += [[(2, i) for i in range(5) if part_of[i] == j] for j in range(3) if split[j]]
        ways.append((share(10) * np.prod(each), siblings, group))
    for probability, siblings, group in ways:
        for kinds in itertools.product((False, True), repeat=len(set(group))):
            kind = dict(zip(sorted(set(group)), kinds, strict=True))
            says = [np.exp(odds[level][i]) for level, i in kind if kind[level, i]]
            says += [urn([kind[g] for g in of_one]) for of_one in siblings]
            total += probability * np.prod(says)
            metal += probability * np.prod(says) * np.array([kind[g] for g in group])
    np.testing.assert_allclose(tree._given(fraction)[1][:5], metal / total, rtol=1e-9)


@pytest.mark.parametrize("fraction", [0.0, 0.05, 0.3])
def test_the_room_tells_how_common_metal_is(fraction):
    """Log-odds that are right, of normal errors: of those called metal as many are none as is said, within three
    standard errors; where there is no metal at all, half as many as by a prior that is fixed at most.
    """
    rng, groups, spread = np.random.default_rng(1), 100, 4.0
    false, said, fixed = 0, 0.0, 0
    for _ in range(20):
        metal = rng.uniform(size=groups) < fraction
        odds = rng.normal(np.where(metal, 0.5, -0.5) * spread, spread**0.5)
        probability = flat(*odds).probabilities()[1]
        false += int((~metal & (probability > 0.5)).sum())
        said += float((1.0 - probability[probability > 0.5]).sum())
        fixed += int((~metal & (odds > np.log(PRIOR[1] / PRIOR[0]))).sum())
    assert false <= (said + 3.0 * said**0.5 if fraction else fixed / 2)


@pytest.mark.parametrize("groups", [1, 100])
def test_groups_that_say_nothing_leave_the_prior(groups):
    assert flat(*np.zeros(groups)).probabilities()[1] == pytest.approx(PRIOR[0] / sum(PRIOR), rel=1e-4)


# ---- training pixels taken in turn for a look at all of them


IMAGES, SIZE = 2, 60


class InTurn(PhotoSource):
    """Every pixel once in a round, seven at a time."""

    def batch(self, iteration):
        place = (7 * iteration + torch.arange(7)) % (IMAGES * SIZE)
        color = torch.ones(7, 3)
        return PixelBatch(place // SIZE, place % SIZE, color, torch.ones(7), 0)


def taken(mask, pixels):
    parts = list(batches_without_replacement(InTurn(), mask, 3, pixels))
    return torch.cat([part.view * SIZE + part.pixel for part in parts]) if parts else torch.zeros(0).long()


@pytest.mark.parametrize("pixels", [10, 40, 60, 1000])
def test_masked_pixels_are_not_counted(pixels):
    """Half of the pixels are left out: as many of the others are taken as were asked for, as long as there are some."""
    mask = torch.arange(SIZE).expand(IMAGES, -1) % 2 == 0
    found = taken(mask, pixels)
    assert not bool(mask.flatten()[found].any())
    assert len(found) == min(pixels, len(found))
    assert abs(len(found) - min(pixels, 60)) <= 4  # a round ends within a batch
    assert len(torch.unique(found)) >= len(found) - 4


def test_where_all_is_masked_nothing_is_waited_for():
    assert len(taken(torch.ones(IMAGES, SIZE, dtype=torch.bool), 10)) == 0
