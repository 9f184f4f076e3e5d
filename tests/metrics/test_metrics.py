"""Metrics: scores against values worked out by hand, and which pixels of a small scene count."""

import math
import random
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import OpenEXR
import pytest
import torch
from helpers.small_step import small_scene
from helpers.tables import csv_rows
from helpers.tiny_fit import fails, fit, metrics, run_folder, write_tiny_config
from helpers.tiny_scene import POSE, read_json, write_json, write_scene
from PIL import Image
from scipy.stats import spearmanr

from neurad.assembly.build import build_world
from neurad.bsdf.table import make_bsdf
from neurad.callbacks.training_views import ViewTable
from neurad.core.errors import InputError
from neurad.core.parameters import BY_NAME
from neurad.core.records import Surface, SurfaceInteraction
from neurad.core.reflection import ConductorModel, DiffuseModel, PrincipledModel, ReflectionModel
from neurad.core.scene_records import Camera, Constant, Material, Mesh, View
from neurad.emitters.lights import make_lights
from neurad.evidence.bar_maps import score_bars
from neurad.evidence.view_residuals import outliers
from neurad.integrators.film import render, strided
from neurad.integrators.method import SceneModel
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.world import World
from neurad.metrics import effort, held_out
from neurad.metrics.bar_scores import ause, bar_scores, coverage, psnr_of_most_certain_half, spearman
from neurad.metrics.effort import EvaluationResolution, affordable, seconds_of
from neurad.metrics.held_out import HeldOut
from neurad.metrics.held_out_scores import score, score_relit
from neurad.metrics.limits import albedo_at_limits, roughness_spread, sentence_of_limits, sentence_of_roughness
from neurad.metrics.lit_glossy import lit_glossy
from neurad.metrics.scores import Pool, block_means, psnr
from neurad.metrics.seen import SeenBy
from neurad.metrics.unseen import NEITHER, seen_map
from neurad.scene.builtin import build
from neurad.scene.description import Scene
from neurad.scene.exposure import scene_exposure
from neurad.scene.geometry import Geometry
from neurad.scene.textures import ConstantMaterials, TrueMaterials
from neurad.tracing.select import make_tracer

# --- scores


def test_pixels_outside_the_mask_may_be_anything() -> None:
    pool = Pool()
    truth = np.array([[[0.5], [np.nan]]])
    pool.add(np.array([[[0.5], [np.inf]]]), truth, np.array([[True, False]]))
    assert len(pool) == 1
    assert pool.scores() == {"psnr": math.inf, "mape": 0.0, "psnr_constant": math.inf, "mape_constant": 0.0}
    assert Pool().scores() == {}
    assert psnr(0.0) == math.inf
    with pytest.raises(ValueError, match="shapes"):
        pool.add(np.zeros((2, 1)), np.zeros((2, 3)))


def test_block_means_of_masked_pixels() -> None:
    values = np.arange(15, dtype=np.float32).reshape(3, 5, 1)
    mask = np.ones((3, 5), bool)
    mask[0, 0] = mask[2, 4] = False
    values[2, 4] = np.nan
    means, count = block_means(values, mask, 2)
    np.testing.assert_array_equal(count, [[3, 4, 2], [2, 2, 0]])
    np.testing.assert_allclose(means[..., 0], [[(1 + 5 + 6) / 3, 5, 6.5], [10.5, 12.5, 0]])


# --- a floor with a lamp at its edge and a wall across it, looked at from above

DOWN = np.eye(4)
DOWN[2, 3] = 2.0
ALONG_X = np.array([[0, 0, -1, -2], [-1, 0, 0, 0], [0, 1, 0, 0.5], [0, 0, 0, 1]], float)
SIDE = 8  # pixels of the held-out views: 0.5 wide on the floor


def quad(name: str, corners: list[list[float]], radiance: list[float] | None = None) -> Mesh:
    light = None if radiance is None else np.array(radiance, np.float32)
    return Mesh(name, np.array(corners, np.float32), np.array([[0, 1, 2], [0, 2, 3]]), 0, radiance=light)


def save(path: Path, pixels: np.ndarray) -> str:
    pixels = np.ascontiguousarray(pixels, np.float32)
    channels = {"Y": pixels[..., 0].copy()} if pixels.shape[2] == 1 else {"RGB": pixels}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, channels).write(str(path))
    return str(path)


def make_scene(test: list[View], train: list[Camera] | None = None, model: ReflectionModel | None = None) -> Scene:
    meshes = [
        quad("floor", [[-1, -1, 0], [1.25, -1, 0], [1.25, 1, 0], [-1, 1, 0]]),
        quad("lamp", [[1.25, -1, 0], [1.5, -1, 0], [1.5, 1, 0], [1.25, 1, 0]], [1, 1, 1]),
        quad("wall", [[0, -1, 0], [0, 1, 0], [0, 1, 0.9], [0, -1, 0.9]]),
    ]
    half = Constant(np.array([0.5, 0.5, 0.5], np.float32))
    train = [Camera(ALONG_X, math.pi / 2, 8, 8)] if train is None else train
    views = [View(f"train{i}", camera) for i, camera in enumerate(train)]
    return Scene("floor", meshes, [Material("m", model or PrincipledModel(), half, half)], None, views, test)


def open_views(scene: Scene, grid: int = 4) -> HeldOut:
    geometry = Geometry(scene)
    return HeldOut(scene, geometry, make_tracer("embree", geometry.vertices, geometry.faces), grid)


def from_above(**files: str) -> View:
    maps = {name: files.pop(name) for name in BY_NAME if name in files}
    return View("above", Camera(DOWN, math.pi / 2, SIDE, SIDE), maps=maps, **files)


COUNTED = np.zeros((SIDE, SIDE), bool)
COUNTED[2:6, 2:6] = True  # the column of pixels to their right is half floor, half lamp
SEEN = COUNTED.copy()
SEEN[:, 4:] = False  # behind the wall


@pytest.mark.parametrize("grid", [2, 3, 4])
def test_which_pixels_count_and_which_are_seen(grid: int) -> None:
    views = open_views(make_scene([from_above()]), grid)
    np.testing.assert_array_equal(views.counted(0), COUNTED)
    np.testing.assert_array_equal(views.seen(0), SEEN)


def test_smooth_surfaces_do_not_count() -> None:
    scene = make_scene([from_above()])
    half = scene.materials[0].albedo
    mirrored = [replace(mesh, material=int(mesh.name == "floor")) for mesh in scene.meshes]
    scene = replace(scene, meshes=mirrored, materials=[*scene.materials, Material("m", ConductorModel(), half, half)])
    views = open_views(scene)
    assert not views.counted(0).any()
    assert views.seen(0).any()


def test_a_point_is_seen_in_front_inside_the_frustum_and_not_occluded() -> None:
    scene = make_scene([], [Camera(ALONG_X, math.pi / 2, 8, 4)])  # sees |y| < x + 2 and |z - 0.5| < (x + 2) / 2
    geometry = Geometry(scene)
    seen = SeenBy(geometry, make_tracer("embree", geometry.vertices, geometry.faces), [v.camera for v in scene.train])
    cases = {
        (-0.5, 0.2, 0.0): True,
        (-0.9, 0.99, 0.0): True,
        (-0.9, 1.2, 0.0): False,  # beside the frustum
        (-1.1, 0.0, 0.0): False,  # below it
        (-3.0, 0.0, 0.5): False,  # behind the camera
        (0.5, 0.0, 0.0): False,  # behind the wall
        (0.5, 0.0, 1.2): True,  # above the wall
    }
    p = torch.tensor(list(cases))
    n = len(p)
    up = torch.tensor([[0.0, 0.0, 1.0]]).repeat(n, 1)
    zero, prim, valid = torch.zeros(n, 2), torch.zeros(n).long(), torch.ones(n).bool()
    si = SurfaceInteraction(p, up, up, up, zero, zero, prim, valid)
    assert seen.any(si).tolist() == list(cases.values())
    lanes, wi = seen.by(0, si)
    expected = torch.tensor([-2.0, 0.0, 0.5]) - p[lanes]
    torch.testing.assert_close(wi, expected / expected.norm(dim=1, keepdim=True))
    assert not seen.any(SurfaceInteraction(p, up, up, up, zero, zero, prim, ~valid)).any()


def test_the_second_camera_is_asked_about_what_the_first_does_not_see() -> None:
    both = [Camera(ALONG_X, math.pi / 2, 8, 8), Camera(DOWN, math.pi / 2, 8, 8)]
    views = open_views(make_scene([from_above()], both))
    assert views.seen(0)[COUNTED].all()
    assert not views.seen(0)[0].any()  # nothing is there


@pytest.mark.parametrize("grid", [2, 4, 6])
def test_a_few_sub_samples_are_one_in_each_quarter_of_a_pixel(grid: int) -> None:
    views = open_views(make_scene([from_above()]), grid)
    whole = next(iter(views.sub_samples(0)))[1].p.view(SIDE * SIDE, grid * grid, 3)
    few = next(iter(views.sub_samples(0, few=True)))[1].p.view(SIDE * SIDE, 4, 3)
    on_floor = np.flatnonzero(COUNTED)
    for pixel in on_floor:
        assert all((whole[pixel] == p).all(-1).any() for p in few[pixel])
        x, y = ((few[pixel, :, :2] / 0.5) % 1.0 >= 0.5).T.tolist()  # pixels are 0.5 wide
        assert len(set(zip(x, y, strict=True))) == 4
    lanes = views._few(slice(3, 5), torch.device("cpu")).view(2, 4) - torch.tensor([[0], [grid**2]])
    assert (lanes % grid).float().mean() == (lanes // grid).float().mean() == (grid - 1) / 2  # no corner preferred


def test_predictions_are_box_filtered() -> None:
    def materials(si: SurfaceInteraction) -> Surface:
        return Surface(si.p.abs(), (si.p[:, :1] > -0.75).float())

    views = open_views(make_scene([from_above()]), grid=4)
    maps = views.predict(materials)[0]
    assert maps["albedo"].shape == (SIDE, SIDE, 3)
    assert maps["roughness"].shape == (SIDE, SIDE, 1)
    y, x = np.mgrid[-2:2:8j, -2:2:8j] * 7 / 8  # centres
    near = maps["albedo"][COUNTED] - np.stack((np.abs(x), np.abs(y), 0 * x), -1)[COUNTED]
    assert np.abs(near).max() < 0.5 / 4 / math.sqrt(16) * 1.5  # stratified: a quarter pixel, averaged over 16
    np.testing.assert_allclose(maps["roughness"][2:6, 2], 0.5)  # half of the column, exactly by the strata
    np.testing.assert_array_equal(maps["albedo"][0], 0.0)
    again = views.predict(materials)[0]  # from kept hits
    np.testing.assert_array_equal(again["albedo"], maps["albedo"])


def test_chunks_and_uncached_hits_change_nothing_that_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(held_out, "CHUNK", 160)  # ten pixels, across rows, four in the last chunk
    monkeypatch.setattr(held_out, "CACHE_BYTES", 0)
    views = open_views(make_scene([from_above()]))
    np.testing.assert_array_equal(views.counted(0), COUNTED)
    np.testing.assert_array_equal(views.seen(0), SEEN)
    assert not views._hits
    np.testing.assert_array_equal(views.predict(ConstantMaterials(0.25, 0.5))[0]["albedo"][COUNTED], 0.25)


def with_truth(tmp_path: Path) -> Scene:
    """Two views of the same truth: albedo 0.4 where seen and 0.6 elsewhere, roughness 0.3, wild values off the mask."""
    albedo = np.full((SIDE, SIDE, 3), 1e9)
    albedo[COUNTED] = 0.6
    albedo[SEEN] = 0.4
    roughness = np.where(COUNTED[..., None], 0.3, -1e9)
    photograph = np.full((SIDE, SIDE, 3), 4.0)
    files = {
        "image": save(tmp_path / "i.exr", photograph),
        "albedo": save(tmp_path / "a.exr", albedo),
        "roughness": save(tmp_path / "r.exr", roughness),
    }
    return make_scene([from_above(**files), from_above(**files)])


def test_scores_of_two_views_by_hand(tmp_path: Path) -> None:
    views = open_views(with_truth(tmp_path))
    maps = views.predict(ConstantMaterials(0.5, 0.4))
    maps[1] = views.predict(ConstantMaterials(0.7, 0.3))[1]
    renders = [np.full((SIDE, SIDE, 3), 4.0, np.float32), np.full((SIDE, SIDE, 3), 4.0, np.float32)]
    renders[1][0, 0] = [4.5, 4.0, 0.0]
    scores = score(views, maps, renders)
    db = lambda mse: -10 * math.log10(mse)  # noqa: E731
    near = {"rel": 1e-4}
    assert scores["albedo_psnr"] == pytest.approx(db((0.01 * 16 + 0.09 * 8 + 0.01 * 8) / 32), **near)
    assert scores["albedo_psnr_seen"] == pytest.approx(db((0.01 + 0.09) / 2), **near)
    assert scores["albedo_mape"] == pytest.approx(((0.1 + 0.3) / 0.41 + (0.1 + 0.1) / 0.61) / 4, **near)
    assert scores["albedo_psnr_constant"] == pytest.approx(20.0, **near)
    assert scores["albedo_mape_constant"] == pytest.approx((0.1 / 0.41 + 0.1 / 0.61) / 2, **near)
    assert scores["albedo_psnr_constant_seen"] > 100
    # one 8 x 8 block a view: the truth's mean is 0.5, the predictions are 0.5 and 0.7
    assert scores["albedo_psnr_8x8"] == pytest.approx(db(0.02), **near)
    assert scores["roughness_psnr"] == pytest.approx(db(0.005), **near)
    assert scores["roughness_mape_seen"] == pytest.approx(0.05 / 0.31, **near)
    # images count everywhere: one pixel of 128 is off by 0.5 and 4 in two of three channels; photographs of 4 are
    # shown at 0.8
    assert scores["psnr_linear"] == pytest.approx(db((0.25 + 16) / 3 / 128), **near)
    shown, brighter = 1.055 * 0.8 ** (1 / 2.4) - 0.055, 1.055 * 0.9 ** (1 / 2.4) - 0.055
    assert scores["psnr_srgb"] == pytest.approx(db(((brighter - shown) ** 2 + shown**2) / 3 / 128), **near)
    assert scores["psnr_linear_seen"] == math.inf
    without = score(views, maps)
    assert without == {key: value for key, value in scores.items() if "linear" not in key and "srgb" not in key}


@pytest.mark.parametrize("lit", [1.0, 0.05])
def test_the_unit_of_radiance_changes_no_score_of_pictures_as_they_are_shown(tmp_path: Path, lit: float) -> None:
    """Also where most of the photographs is black, as around an object."""
    rng = np.random.default_rng(3)
    photograph = rng.exponential(1.0, (SIDE, SIDE, 3)) * (rng.random((SIDE, SIDE, 1)) < lit)
    found = []
    for unit in (1.0, 1000.0, 1e-3):
        files = {"image": save(tmp_path / f"{unit}.exr", unit * photograph)}
        train = [from_above(**files)]
        views = open_views(replace(make_scene([from_above(**files)]), train=train))
        assert views.exposure == pytest.approx(0.8 / (unit * np.percentile(photograph[photograph > 0], 90)), rel=1e-5)
        scores = score(views, [{}], [(unit * (photograph + 0.1)).astype(np.float32)])
        found.append([scores[name] for name in ("psnr_srgb", "psnr_srgb_constant")])
    assert 10.0 < found[0][0] < 40.0
    np.testing.assert_allclose(found, [found[0]] * 3, rtol=1e-4)


def test_photographs_that_are_gone_or_black_leave_an_exposure(tmp_path: Path) -> None:
    gone = from_above(image=str(tmp_path / "gone.exr"))
    there = from_above(image=save(tmp_path / "a.exr", np.full((SIDE, SIDE, 3), 2.0)))
    black = from_above(image=save(tmp_path / "b.exr", np.zeros((SIDE, SIDE, 3))))
    scene = make_scene([there])
    assert scene_exposure(replace(scene, train=[gone, black, there])) == pytest.approx(0.4)
    assert scene_exposure(replace(scene, train=[gone])) == pytest.approx(0.4)  # by what is held out
    assert scene_exposure(replace(scene, train=[black], test=[black])) == 1.0


def mask(path: Path, left_out: np.ndarray) -> str:
    Image.fromarray(np.where(left_out, 0, 255).astype(np.uint8)).save(path)
    return str(path)


def test_pixels_that_a_mask_leaves_out_count_in_no_map_and_no_picture(tmp_path: Path) -> None:
    """Albedo and roughness by hand, and their constants, as if nothing but the kept half of the floor were there; and
    renderings, relit pictures and those of the field itself.
    """
    right = np.zeros((SIDE, SIDE), bool)
    right[:, 4:] = True
    scene = with_truth(tmp_path)
    scene = replace(scene, test=[replace(view, mask=mask(tmp_path / "m.png", right)) for view in scene.test])
    views = open_views(scene)
    np.testing.assert_array_equal(views.counted(0), COUNTED & ~right)
    scores = score(views, views.predict(ConstantMaterials(0.5, 0.4)))
    for region in ("", "_seen"):
        assert scores[f"albedo_psnr{region}"] == pytest.approx(20.0, rel=1e-4)
        assert scores[f"albedo_psnr_8x8{region}"] == pytest.approx(20.0, rel=1e-4)
        assert scores[f"albedo_mape{region}"] == pytest.approx(0.1 / 0.41, rel=1e-4)
        assert scores[f"albedo_psnr_constant{region}"] > 100
        assert scores[f"roughness_psnr{region}"] == pytest.approx(20.0, rel=1e-4)
    shown = seen_map(views.counted(0), views.seen(0))[..., 0]
    assert (shown[right] == NEITHER).all()
    assert (shown[SEEN & ~right] == 1.0).all()
    pictures = [np.full((SIDE, SIDE, 3), 4.5, np.float32) for _ in range(2)]
    scene = replace(scene, test=[replace(view, relight=view.image) for view in scene.test])
    views = open_views(scene)
    for picture in pictures:
        picture[right] = 100.0
    scores = {
        **score_relit(views, pictures),
        **score(views, views.predict(ConstantMaterials(0.5, 0.4)), pictures, fields=pictures),
    }
    for name in ("relight_psnr_linear", "psnr_linear", "psnr_lhs"):
        assert scores[name] == pytest.approx(-10 * math.log10(0.25), rel=1e-4), name


def test_what_training_photographs_show_behind_a_mask_is_not_seen(tmp_path: Path) -> None:
    left = np.zeros((SIDE, SIDE), bool)
    left[:, :4] = True
    scene = make_scene([from_above()])
    above = replace(from_above(), mask=mask(tmp_path / "m.png", left))
    views = open_views(replace(scene, train=[above]))
    np.testing.assert_array_equal(views.seen(0) & COUNTED, COUNTED & ~left)
    si = next(iter(views.sub_samples(0)))[1]
    si = si[si.valid]
    np.testing.assert_array_equal(views.training.any(si), views.training.any_at(si.p))
    assert not views.training.any_at(si.p).all()


def test_lookup_by_true_colour_scores_what_colour_tells(tmp_path: Path) -> None:
    """Three colours in the training views; a fourth, near the third, in the held-out one. By hand: in one part
    the two roughnesses of colour 0.4 have the mean 0.3; 0.65, which the finest table lacks, is found beside 0.6.
    """
    albedo, roughness = np.full((SIDE, SIDE, 3), 0.02), np.full((SIDE, SIDE, 1), 0.9)
    albedo[SEEN], roughness[SEEN] = 0.4, 0.3
    rest = COUNTED & ~SEEN
    albedo[rest], roughness[rest] = 0.6, 0.5
    train = [save(tmp_path / "ta.exr", albedo), save(tmp_path / "tr.exr", roughness)]
    half = np.flatnonzero(SEEN.ravel())[::2]
    roughness.reshape(-1)[half] += 0.1
    roughness.reshape(-1)[np.flatnonzero(SEEN.ravel())[1::2]] -= 0.1
    albedo[rest] = 0.65
    test = from_above(albedo=save(tmp_path / "a.exr", albedo), roughness=save(tmp_path / "r.exr", roughness))
    scene = make_scene([test])
    views = open_views(replace(scene, train=[from_above(albedo=train[0], roughness=train[1])]))
    scores = score(views, views.predict(ConstantMaterials(0.5, 0.4)), None, {"part": [SEEN]})
    mse = 0.01 * SEEN.sum() / COUNTED.sum()
    assert scores["roughness_psnr_lookup"] == pytest.approx(-10 * math.log10(mse), rel=1e-4)
    assert scores["roughness_psnr_lookup_part"] == pytest.approx(20.0, rel=1e-4)
    true = roughness[COUNTED]
    assert scores["roughness_r2_lookup"] == pytest.approx(1 - mse / float(true.var()), rel=1e-3)
    assert scores["roughness_r2_lookup_part"] == pytest.approx(0.0, abs=1e-4), "colour tells nothing there"
    assert "roughness_psnr_lookup_constant" not in scores
    bare = open_views(scene)  # no true maps of training views
    assert bare.lookup is None
    assert not [key for key in score(bare, bare.predict(ConstantMaterials(0.5, 0.4))) if "lookup" in key]


def test_regions_get_scores_of_their_own(tmp_path: Path) -> None:
    views = open_views(with_truth(tmp_path))
    scores = score(views, views.predict(ConstantMaterials(0.5, 0.5)), None, {"lit_glossy": [SEEN, np.zeros_like(SEEN)]})
    assert scores["albedo_psnr_lit_glossy"] == pytest.approx(20.0, rel=1e-4)
    empty = score(views, views.predict(ConstantMaterials(0.5, 0.5)), None, {"none": [np.zeros_like(SEEN)] * 2})
    assert not [key for key in empty if key.endswith("_none")]


def test_missing_truth_leaves_its_scores_out(tmp_path: Path) -> None:
    bare = open_views(make_scene([from_above()]))
    picture = np.zeros((SIDE, SIDE, 3), np.float32)
    assert score(bare, bare.predict(ConstantMaterials(0.5, 0.5)), [picture]) == {}
    roughness = save(tmp_path / "r.exr", np.full((SIDE, SIDE, 1), 0.5))
    views = [from_above(roughness=roughness)]
    only = open_views(make_scene(views))
    assert "roughness_psnr" in score(only, only.predict(ConstantMaterials(0.5, 0.5)))
    diffuse = open_views(make_scene(views, model=DiffuseModel()))  # which has no roughness
    assert score(diffuse, diffuse.predict(ConstantMaterials(0.5, 0.5))) == {}


def test_files_that_do_not_fit_are_named(tmp_path: Path) -> None:
    small = open_views(make_scene([from_above(albedo=save(tmp_path / "small.exr", np.zeros((4, 6, 3))))]))
    with pytest.raises(InputError, match=r"small.exr: it has 6 x 4 pixels, but its camera has 8 x 8"):
        small.truth(0)
    grey = open_views(make_scene([from_above(albedo=save(tmp_path / "grey.exr", np.zeros((SIDE, SIDE, 1))))]))
    with pytest.raises(InputError, match=r"grey.exr: it has 1 channels"):
        grey.truth(0)


@pytest.mark.parametrize(("name", "channels"), [("albedo", 3), ("roughness", 1), ("metallic", 1)])
@pytest.mark.parametrize("value", [-3.0, 1.5, np.nan])
def test_true_maps_outside_of_their_range_are_refused(tmp_path: Path, name: str, channels: int, value: float) -> None:
    """Where they count: beside surfaces they may hold anything."""
    pixels = np.where(COUNTED[..., None], np.full(channels, 0.5), 2.0)
    views = open_views(make_scene([from_above(**{name: save(tmp_path / "map.exr", pixels)})]))
    assert f"{name}_true" in views.truth(0)
    pixels[3, 2] = value
    views = open_views(make_scene([from_above(**{name: save(tmp_path / "wrong.exr", pixels)})]))
    with pytest.raises(InputError, match=rf"wrong\.exr.* {channels} of .*values are not numbers"):
        views.truth(0)


def test_lit_glossy_finds_a_real_highlight(tmp_path: Path) -> None:
    """A lamp at (-1, 0, 1) and a camera at (1, 0, 1): the floor mirrors one into the other at the origin. A row of it
    is too rough, and another view has no true maps.
    """
    roughness = np.full((SIDE, SIDE, 1), 0.4)
    roughness[3] = 0.6
    files = {
        "albedo": save(tmp_path / "a.exr", np.full((SIDE, SIDE, 3), 0.5)),
        "roughness": save(tmp_path / "r.exr", roughness),
    }
    aside = np.eye(4)
    aside[:3, 3] = [1, 0, 1]
    half = Constant(np.array([0.5, 0.5, 0.5], np.float32))
    corners = [[-1.05, -0.05, 1], [-1.05, 0.05, 1], [-0.95, 0.05, 1], [-0.95, -0.05, 1]]
    meshes = [make_scene([]).meshes[0], quad("lamp", corners, [9, 9, 9])]
    train = [View("train", Camera(aside, 2 * math.atan(2.5), 8, 8))]
    scene = Scene("floor", meshes, [Material("m", PrincipledModel(), half, half)], None, train,
                  [from_above(**files), from_above()])  # fmt: skip
    views = open_views(scene)
    world = World(
        views.geometry,
        views.tracer,
        make_lights(scene, views.geometry),
        make_bsdf(scene.features),
        scene.features,
        torch.ones(len(views.geometry.faces), dtype=torch.bool),
    )
    dark = SceneModel(world, ConstantMaterials(0.5, 0.4), lambda si, albedo: torch.zeros_like(albedo))
    mask, bare = lit_glossy(views, Radiometric(), dark, 8)
    assert mask[4, 3:5].all()  # around the origin the specular part is about 45 %
    assert not mask[3].any()
    assert not bare.any()
    assert not mask[[2, 2, 5, 5], [2, 5, 2, 5]].any()  # at the corners it is below 2 %
    assert not mask[~COUNTED].any()


# ---- how much of the albedo sits at its limits, and what is said of it


def test_fractions_are_of_counted_channel_values():
    albedo = np.full((2, 5, 3), 0.5, np.float32)
    albedo[0, 0] = 0.995, 0.5, 0.001
    albedo[0, 1] = 1.0
    albedo[1, 4] = 0.0  # does not count
    counted = np.ones((2, 5), bool)
    counted[1, 4] = False
    found = albedo_at_limits([{"albedo": albedo}, {}], [counted, counted])
    assert found["albedo_at_0"] == pytest.approx(1 / 27)
    assert found["albedo_at_1"] == pytest.approx(4 / 27)
    assert sentence_of_limits(found) == (
        "albedo at its limits: 3.7 % below 0.01, 14.8 % above 0.99; so much white may mean that lights are brighter "
        "than they are taken for"
    )
    few = sentence_of_limits({"albedo_at_0": 0.2, "albedo_at_1": 0.01})
    assert few == "albedo at its limits: 20.0 % below 0.01, 1.0 % above 0.99"


def test_roughness_has_a_mean_and_a_spread_and_nothing_is_said_of_what_was_not_recovered():
    assert albedo_at_limits([{}], [np.ones((2, 2), bool)]) == {}
    assert albedo_at_limits([{"albedo": np.ones((2, 2, 3), np.float32)}], [np.zeros((2, 2), bool)]) == {}
    assert sentence_of_limits({}) == ""

    roughness = np.array([0.2, 0.4, 0.9], np.float32).reshape(1, 3, 1)
    found = roughness_spread([{"roughness": roughness}, {}], [np.array([[True, True, False]])] * 2)
    assert found == pytest.approx({"roughness_mean": 0.3, "roughness_spread": 0.1})
    assert sentence_of_roughness(found) == "roughness found: 0.300 on average, spread 0.100"
    assert roughness_spread([{}], [np.ones((1, 1), bool)]) == {}
    assert sentence_of_roughness({}) == ""


# ---- scores of error bars against closed forms


N = 200_000


def test_coverage_of_errors():
    """Bars of the right size cover their level of logistic errors; bars k times too small, and normal errors, what
    closed forms say: (1 + exp(-x))^-1 and erf.
    """
    rng = np.random.default_rng(0)
    std = rng.uniform(0.01, 0.3, (N, 3))
    error = std * rng.logistic(0.0, np.sqrt(3.0) / np.pi, (N, 3))
    for level in (0.5, 0.9):
        limit = 5 * np.sqrt(level * (1.0 - level) / (3 * N))
        assert coverage(error, std, level) == pytest.approx(level, abs=limit)
    assert coverage(error, std / 2.0, 0.9) == pytest.approx(2.0 / (1.0 + np.sqrt(1.0 / 19.0)) - 1.0, abs=0.004)
    normal = std * rng.standard_normal((N, 3))
    assert coverage(normal, std, 0.5) == pytest.approx(0.4552, abs=0.004)  # erf(0.6057 / sqrt 2)
    assert coverage(np.zeros((4, 1)), np.zeros((4, 1)), 0.5) == 1.0


def test_spearman_is_that_of_scipy_also_with_equal_values():
    rng = np.random.default_rng(1)
    bar, size = rng.integers(0, 7, 500).astype(float), rng.random(500)
    assert spearman(bar, size) == pytest.approx(spearmanr(bar, size).statistic)
    assert spearman(size, size) == pytest.approx(1.0)
    assert spearman(-size, size) == pytest.approx(-1.0)
    assert spearman(np.ones(500), size) == 0.0


def test_area_under_the_sparsification_error():
    """0 in the order of the errors, 1 in a random one, more in the opposite one, and a case by hand."""
    rng = np.random.default_rng(2)
    size = np.abs(rng.standard_normal(N))
    assert ause(size, size) == pytest.approx(0.0, abs=1e-12)
    assert ause(rng.random(N), size) == pytest.approx(1.0, abs=0.02)
    assert ause(np.ones(N), size) == pytest.approx(1.0, abs=1e-9)
    assert ause(-size, size) > 1.5
    # errors 0 and 1: of one pixel, then two, the wrong order leaves 1, sqrt(1/2), the right one 0, sqrt(1/2)
    whole = np.sqrt(0.5)
    assert ause(np.array([1.0, 0.0]), np.array([0.0, 1.0])) == pytest.approx((1.0 - 0.0) / whole)


def test_area_of_two_kinds_of_normal_errors():
    """Half of the pixels with deviation s, half with 3 s, bars that say so: the curve is known in closed form."""
    rng = np.random.default_rng(3)
    std = np.repeat([0.1, 0.3], N // 2)
    size = np.abs(std * rng.standard_normal(N))
    left = np.arange(1, N + 1) / N
    curve = np.sqrt(np.where(left <= 0.5, 0.01, (0.005 + 0.09 * (left - 0.5)) / left))
    best = np.sqrt(np.cumsum(np.sort(size) ** 2) / np.arange(1, N + 1))
    expected = (curve - best).mean() / (np.sqrt(0.05) - best).mean()
    assert ause(std, size) == pytest.approx(expected, abs=0.01)


def test_the_sure_half_and_its_own_constant():
    bar = np.array([0.3, 0.1, 0.2, 0.4])
    truth = np.array([[0.0], [0.2], [0.4], [0.9]])
    predicted = truth + np.array([[0.5], [0.1], [0.1], [0.5]])
    found, constant = psnr_of_most_certain_half(bar, predicted, truth)
    assert found == pytest.approx(20.0)
    assert constant == pytest.approx(20.0)  # 0.2 and 0.4 around 0.3


def test_bars_are_scored_on_counted_pixels_alone_by_name():
    shape, mask = (2, 3, 3), np.array([[True, False, True], [False, False, True]])
    truth = np.random.default_rng(4).random(shape).astype(np.float32)
    views = SimpleNamespace(truth=lambda _: {"albedo_true": truth}, counted=lambda _: mask)
    error = np.where(mask[..., None], np.float32(0.1), np.float32(9.0))
    found = {"albedo": truth + error, "albedo_std": np.full(shape, 0.1, np.float32)}
    names = {"coverage_50", "coverage_90", "spearman", "ause", "psnr_sure", "psnr_sure_constant"}
    scores = score_bars(views, [found])
    assert set(scores) == {f"albedo_{name}" for name in names}
    assert scores["albedo_coverage_50"] == 0.0
    assert scores["albedo_coverage_90"] == 1.0
    assert scores["albedo_psnr_sure"] == pytest.approx(20.0, abs=1e-4)
    assert score_bars(views, [{"albedo": truth}]) == {}
    assert bar_scores(*np.zeros((3, 0, 3))) == {}
    with pytest.raises(ValueError, match="shapes differ"):
        bar_scores(truth[mask], np.zeros((3, 1)), truth[mask])


# ---- evaluations of large held-out views, in part


def large(width=4000, height=3000, count=1):
    view = small_scene().test[0]
    return [replace(view, camera=replace(view.camera, width=width, height=height))] * count


def test_ordinary_views_are_scored_as_a_whole_and_large_ones_within_their_time():
    assert affordable(build("patterns").test, 16, 0.1, 30.0) == EvaluationResolution()
    assert affordable(large(256, 256, 6), 64, 0.1, None) == EvaluationResolution()
    for seconds, fraction in ((60.0, 0.1), (3600.0, 0.1), (None, 0.1)):
        found = affordable(large(), 4, fraction, seconds)
        assert found.grid == 2
        assert found.stride > 1
        assert seconds_of(large(), 4, found) <= max(30.0, 90.0 if seconds else 60.0)
    assert affordable(large(), 4, 0.5, 36000.0) == EvaluationResolution()


def test_a_part_has_the_pixels_of_the_whole():
    scene = small_scene(size=7)
    world = build_world(scene)
    assert strided(7, torch.arange(9), 3).tolist() == [0, 3, 6, 21, 24, 27, 42, 45, 48]
    materials = TrueMaterials(scene, world.geometry)
    whole, part = (HeldOut(scene, world.geometry, world.tracer, 4, stride) for stride in (1, 3))
    full, few = (held_out.predict(materials)[0]["albedo"] for held_out in (whole, part))
    assert few.shape == (3, 3, 3)
    assert part.counted(0).shape == part.seen(0).shape == part.size(0) == (3, 3)
    same = np.abs(few - full[::3, ::3]).max(-1) < 1e-5  # but at edges, where positions differ
    assert same.mean() > 0.5
    depth = lambda rays, seed: world.intersect(rays).p  # noqa: E731
    points = [render(scene.test[0].camera, depth, 64, 1, stride=stride).numpy() for stride in (1, 3)]
    assert np.median(np.abs(points[0][::3, ::3] - points[1])) < 0.02


@pytest.mark.usefixtures("tiny")
def test_a_fit_says_that_it_scores_a_part(monkeypatch, capfd):
    write_tiny_config(evaluation={"every_n_steps": None, "spp": 1})
    monkeypatch.setattr(effort, "UNLIMITED", 0.01)
    fit("--trainer.max_steps=1")
    (line,) = [line for line in capfd.readouterr().err.splitlines() if "evaluation.fraction" in line]
    assert "one row and column in" in line
    assert "albedo_psnr_8x8" not in metrics()[0]
    assert float(metrics()[0]["albedo_psnr"]) > 5


# ---- training views that do not fit the others: found, named once, and no false alarm


AWAY = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 500.0], [0.0, 0.0, 1.0, 4.0], [0.0, 0.0, 0.0, 1.0]]


def test_only_views_far_outside_are_found():
    chosen = random.Random(3)
    for count in (4, 8, 50, 200):
        residuals = [0.05 * chosen.uniform(0.8, 1.25) for _ in range(count)]
        assert outliers(residuals) == []
        residuals[2], residuals[0] = 0.2, 0.3
        assert outliers(residuals) == ([0, 2] if count > 4 else [])
    assert outliers([0.05, 0.05, 0.9]) == []  # too few to say which are the others
    assert outliers([0.05] * 6 + [float("nan"), 0.12]) == [7]


def test_a_view_is_named_once(capsys, tmp_path):
    table = ViewTable([f"v{i}" for i in range(5)], np.ones(5))
    table.update(tmp_path, 10, np.array([0.2, 0.2, 0.2, 0.2, 0.6]))  # little is learnt: it may be chance
    assert capsys.readouterr().err == ""
    table.update(tmp_path, 20, np.array([0.02, 0.02, 0.02, 0.02, 0.5]))
    error = capsys.readouterr().err
    assert "training view v4 (0.50) differs from the photographs far more than the others (median 0.02)" in error
    table.update(tmp_path, 30, np.array([0.02, 0.02, 0.02, 0.02, 0.5]))
    assert capsys.readouterr().err == ""
    rows = csv_rows(tmp_path / "views.csv")
    assert rows[4] == {"view": "v4", "surface": "1", "residual": "0.5", "iteration": "30"}


def test_cameras_that_see_nothing(tiny, capfd):
    pytest.importorskip("mitsuba")
    room = write_scene(tiny / "room")
    cameras = read_json(room, "train")
    frames = cameras["frames"]
    arguments = ("--data.scene=null", "--data.root=room", "--trainer.max_steps=2", "--evaluation.every_n_steps=2")
    frames[1]["transform_matrix"] = AWAY
    write_json(room, "train", cameras)
    fit(*arguments)
    error = capfd.readouterr().err
    assert "of the pixels of training view train_1 (0 %) few meet a surface" in error
    rows = csv_rows(run_folder() / "views.csv")
    assert [float(row["surface"]) > 0 for row in rows] == [True, False, True]
    assert all(0 <= float(row["residual"]) <= 1 for row in rows)

    for frame in frames:
        frame["transform_matrix"] = AWAY
    write_json(room, "train", cameras)
    assert "no training camera sees a surface" in fails(capfd, "fit", "--config", "tiny.yaml", *arguments)
    assert POSE != AWAY
