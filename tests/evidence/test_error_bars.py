"""Error bars at points: sums on a grid, their file, and derivatives of pixels against closed forms and differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.oracles import accept, z_test_samples
from helpers.small_step import SmallStep

from neurad.assembly.fitted_materials import FittedMaterials
from neurad.assembly.settings import Sampling
from neurad.core.errors import InputError
from neurad.core.parameters import ALBEDO, ROUGHNESS
from neurad.core.rng import Stream
from neurad.evidence import pixel_derivatives
from neurad.evidence.bars_file import read_bars, write_bars
from neurad.evidence.error_bars import COLUMNS, FLAT, ErrorBars, Nodes, measure, texture
from neurad.evidence.pixel_derivatives import PixelDerivatives
from neurad.evidence.random_effects import _Model, fit_effects
from neurad.evidence.roughness_evidence import asked_about
from neurad.fields.hierarchy import MIDDLE, Hierarchy, Places
from neurad.fields.material import MaterialField
from neurad.fields.settings import FieldConfig, GridConfig
from neurad.integrators.direct import Direct
from neurad.scene.textures import ConstantMaterials

RNG = np.random.default_rng(0)
STD, SPREAD = 0.14, 0.2


def test_nodes_keep_sums_and_read_linear_functions():
    x = RNG.random((500, 3))
    values = RNG.random((500, 2))
    nodes = Nodes.scattered(x, values, 8)
    assert np.allclose(nodes.values.sum(0), values.sum(0))
    corners = np.stack(np.meshgrid(*[np.arange(9) / 8] * 3, indexing="ij"), -1).reshape(-1, 3)
    linear = Nodes.scattered(corners, 1.0 + corners @ np.array([[1.0], [2.0], [3.0]]), 8)
    assert np.allclose(linear.read(x), 1.0 + x @ np.array([[1.0], [2.0], [3.0]]))
    assert (Nodes.scattered(x[:0], values[:0], 8).read(x) == 0).all()


class Painted:
    """Recovered materials in a cube of side 1 / ``size``: grey, or with vertical stripes where ``striped`` says so."""

    def __init__(self, size=1.0, striped=lambda p: torch.zeros(len(p), dtype=torch.bool), period=0.05):
        self.size, self.striped, self.period = size, striped, period

    def to_unit_cube(self, p):
        return self.size * p

    def std(self, p, prim=None, known=True):
        return {"roughness": torch.full((len(p), 1), STD if known else SPREAD)}

    def std_by_albedo(self, p, std, prim=None):
        return {}

    def albedo_at(self, p, prim=None):
        stripes = 0.3 * torch.sin(2.0 * np.pi / self.period * p[:, :1]).expand(-1, 3)
        return 0.5 + torch.where(self.striped(p)[:, None], stripes, torch.zeros(()))


def pixels(n=80_000, noise=0.1, detail=1e-4):
    """Pixels on a plane that all see D = 1 and no highlight."""
    p = np.concatenate((RNG.random((n, 2)), np.full((n, 1), 0.5)), 1).astype(np.float32)
    one = np.ones((n, 3), np.float32)
    misfit = (noise * RNG.standard_normal((n, 3))).astype(np.float32)
    both = np.stack([one, one])
    return PixelDerivatives(
        p=p, area=np.full(n, 5e-5, np.float32), odd=np.arange(n) % 2 == 0, residual=np.stack([misfit, misfit]),
        by={"albedo": both, "roughness": 0 * both}, misfit=misfit, predicted=one,
        albedo=(0.5 + 0.2 * RNG.standard_normal((n, 3))).astype(np.float32), detail=detail * one,
        points=p[:, None], prims=np.zeros((n, 1), np.int64),
    )  # fmt: skip


def test_bars_where_pixels_are_and_where_none_is():
    """On the plane the albedo's variance is the geometric mean of V and N = noise^2 / (pixels over a pixel's area);
    away from it the bars are the spread. Roughness has its field's."""
    given = pixels()
    bars = measure(given, Painted(), len(given), 7)
    x = np.concatenate((RNG.uniform(0.2, 0.8, (200, 2)), np.full((200, 1), 0.5)), 1)
    albedo, roughness = bars.at(Painted(), torch.from_numpy(x).float()).values()
    overlap = 80_000 * 5e-5  # pixels a unit of area, times their area
    expected = np.sqrt(np.sqrt(1e-4 * 0.01 / overlap))
    assert np.median(albedo) == pytest.approx(expected, rel=0.3)
    assert roughness == pytest.approx(STD)
    far_albedo, far_roughness = bars.at(Painted(), torch.tensor([[0.5, 0.5, 0.01]])).values()
    assert far_albedo[0] == pytest.approx(given.albedo.std(0), rel=1e-3)
    assert far_roughness[0, 0] == pytest.approx(STD)


def test_bars_of_albedo_are_wider_where_it_varies_and_as_wide_in_the_mean():
    """Stripes on half of each cell: bars there are wider, next to them narrower, and the mean variance is that of a
    cell of which nothing more is known."""

    def striped(p):
        return torch.floor(128.0 * p[:, 1]) % 2 == 0  # two to a cell

    given = pixels()
    bars = measure(given, Painted(striped=striped), len(given), 7)
    n = 4000
    p = torch.cat(
        (0.2 + 0.6 * torch.rand(n, 2, generator=torch.Generator().manual_seed(1)), torch.full((n, 1), 0.5)), 1
    )
    found = bars.at(Painted(striped=striped), p)["albedo"][:, 0]
    everywhere = measure(given, Painted(), len(given), 7).at(Painted(), p)["albedo"][:, 0]
    middle = (128.0 * p[:, 1]) % 1.0
    inside = ((middle > 0.3) & (middle < 0.7)).numpy()
    stripes = striped(p).numpy()
    whole, on, beside = (float(np.square(found[lanes]).mean()) for lanes in (..., inside & stripes, inside & ~stripes))
    assert whole == pytest.approx(np.square(everywhere).mean(), rel=0.1)
    assert on > 0.5 * whole  # the edges have the most
    assert beside < 0.1 * whole


class ByColor(Painted):
    """Roughness is read off from the albedo."""

    def std_by_albedo(self, p, std, prim=None):
        return {"roughness": 0.5 * std[:, :1]}


def test_what_is_read_off_from_the_albedo_is_as_unsure_as_that():
    given, p = pixels(noise=0.3), torch.tensor([[0.5, 0.5, 0.5]])
    found = measure(given, ByColor(), len(given), 7).at(ByColor(), p)
    assert found["albedo"].min() > 1e-3
    assert found["roughness"] == pytest.approx(np.hypot(STD, 0.5 * found["albedo"][:, :1]))


def test_a_field_that_follows_a_colour_has_its_deviation_times_the_slope():
    """Roughness 0.2 + 0.3 red - 0.1 blue: deviations of channels add up as squares."""
    bounds, config = torch.tensor([[0.0] * 3, [1.0] * 3]), FieldConfig(GridConfig(coarsest=1, finest=1), kind="dense")
    albedo, roughness = (MaterialField(parameter, config, bounds) for parameter in (ALBEDO, ROUGHNESS))
    roughness.hierarchy = Hierarchy("groups", CELLS)
    roughness.hierarchy.found = True
    roughness.at = lambda p, albedo, prim: 0.2 + 0.3 * albedo[:, :1] - 0.1 * albedo[:, 2:]
    materials = FittedMaterials({"albedo": albedo, "roughness": roughness})
    std = torch.tensor([[0.1, 0.2, 0.3], [0.0, 0.2, 0.0]])
    found = materials.std_by_albedo(torch.full((2, 3), 0.5), std)
    assert list(found) == ["roughness"]
    assert found["roughness"][:, 0].tolist() == pytest.approx([np.hypot(0.03, 0.03), 0.0], abs=1e-6)


class HalfKnown(Painted):
    """Roughness is known on the left, and not on the right."""

    def std(self, p, prim=None, known=True):
        return {"roughness": torch.where(p[:, :1] < 0.5, 0.05, STD)} if known else super().std(p, prim, known)


def test_how_much_is_determined_is_of_surfaces_and_not_of_pixels():
    """Nine of ten pixels look at the half of the plane whose roughness is known."""
    given, side = pixels(), RNG.random(80_000)
    left = given.p.copy()
    left[:, 0] = np.where(side < 0.9, 0.5 * left[:, 0], 0.5 + 0.5 * left[:, 0])
    bars = measure(replace(given, p=left), HalfKnown(), len(given), 7)
    assert bars.spreads == {"albedo": pytest.approx(0.2, rel=0.02), "roughness": pytest.approx(SPREAD)}
    assert bars.determined["roughness"] == pytest.approx(0.5, abs=0.03)
    assert bars.determined["albedo"] == 1.0
    share = bars.shares({"roughness": np.array([[STD], [0.0]], np.float32)})["roughness"]
    np.testing.assert_allclose(share, [[STD / SPREAD], [0.0]], rtol=1e-5)
    said = replace(bars, determined={"albedo": 1.0, "roughness": 0.31}).sentence
    assert said.startswith("Roughness is determined on 31 % of the surface that photographs show, albedo on 100 %: ")
    assert said.endswith("Elsewhere roughness is its group's mean.")
    assert replace(bars, determined={"albedo": 0.5}).sentence.startswith("Albedo is determined on 50 % of the surface")
    assert replace(bars, determined={}).sentence == ""


def test_texture_is_the_standard_deviation_within_half_a_pixel():
    """Of a ramp of slope k over tetrahedra whose corners lie at +- side / 4: k side / 4 times the root of 4 / 3."""
    side = np.array([0.1, 0.02, 0.0])
    found = texture(lambda p: 2.0 * p[:, :1].expand(-1, 2), torch.zeros(3, 3), side)
    assert found == pytest.approx(np.sqrt(4.0 / 3.0 * (0.5 * side[:, None]) ** 2 + FLAT**2).repeat(2, 1), rel=1e-4)


def test_bars_come_back_from_their_file(tmp_path):
    bars = measure(pixels(), Painted(), 8000, 7)
    write_bars(bars, tmp_path / "bars.npz")
    found = read_bars(tmp_path / "bars.npz")
    p = torch.from_numpy(RNG.random((50, 3))).float()
    assert (found.iteration, found.spreads, found.determined) == (7, bars.spreads, bars.determined)
    read, written = found.at(Painted(), p), bars.at(Painted(), p)
    assert all(np.allclose(read[name], written[name], rtol=1e-5) for name in ("albedo", "roughness"))
    with pytest.raises(InputError, match="neurad test writes them"):
        read_bars(tmp_path / "none.npz")
    (tmp_path / "bars.npz").write_bytes(b"PK not a file of arrays")
    with pytest.raises(InputError, match=r"bars\.npz: .*neurad test"):
        read_bars(tmp_path / "bars.npz")
    broken = ErrorBars(Nodes(4, np.array([3, 2]), np.zeros((2, COLUMNS))), 1.0, np.ones(3), 7)
    write_bars(broken, tmp_path / "order.npz")
    with pytest.raises(InputError, match="no file of error bars"):
        read_bars(tmp_path / "order.npz")


def step_of(albedo, roughness, method=None):
    made = SmallStep(Sampling(spp=4, cached_spp=4))
    materials = ConstantMaterials(albedo, roughness)
    estimator = replace(made.estimator, materials=materials, method=method or made.estimator.method)
    return made, estimator


def test_derivative_by_albedo_is_the_difference_of_images():
    """Light that a surface reflects is linear in its albedo: with the same random numbers differences are exact."""
    made, _ = step_of(0.5, 0.4)
    batch = made.batch(128, where=~made.emitter_mask)
    halves = []
    for albedo in (0.4, 0.5, 0.6):
        estimator = replace(step_of(albedo, 0.4, Direct())[1])
        halves.append(pixel_derivatives.group_of_samples(estimator, made.primary, batch, Stream(3)))
    difference = (halves[2].image - halves[0].image) / 0.2
    assert torch.allclose(difference, halves[1].by["albedo"], rtol=1e-3, atol=1e-4)
    assert halves[1].by["albedo"].abs().mean() > 0.01


def test_derivative_by_roughness_is_the_difference_of_mean_images():
    """Central differences of the mean image over pixels and independent seeds, a z-test at 99 %."""
    made, _ = step_of(0.5, 0.4)
    batch = made.batch(256, where=~made.emitter_mask)

    def rows(roughness, first, seeds=40):
        estimator = step_of(0.3, roughness, Direct())[1]
        found = [
            pixel_derivatives.group_of_samples(estimator, made.primary, batch, Stream(first, k)) for k in range(seeds)
        ]
        pairs = [(half.image, half.by["roughness"]) for half in found]
        return [torch.stack([x.mean() for x in column]) for column in zip(*pairs, strict=True)]

    h = 0.02
    low, high = rows(0.5 - h, 1)[0], rows(0.5 + h, 2)[0]
    derivative = rows(0.5, 3)[1]
    assert accept([float(z_test_samples(((high - low) / (2 * h)).double(), derivative.double()))])


# ---- random effects: the posterior in dense matrices, variances that photographs decide, and bars that hold


CELLS, PARTS = 16, 8


def room(n, seed=0):
    """Places on eight walls of one mesh, of four colours: each colour's walls share it."""
    rng = np.random.default_rng(seed)
    part = rng.integers(0, PARTS, n)
    x = rng.random((n, 3))
    x[:, 2] = (part + 0.5) / PARTS
    albedo = np.array([[0.8, 0.8, 0.8], [0.4, 0.2, 0.1], [0.1, 0.3, 0.6], [0.05, 0.05, 0.05]])[part // 2]
    albedo = np.clip(albedo + 0.01 * rng.standard_normal((n, 3)), 0.0, 1.0)
    x, albedo, part = torch.from_numpy(x).float(), torch.from_numpy(albedo).float(), torch.from_numpy(part)
    return Places(x, albedo, part, torch.zeros_like(part))


def found(places, target, information, structure="auto", seed=0):
    hierarchy = Hierarchy(structure, CELLS)
    hierarchy.set(fit_effects(hierarchy.effects, places, lambda _: (target - MIDDLE, information), seed))
    return hierarchy


def test_the_mean_is_the_posterior_of_dense_matrices():
    rng, places = np.random.default_rng(0), room(60)
    weight = rng.gamma(1.0, 50.0, 60)
    weight[5:10] = 0.0
    target = rng.random(60)
    model = _Model(Hierarchy("auto", CELLS).effects, places, weight)
    model.scale()
    rows = model._rows.toarray() * model.std
    right = rows.T @ (weight * target)
    expected = np.linalg.solve(rows.T @ (weight[:, None] * rows) + np.eye(model.count), right)
    np.testing.assert_allclose(rows @ model.solved(model.data(target)), rows @ expected, atol=4e-3)  # TOLERANCE


def test_flat_paint_comes_out_flat_and_a_worn_floor_worn():
    """Eight walls of four paints, one of them worn in waves. Single places are known to 0.1 only."""
    places, rng = room(6000), np.random.default_rng(1)
    part, x = places.part.numpy(), places.x.numpy()
    waves = 0.15 * np.sin(2.0 * np.pi * x[:, 0]) * (part == 3)
    truth = np.array([0.6, 0.3, 0.45, 0.2])[part // 2] + waves
    hierarchy = found(places, truth + 0.1 * rng.standard_normal(6000), np.full(6000, 100.0))
    value = hierarchy(places)[:, 0].numpy()
    for index in range(PARTS):
        wall = part == index
        error = value[wall] - truth[wall]
        assert np.sqrt(np.square(error).mean()) < (0.04 if index == 3 else 0.02)
        if index != 3:
            assert value[wall].std() < 0.015


def test_matt_walls_come_out_matt():
    """Looked at with 0.5, walls of 0.9 ask for 0.61; the rest of the way no second look is needed for."""
    places, rng = room(4000), np.random.default_rng(6)
    part = places.part.numpy()
    truth = np.array([0.9, 0.3, 0.75, 0.5])[part // 2]
    present = np.full(4000, 0.5)
    change = np.where(truth > present, 0.25 * present * (1.0 - (truth / present) ** -4), truth - present)
    change += 0.05 * rng.standard_normal(4000)

    def asked(values):
        target, known = asked_about(present, change, np.full(4000, 400.0), None if values is None else values + MIDDLE)
        return target - MIDDLE, known

    hierarchy = Hierarchy("auto", CELLS)
    hierarchy.set(fit_effects(hierarchy.effects, places, asked))
    off = np.abs(hierarchy(places)[:, 0].numpy() - truth)
    assert off[truth == 0.9].mean() < 0.06
    assert off[truth < 0.9].mean() < 0.02


@pytest.mark.parametrize("shared", ["colour", "mesh"])
def test_what_walls_share_goes_to_where_no_highlight_is_seen(shared):
    """Twenty paints, or meshes, of four walls each, of which three tell their roughness."""
    rng = np.random.default_rng(4)
    part, x = rng.integers(0, 80, 3000), torch.from_numpy(rng.random((3000, 3))).float()
    truth, told = rng.uniform(0.1, 0.9, 20)[part // 4], part % 4 < 3
    target, information = truth + 0.05 * rng.standard_normal(3000), np.where(told, 400.0, 0.0)

    def unseen(color, mesh):
        albedo = torch.from_numpy(color).float()
        places = Places(x, albedo, torch.from_numpy(part), torch.from_numpy(mesh))
        hierarchy = found(places, target, information)
        off, std = hierarchy(places)[:, 0].numpy() - truth, hierarchy.std(places)[:, 0].numpy()
        return np.sqrt(np.square(off)[~told].mean()), std[~told].mean()

    walls, paints = rng.uniform(0.1, 0.9, (80, 3)), rng.uniform(0.1, 0.9, (20, 3))
    same = np.zeros_like(part)
    assert min(unseen(walls[part], same)) > 0.1
    assert max(unseen(*((paints[part // 4], same) if shared == "colour" else (walls[part], part // 4)))) < 0.05


def test_bars_hold_where_the_model_does():
    """Rooms drawn from the model itself, places varying below the finest grid as much as on it: 90 % intervals cover 82
    to 97 % of places, 50 % ones 40 to 65 %.
    """
    inside = {0.674: [], 1.645: []}
    for seed in range(6):
        rng, places = np.random.default_rng(10 + seed), room(3000, seed)
        hierarchy = Hierarchy("auto", CELLS)
        model = _Model(hierarchy.effects, places, np.ones(3000))
        model.stds = np.array([0.3, 0.05, 0.15, 0.05, 0.02, 0.05, 0.05, 0.04, 0.04, 0.03])
        model.scale()
        truth = MIDDLE + model.values(rng.standard_normal(model.count)) + model.stds[-1] * rng.standard_normal(3000)
        information = rng.gamma(0.3, 300.0, 3000)
        target = truth + rng.standard_normal(3000) / np.sqrt(np.maximum(information, 1e-9))
        result = found(places, target, information, seed=seed)
        off = (result(places) - torch.from_numpy(truth)[:, None]).abs() / result.std(places)
        for limit, rates in inside.items():
            rates.append(float((off < limit).double().mean()))
    assert 0.40 < np.mean(inside[0.674]) < 0.65
    assert 0.82 < np.mean(inside[1.645]) < 0.97


@pytest.mark.parametrize("information", [0.0, 1e-9])
def test_nothing_known_is_said(information):
    places = room(200)
    hierarchy = found(places, np.full(200, 0.9), np.full(200, information))
    assert bool(hierarchy(places).isfinite().all())
    assert float(hierarchy.std(places).min()) > 0.05


def test_one_wild_place_does_not_move_a_wall():
    """Student's t: a place that is sure of a wrong value counts for little."""
    places, rng = room(2000), np.random.default_rng(3)
    truth = np.array([0.6, 0.3, 0.45, 0.2])[places.part.numpy() // 2]
    target, information = truth + 0.05 * rng.standard_normal(2000), np.full(2000, 400.0)
    target[0], information[0] = 5.0, 1e6
    value = found(places, target, information, "groups")(places)[:, 0].numpy()
    assert np.abs(value - truth)[1:].max() < 0.1
