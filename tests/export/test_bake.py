"""What textures keep of fields: patterns as fine as texels, jumps on borders of charts, nothing that was not there."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.exported import GREY

from neurad.core.records import Surface
from neurad.core.scene_records import Mesh
from neurad.export import bake as baking
from neurad.export.bake import MAX_PER_BORDER_TEXEL, PER_BORDER_TEXEL, SETTLED, bake, refine
from neurad.export.base_colour import ANGLES, base_for, energy, over_angles
from neurad.export.charts import Chart, border_texels, find_charts, four_texels
from neurad.export.texel_means import Means, TexelMeans
from neurad.export.unwrap import unwrap
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry

SIDE = 32


class Field:
    """Materials by a function of the position in texels of the square below; counts what it was asked."""

    def __init__(self, of):
        self.of, self.asked = of, 0

    def __call__(self, si):
        self.asked += len(si.p)
        value = self.of(si.p[:, :2] * SIDE)[:, None]
        return Surface(value.expand(-1, 3), value)


def geometry_of(mesh):
    return Geometry(Scene("s", [mesh], [GREY]))


@pytest.fixture(scope="module")
def square():
    """A unit square with as many texels as :data:`SIDE` each way, and its geometry."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    points = np.pad(corners, ((0, 0), (0, 1)))
    mesh = Mesh("square", points, np.array([[0, 1, 2], [0, 2, 3]]), 0, uvs=corners)
    return Chart(mesh, find_charts(mesh), SIDE, SIDE, "own"), geometry_of(mesh)


def lookups(pixels, x, y):
    return sum(w * pixels[r.astype(int), c.astype(int), 3].astype(np.float64) for c, r, w in four_texels(x, y))


def error(chart, geometry, of):
    """Root mean square of what lookups inside the square are off the field."""
    pixels = bake(TexelMeans(chart, 0, geometry, Field(of))).pixels
    x, y = np.random.default_rng(0).uniform(4.0, SIDE - 4.0, (2, 20000))
    meant = of(torch.from_numpy(np.stack((x, y), 1))).numpy()
    return np.sqrt(np.square(lookups(pixels, x, y) - meant).mean())


@pytest.mark.parametrize(("period", "better"), [(4.0, 1.8), (8.0, 2.6)])
def test_stripes_as_fine_as_texels_keep_their_contrast(square, monkeypatch, period, better):
    """Lookups between box means alone show 0.73 of the contrast of stripes of four texels, 0.93 of eight."""

    def stripes(at):
        return 0.5 + 0.3 * torch.sin(2 * np.pi / period * (at @ torch.tensor([0.8, 0.6], dtype=at.dtype)))

    kept = error(*square, stripes)
    monkeypatch.setattr(baking, "GIVEN_BACK", 0.0)
    blurred = error(*square, stripes)
    assert kept * better < blurred


def test_no_texel_is_brighter_or_darker_than_the_field(square):
    """Also beside a jump, where what is given back would go beyond both sides."""
    found = bake(TexelMeans(square[0], 0, square[1], Field(lambda at: torch.where(at[:, 0] < 15.0, 0.2, 0.7)))).pixels
    assert found.min() == np.float16(0.2)
    assert found.max() == np.float16(0.7)


def test_a_jump_is_asked_until_its_share_is_known(square):
    """Texels that a slanted edge crosses have what lies on each side by its share; the others are asked no more."""
    chart, geometry = square
    field = Field(lambda at: torch.where(at @ torch.tensor([1.0, 0.37]) < 20.0, 0.1, 0.9))
    mesh = TexelMeans(chart, 0, geometry, field)
    means, exact = mesh.means(2), mesh.means(40).values
    field.asked = 0
    coarse = np.abs(means.values - exact).max()
    refine(mesh, means, means.covered.copy(), 2, PER_BORDER_TEXEL, MAX_PER_BORDER_TEXEL, SETTLED)
    assert coarse > 20 / 255
    off = np.abs(means.values - exact).max(-1)
    assert off.max() < 0.5 / 255, off.max() * 255  # also of corners between the positions of the first grids
    assert field.asked < 150 * SIDE**2  # all of them at 32 x 32 would be seven times as many
    assert field.asked > MAX_PER_BORDER_TEXEL**2 * SIDE / 2


def test_texels_on_borders_of_charts_stay_means(monkeypatch):
    """Both sides of a border show the mean over a footprint; inside charts texels are given back what lookups take."""
    pytest.importorskip("xatlas")
    import trimesh

    ball = trimesh.creation.icosphere(3, 0.45)
    mesh = Mesh("ball", np.asarray(ball.vertices, np.float32), np.asarray(ball.faces, np.int64), 0)
    chart = unwrap([mesh], np.array([200.0]), 1 << 18)[0]
    geometry, field = geometry_of(chart.mesh), Field(lambda at: 0.5 + 0.3 * torch.sin(at @ torch.tensor([2.0, 1.0])))
    given = bake(TexelMeans(chart, 0, geometry, field)).pixels
    monkeypatch.setattr(baking, "GIVEN_BACK", 0.0)
    plain = bake(TexelMeans(chart, 0, geometry, field))
    border, changed = border_texels(chart), (given != plain.pixels).any(-1)
    assert border.any()
    assert not changed[border].any()
    assert changed[plain.covered & ~border].mean() > 0.5


def test_sharpened_texels_move_away_from_covered_neighbours_within_the_range():
    """Texel by texel, in a texture of so many rows that threads share them."""
    random = np.random.default_rng(3)
    values = random.random((150, 7, 4), np.float32)
    covered, mask = random.random((2, 150, 7)) < 0.8
    least, most = np.full((2, 4), [[0.1], [0.9]], np.float32)
    expected = values.copy()
    for j, i in np.argwhere(mask):
        beside = ((j + 1, i), (j - 1, i), (j, i + 1), (j, i - 1))
        there = [values[y, x] for y, x in beside if 0 <= y < 150 and 0 <= x < 7 and covered[y, x]]
        moved = values[j, i] + baking.GIVEN_BACK * sum(values[j, i] - other for other in there)
        expected[j, i] = np.clip(moved, least, most)
    found = baking.sharpened(Means(values, covered, covered, values[..., 0], least, most), mask)
    assert np.abs(found - expected).max() < 1e-6


@pytest.mark.parametrize("side", [256, 1024])
def test_texels_in_which_little_happens_are_asked_once(square, side):
    """Means are as of every texel asked at 8 x 8 positions, within a step of 8 bits, for a fraction of the questions.
    Stripes as fine as texels are seen to be there: what a point in the middle says, which is anything, does not stay.
    """
    chart = replace(square[0], width=side, height=side)

    def waves(at):  # as long as the square; beyond 0.9 of it stripes of 1.08 texels
        x = at[:, 0] / SIDE
        stripes = 0.4 * torch.sin(2 * np.pi * 0.93 * side * x)
        return 0.5 + torch.where(x < 0.9, 0.3 * torch.sin(2 * np.pi * x), stripes)

    field = Field(waves)
    found = bake(TexelMeans(chart, 0, square[1], field)).pixels[4, :, 3].astype(np.float32)
    everywhere = (side * baking.positions(baking.AFFORDABLE, chart, baking.PER_TEXEL)) ** 2
    assert field.asked < 0.4 * everywhere
    means = TexelMeans(chart, 0, square[1], Field(waves)).means(8, np.arange(side)[:, None] * np.ones(side) < 8)
    exact = baking.sharpened(means, means.inside)[4, :, 3]
    smooth, fine = slice(4, int(0.89 * side)), slice(int(0.91 * side), -4)
    assert np.abs(found - exact)[smooth].max() < 1 / 255
    assert np.abs(found[fine] - 0.5).max() < 0.2  # points in the middle have 0.4


def test_what_only_finer_grids_meet_is_not_cut_off(square):
    """Lines that no texel's middle meets, on a ground whose neighbours differ, so that texels are asked more often."""
    side = 256
    chart = replace(square[0], width=side, height=side)

    def lines(at):
        x = at[:, 0] * side / SIDE
        on = ((x - 0.55) % 8.0) < 0.9
        return torch.where(on, 0.9, 0.3 + 0.03 * (x.floor() % 2))

    found = bake(TexelMeans(chart, 0, square[1], Field(lines))).pixels[8:-8, 8:-8, 3].astype(np.float32)
    means = TexelMeans(chart, 0, square[1], Field(lines)).means(4).values[8:-8, 8:-8, 3]
    assert abs(found.mean() - means.mean()) < 0.01, (found.mean(), means.mean())  # 0.315 against 0.388 if they were cut
    assert found.max() > means.max() - 0.01
    assert found.max() <= 0.9


# ---- base colours for other programs' models


@pytest.mark.parametrize(
    ("roughness", "blender", "gltf"),
    [(0.1, 1.061, 1.020), (0.2, 1.068, 1.032), (0.35, 1.071, 1.050), (0.5, 1.070, 1.065), (1.0, 1.083, 1.113)],
)
def test_factors_at_a_base_of_one_half(roughness, blender, gltf):
    """Against a quadrature made apart from this one."""
    base, rough = np.full((1, 3), 0.5, np.float32), np.full((1, 1), roughness, np.float32)
    assert base_for("blender", base, rough)[0, 0] / 0.5 == pytest.approx(blender, abs=1.5e-3)
    assert base_for("gltf", base, rough)[0, 0] / 0.5 == pytest.approx(gltf, abs=1.5e-3)
    assert base_for("exact", base, rough) is base


def test_energy_is_what_the_shaded_model_sends_back():
    """Against the mean of the weights of samples."""
    from neurad.bsdf.principled import Principled
    from neurad.core.records import Surface

    torch.manual_seed(0)
    n, roughness = 200_000, 0.5
    cosine = torch.rand(n).sqrt()
    wo = torch.stack(((1 - cosine * cosine).sqrt(), torch.zeros(n), cosine), -1)
    surface = Surface(torch.full((n, 3), 0.8), torch.full((n, 1), roughness))
    mean = float(Principled().sample(surface, wo, torch.rand(n, 3)).weight.mean())
    found = energy()
    at = int(roughness * 64)
    assert 0.8 * found.diffuse[at] + found.separable[at] == pytest.approx(mean, abs=3e-3)


def test_the_table_over_angles_leaves_the_mean_over_them_alone():
    """What Cycles sends back in all, its base colour times what the coat leaves and the coat, is all the same."""
    from neurad.bsdf.microfacet import fresnel_dielectric, reflectance

    table, found = over_angles(), energy()
    steps = (np.arange(ANGLES) + 0.5) / ANGLES
    for row in (8, 31, 60):
        alpha = steps[row] ** 2
        coat = reflectance(
            torch.from_numpy(steps), alpha, lambda c: fresnel_dielectric(c, 1.5)[:, None], correlated=True
        )
        coat = coat[:, 0].numpy()
        mean = base_for("blender", np.ones((1, 3), np.float32), np.full((1, 1), steps[row], np.float32))[0, 0]
        back = (2.0 * steps * (mean * table[row] * (1.0 - coat) + coat)).mean()
        expected = np.interp(steps[row], np.linspace(0, 1, 65), found.diffuse + found.separable)
        assert back == pytest.approx(expected, rel=2e-3)
    assert table[31, -1] < 1.0 < table[31, 8]  # head-on Cycles is too bright without it, at grazing angles too dark
