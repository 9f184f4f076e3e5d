"""The ladder up to the best possible: each part against a closed form or a dense solution."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from helpers.tiny_fit import fails, few_views, fit, write_tiny_config
from scipy.sparse import csr_array

from benchmarks.bench.bound import gap, sentence
from benchmarks.bound import ladder
from benchmarks.bound.cells import COARSEST, FINEST, CellMaterials, SurfaceCells, _unpack, encode
from benchmarks.bound.ladder import Rung
from benchmarks.bound.photographs import Predicted, noise_covariance, photo_noise, predict
from benchmarks.bound.recovery import Prior, Recovery, Response
from neurad.assembly.build import build_world
from neurad.cli import main
from neurad.core.records import SurfaceInteraction
from neurad.integrators.estimator import Estimator
from neurad.integrators.primary_hits import PrimaryHits
from neurad.scene.builtin import build_furnace
from neurad.scene.textures import ConstantMaterials

LOW, SIZE = np.zeros(3, np.float32), 1.0


def on_plane(x, y, up=True):
    """Points (x, y, 0.3) that are seen from above or below."""
    n = len(x)
    p = torch.tensor(np.stack((x, y, np.full(n, 0.3)), -1), dtype=torch.float32)
    normal = torch.tensor([[0.0, 0.0, 1.0]]).expand(n, 3)
    wo = normal if up else -normal
    zero = torch.zeros(n, 2)
    return SurfaceInteraction(p, normal, normal, wo, zero, zero, torch.zeros(n, dtype=torch.int64), torch.ones(n) > 0)


def lattice(power):
    """Cells of level ``power`` on the plane, all of them, and the middles of their squares [n]."""
    (x, y), finer = grid(power), grid(power + 1)
    codes = np.unique(encode(on_plane(*finer), LOW, SIZE))  # four in a cell, too many for the pixels
    return SurfaceCells.of(LOW, SIZE, codes, round(len(x) / 2.0) + 1), x, y


def grid(power):
    middle = (np.arange(1 << power) + 0.5) / (1 << power)
    return [a.ravel() for a in np.meshgrid(middle, middle, indexing="ij")]


# ---- cells


def test_what_is_linear_above_is_linear_below():
    """A plane full of cells: away from its edge the interpolation of a linear function is that function."""
    cells, *_ = lattice(FINEST - 6)
    assert cells.counts == [4 ** (COARSEST + i) for i in range(len(cells.counts))]
    for index, (above, here) in enumerate(pairwise(cells.codes)):
        powers = COARSEST + index, COARSEST + index + 1
        x, y = (_unpack(codes, power)[1][:, :2].T for codes, power in zip((above, here), powers, strict=True))
        values = ((np.array(x) + 0.5) / (1 << powers[0])).T.astype(np.float32)
        expected = ((np.array(y) + 0.5) / (1 << powers[1])).T
        inside = ((expected > 0.5 / (1 << powers[0])) & (expected < 1 - 0.5 / (1 << powers[0]))).all(-1)
        np.testing.assert_allclose((cells.parents[index] @ values)[inside], expected[inside], atol=1e-5)


def test_materials_of_cells_are_those_of_the_finest_or_the_mean():
    cells, x, y = lattice(5)
    details = np.random.default_rng(9).normal(0, 0.1, (sum(cells.counts), 4)).astype(np.float32)
    mean = np.array([0.5, 0.4, 0.3, 0.2], np.float32)
    materials = CellMaterials(cells, details, mean)
    found = materials(on_plane(x, y))
    places = cells.find(encode(on_plane(x, y), LOW, SIZE))
    np.testing.assert_allclose(found.albedo, (details[places] + mean)[:, :3], rtol=1e-6)
    np.testing.assert_allclose(found.roughness, (details[places] + mean)[:, 3:], rtol=1e-6)
    below = materials(on_plane(x[:1], y[:1], up=False))
    np.testing.assert_allclose(torch.cat((below.albedo, below.roughness), -1)[0], mean)


# ---- the estimate


def single(response, sigma, n, spread, local=1.0):
    """``n`` pixels of one finest cell, details on the finest level alone, of these standard deviations [4]."""
    code = encode(on_plane(np.array([0.4]), np.array([0.4])), LOW, SIZE)
    cells = SurfaceCells.of(LOW, SIZE, code, 2)
    levels = len(cells.codes)
    bases = [np.zeros((4, 4), np.float32)] * (levels - 1) + [np.diag(spread).astype(np.float32)]
    prior = Prior(np.zeros(4, np.float32), tuple(bases), tuple(np.full((1, 4), local, np.float32) for _ in bases))
    footprint = csr_array(np.ones((n, 1), np.float32))
    return Recovery(cells, prior, footprint, response, np.full((n, sigma[1]), sigma[0], np.float32))


def test_one_cell_is_the_mean_of_its_pixels_drawn_to_the_prior():
    n, sigma, spread = 50, 0.3, np.array([0.1, 0.2, 0.4, 0.05])
    y = np.random.default_rng(1).normal(0.5, sigma, (n, 4)).astype(np.float32)
    for local in (1.0, 3.0):
        power = (local * spread) ** 2
        found = single(Response.direct(n), (sigma, 4), n, spread, local)(y)[-1]
        np.testing.assert_allclose(found, y.mean(0) * power / (power + sigma**2 / n), rtol=1e-3)


def test_a_steady_sheen_is_not_known_and_a_moving_highlight_is():
    """Answers to roughness that go with those to albedo tell nothing of it; with varying ones Fisher's information of
    the roughness is its Schur complement."""
    n, sigma, tau = 400, 0.1, 0.5
    rng = np.random.default_rng(2)
    truth = np.array([0.1, 0.2, 0.3, 0.6], np.float32)
    highlight = np.repeat(rng.normal(0, 1, (n, 1)), 3, 1).astype(np.float32)
    for by_roughness in (np.full((n, 3), 0.5, np.float32), highlight):
        response = Response.of(np.ones((n, 3), np.float32), by_roughness)
        recovery = single(response, (sigma, 3), n, np.full(4, tau))
        exact = response(np.tile(truth, (n, 1)))
        errors = (
            np.array([recovery(exact + rng.normal(0, sigma, (n, 3)).astype(np.float32))[-1] for _ in range(60)]) - truth
        )
        if by_roughness is highlight:
            total = (highlight[:, 0] ** 2).sum() - highlight[:, 0].sum() ** 2 / n
            information = 3 * total / sigma**2 + 1 / tau**2
            # 60 draws: the ratio of variances has a standard deviation of 0.18
            assert errors[:, 3].var() * information == pytest.approx(1.0, abs=0.55)
            np.testing.assert_allclose(errors.mean(0), 0.0, atol=0.01)
        else:
            # What no pixel tells is the part along (-1/2, -1/2, -1/2, 1): the smallest materials that explain the rest
            unknown = np.array([-0.5, -0.5, -0.5, 1.0])
            np.testing.assert_allclose(errors.mean(0), -unknown * (truth @ unknown) / (unknown @ unknown), atol=0.01)


def test_many_levels_give_the_dense_solution():
    rng = np.random.default_rng(3)
    cells, *_ = lattice(4)
    finest, n = cells.counts[-1], 300
    column, row = rng.integers(0, finest, 4 * n), np.repeat(np.arange(n), 4)
    footprint = csr_array((np.full(4 * n, 0.25, np.float32), (row, column)), shape=(n, finest))
    bases = [rng.normal(0, 0.3, (4, 4)).astype(np.float32) for _ in cells.codes]
    local = [rng.uniform(0.5, 2.0, (count, 4)).astype(np.float32) for count in cells.counts]
    prior = Prior(np.zeros(4, np.float32), tuple(bases), tuple(local))
    response = Response.of(
        rng.uniform(0.5, 1, (n, 3)).astype(np.float32), rng.normal(0, 0.3, (n, 3)).astype(np.float32)
    )
    sigma = rng.uniform(0.05, 0.2, (n, 3)).astype(np.float32)
    y = rng.normal(0, 1, (n, 3)).astype(np.float32)
    found = Recovery(cells, prior, footprint, response, sigma)(y)
    # U: from details of all levels to the finest cells, four numbers a cell
    u = np.zeros((0, 0))
    for index, count in enumerate(cells.counts):
        own = (
            np.kron(np.eye(count), np.ones((4, 4)))
            * np.kron(np.ones((count, count)), bases[index])
            * local[index].ravel()
        )
        above = np.kron(cells.parents[index - 1].toarray(), np.eye(4)) @ u if index else np.zeros((4 * count, 0))
        u = np.concatenate((above, own), 1)
    j = np.zeros((3 * n, 4 * n))
    for p in range(n):
        j[3 * p : 3 * p + 3, 4 * p : 4 * p + 4] = response.jacobian[p]
    a = j @ np.kron(footprint.toarray(), np.eye(4)) @ u / sigma.reshape(-1, 1)
    z = np.linalg.solve(np.eye(a.shape[1]) + a.T @ a, a.T @ (y / sigma).ravel())
    np.testing.assert_allclose(found[-finest:].ravel(), u @ z, atol=0.02 * np.abs(u @ z).max())


# ---- photographs


def test_noise_of_a_textured_photograph_is_found():
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:64, :64] / 64
    albedo = rng.uniform(0.1, 0.9, (64, 64, 3)).astype(np.float32)
    light = (1.0 + 0.5 * np.sin(3 * x) + y)[..., None]
    for relative in (0.02, 0.1):
        noise = 1 + relative * rng.normal(0, 1, (64, 64, 1))  # the same in all channels, as of one light
        found = photo_noise((light * (albedo + 0.05) * noise).astype(np.float32), albedo)
        assert np.median(found / (light * (albedo + 0.05))) == pytest.approx(relative, rel=0.1)


@pytest.mark.parametrize("shared", [0.0, 0.6, 0.95])
def test_how_much_of_the_noise_channels_share_is_found(shared):
    """Predictions' own noise, which is independent, is none of it, nor is what positions add to all channels alike."""
    rng = np.random.default_rng(7)
    shape = (2, 100, 100, 3)
    grey, own = rng.normal(0, 1, (2, 100, 100, 1)), rng.normal(0, 1, shape)
    noise = np.sqrt(shared) * grey + np.sqrt(1 - shared) * own
    photographs = 1 + 0.05 * noise + 0.02 * rng.normal(0, 1, (2, 100, 100, 1))
    pictures = (1 + rng.normal(0, 0.03, (2, *shape))).astype(np.float32)
    predicted = Predicted(pictures, pictures[0], pictures[0])
    found = noise_covariance(photographs, predicted, np.full(shape, 0.1, np.float32), np.full((*shape, 3), 0.02**2))
    assert found.diagonal() == pytest.approx(np.full(3, 0.25), abs=0.02)
    assert found[~np.eye(3, dtype=bool)] / 0.25 == pytest.approx(np.full(6, shared), abs=0.06)


def test_noise_that_channels_share_is_taken_out_where_the_highlight_is_not_grey():
    """One cell: the estimate from whitened sums of channels is the dense generalised least squares solution, and is
    closer to the truth than that which takes channels for independent.
    """
    rng = np.random.default_rng(8)
    n, sigma = 400, 0.1
    by_roughness = (rng.random((n, 1)) * [0.3, 1.0, 1.0]).astype(np.float32)
    response = Response.of(np.ones((n, 3), np.float32), by_roughness)
    covariance = sigma**2 * (0.99 * np.ones((3, 3)) + 0.01 * np.eye(3))
    root = np.linalg.cholesky(covariance)
    white = np.broadcast_to(np.linalg.inv(root), (n, 3, 3)).astype(np.float32)
    prior = np.full(4, 0.3)
    truth = (prior * rng.standard_normal((200, 4))).astype(np.float32)
    errors = []
    recoveries = single(response.mixed(white), (1.0, 3), n, prior), single(response, (sigma, 3), n, prior)
    dense = np.zeros((n * 3, 4))
    for c in range(3):
        dense[c::3, c], dense[c::3, 3] = 1.0, by_roughness[:, c]
    precision = np.kron(np.eye(n), np.linalg.inv(covariance))
    inverse = np.linalg.inv(dense.T @ precision @ dense + np.diag(prior**-2))
    for x in truth[:20]:
        y = (response(np.broadcast_to(x, (n, 4))) + rng.standard_normal((n, 3)) @ root.T).astype(np.float32)
        found = recoveries[0](np.einsum("ncd,nd->nc", white, y))[-1]
        np.testing.assert_allclose(found, inverse @ dense.T @ precision @ y.reshape(-1), atol=2e-3)
        errors.append([float((estimate - x)[3]) for estimate in (found, recoveries[1](y)[-1])])
    shared, independent = np.sqrt(np.square(errors).mean(0))
    assert shared < 0.5 * independent


@pytest.mark.parametrize("wrong", [1.0, 1.1])
def test_in_the_furnace_a_wrong_light_is_a_known_error_of_albedo(wrong):
    """Reflected ``rho (E + L)`` with ``L = wrong rho E / (1 - rho)``: an albedo found in that light is off by
    ``rho (wrong - 1) L / (E + wrong L)``, and the derivative by the albedo is ``E + wrong L``."""
    rho, emission = 0.6, 1.0
    scene = build_furnace(rho, emission)
    world = build_world(scene)
    right = rho * emission / (1 - rho)
    materials = ConstantMaterials(rho)
    estimator = Estimator(world, materials, lambda si, albedo: torch.full_like(si.p, wrong * right))
    primary = PrimaryHits(world, [view.camera for view in scene.train], 16, 0, torch.device("cpu"))
    left_out = torch.zeros(2, primary.pixels, dtype=torch.bool)
    left_out[0, :100] = True
    found = predict(estimator, materials, primary, left_out, 4, 0, 32)
    light = emission + wrong * right
    kept = ~left_out.numpy()
    assert not found.pictures[:, ~kept].any()
    np.testing.assert_allclose(found.by_albedo[kept].mean(0), light, rtol=0.01)
    np.testing.assert_allclose(found.pictures[:, kept].mean((0, 1)), rho * light, rtol=0.01)
    assert not found.by_roughness.any(), "walls are diffuse"
    n = int(kept.sum())
    response = Response.of(found.by_albedo[kept], found.by_roughness[kept])
    recovery = single(response, (0.01, 3), n, np.full(4, 1.0))
    photographs = np.full((n, 3), rho * emission / (1 - rho), np.float32)
    error = recovery(photographs - found.pictures.mean(0)[kept])[-1, :3]
    np.testing.assert_allclose(error, rho * (1 - wrong) * right / light, atol=0.005)


# ---- the table


def test_the_gap_is_that_to_the_noise_and_the_largest_rung_what_adds_most():
    pairs = {"resolution": (40.0, 30.0), "noise": (37.0, 27.0), "ours": (31.0, 17.0)}
    found = [Rung(name, "", {"albedo_psnr": a, "roughness_psnr": r}) for name, (a, r) in pairs.items()]
    assert gap(found, "albedo") == pytest.approx(6.0)
    assert gap(found, "roughness") == pytest.approx(10.0)
    assert sentence(found, "roughness").endswith("largest rung is ours, 90 % of the squared error")


def test_a_rung_that_a_fit_has_passed_is_not_the_largest():
    pairs = {"resolution": 40.0, "noise": 23.0, "ours": 30.0}
    found = [Rung(name, "", {"albedo_psnr": value}) for name, value in pairs.items()]
    assert sentence(found, "albedo") == (
        "albedo: gap_to_bound_db -7.00; the largest rung is ours, 90 % of the squared error; not counted, as the fit "
        "is better: noise"
    )


@pytest.mark.parametrize("positions", [4, 9])
def test_the_command_shows_the_ladder_of_a_run(tiny, capfd, monkeypatch, positions):
    """With four positions a pixel, as in a large room, fewer than the fit has samples, and with an odd number."""
    monkeypatch.setattr(ladder, "POSITIONS", (positions,))
    write_tiny_config(model={"sampling": {"spp": 8, "cached_spp": 9}})
    fit("--trainer.max_steps", "20")
    capfd.readouterr()
    main(["bench", "bound", "--spp", "2", "--out", "bound.csv"])
    lines = capfd.readouterr().out.splitlines()
    names = ("resolution", "noise", "ours")
    albedo = [float(next(line for line in lines if line.startswith(name)).split()[-4]) for name in names]
    assert albedo[0] > 35.0, "plain walls: only their edges are lost"
    assert albedo[0] > albedo[1] > albedo[2] + 3.0, "20 steps are far below what the photographs hold"
    said = next(line for line in lines if line.startswith("albedo: gap_to_bound_db"))
    assert float(said.split()[2].rstrip(";")) == pytest.approx(albedo[1] - albedo[2], abs=0.02)
    assert len((tiny / "bound.csv").read_text().splitlines()) == 1 + len(names)


def test_a_run_without_a_radiance_field_has_no_ladder(tiny, capfd):
    write_tiny_config(base="cornell.yaml")
    fit("--config", "methods/path.yaml", "--trainer.max_steps", "1")
    assert "a method with a radiance field" in fails(capfd, "bench", "bound")


# ---- what the fields could do at best


def test_the_command_shows_the_fields(capsys, monkeypatch):
    few_views(monkeypatch, "patterns")
    settings = ["data.patches=64", "model.sampling.spp=2", "model.sampling.cached_spp=2"]
    words = [word for setting in settings for word in ("--set", setting)]
    main(["bench", "ceiling", "--config", "patterns.yaml", "--seconds", "1", *words])
    lines = capsys.readouterr().out.splitlines()
    lookup = float(next(line for line in lines if line.startswith("true colour's lookup")).split()[-2])
    r2 = float(next(line for line in lines if "R2 of the lookup" in line).rstrip(")").split()[-1])
    constant = float(next(line for line in lines if line.startswith("best constant")).split()[-2])
    assert lookup - constant == pytest.approx(-10 * np.log10(1 - r2), abs=0.02)
    assert any(line.startswith("Held-out views, glossy pixels with light on them") for line in lines)
    assert sum(line.startswith("the fields") for line in lines) == 3
