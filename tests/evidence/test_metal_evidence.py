"""Whether surfaces are metals: what is right predicts views that were left out, and few views say little."""

import numpy as np
import pytest

from neurad.evidence.metal import ROUGHNESS, MetalPixels, log_odds

VIEWS, PATCHES, PIXELS = 8, 6, 4
RIGHT = 2  # index of the roughness that surfaces have


def surface(is_metal, color, views=VIEWS, seed=0, noise=0.1, texture=0.0):
    """Pixels of one group: each patch in each view, a few times.

    Diffuse light is the same in all views; what is mirrored is not, and a wrong roughness shows another place.
    """
    rng = np.random.default_rng(seed)
    patch, view = (x.ravel().repeat(PIXELS) for x in np.meshgrid(np.arange(PATCHES), np.arange(views)))
    n, half = len(patch), len(ROUGHNESS)
    lit = rng.uniform(0.5, 2.0, PATCHES)[patch]
    mirrored = rng.lognormal(-0.5, 1.0, (half, PATCHES, views))[:, patch, view]
    a = np.concatenate((np.broadcast_to(lit, (half, n)), mirrored))
    b = np.concatenate((0.05 * mirrored, 0.05 * mirrored))
    base = np.clip(np.array(color) + texture * rng.normal(size=(PATCHES, 1)), 0, 1)[patch]
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
