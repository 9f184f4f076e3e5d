"""Photographs of different sizes in one set, and masks that leave parts of them out."""

import json
import math
from dataclasses import replace

import numpy as np
import OpenEXR
import pytest
import torch
from helpers.small_step import small_scene
from helpers.tiny_scene import POSE, ready, write_json, write_scene
from PIL import Image

from benchmarks.peer.fit import _photographs
from datamodules.image_cache import blurred
from neurad.assembly.build import build_world
from neurad.core.camera import camera_rays
from neurad.core.errors import InputError
from neurad.core.lens import Lens
from neurad.core.patch_sampler import PatchSampler
from neurad.core.records import PixelBatch
from neurad.core.rng import Stream
from neurad.formats.load import load_scene
from neurad.images.image_io import read_exr, write_exr
from neurad.integrators import emitter_pixels
from neurad.integrators.primary_hits import PrimaryHits
from neurad.metrics.held_out import HeldOut
from neurad.metrics.held_out_scores import score
from neurad.scene.geometry import Geometry
from neurad.tracing.embree import EmbreeTracer

SIZES = [(8, 6), (5, 9), (8, 6), (12, 4)]
CPU = torch.device("cpu")


@pytest.fixture
def folder(tmp_path):
    """A scene folder whose photographs have the sizes above."""
    pytest.importorskip("mitsuba")
    folder = write_scene(tmp_path / "room", len(SIZES))
    rng = np.random.default_rng(5)
    frames = []
    for i, (width, height) in enumerate(SIZES):
        write_exr(folder / f"images/train_{i}.exr", rng.random((height, width, 3), np.float32), half=False)
        size = {} if i == 1 else {"w": width, "h": height}
        frames.append({"file_path": f"images/train_{i}.exr", "transform_matrix": POSE, **size})
    write_json(folder, "train", {"camera_angle_x": 0.9, "frames": frames})
    return folder


def masked(folder, view, black):
    """Give a view a mask that is black where an array [h, w] says so."""
    described = json.loads((folder / "transforms_train.json").read_text())
    described["frames"][view]["mask_path"] = f"masks/{view}.png"
    write_json(folder, "train", described)
    (folder / "masks").mkdir(exist_ok=True)
    Image.fromarray(np.where(black, 0, 200).astype(np.uint8)).save(folder / f"masks/{view}.png")


def agrees(batch, images, means=None):
    for view in batch.view.unique().tolist():
        here = batch.view == view
        place = np.divmod(batch.pixel[here].numpy(), SIZES[view][0])
        np.testing.assert_array_equal(batch.color[here].numpy(), images[view][place])
        if means is not None:
            torch.testing.assert_close(batch.blurred[here], means[view][batch.pixel[here]])


@pytest.mark.parametrize("settings", [{}, {"resident": 2, "replace_every": 1}, {"patch_size": 3, "patches": 20}])
def test_batches_hold_the_photographs_own_values(folder, settings):
    data = ready(folder, **settings)
    assert data.batch(0).blurred is None
    data.request_blurred()
    images = [read_exr(view.image) for view in data.scene.train]
    means = [blurred(torch.from_numpy(image).view(1, -1, 3), None, image.shape[1])[0] for image in images]
    seen = set()
    for iteration in range(6):
        batch = data.batch(iteration)
        agrees(batch, images, means)
        assert batch.iteration == iteration
        assert batch.alpha.min() == 1
        seen |= set(batch.view.tolist())
    assert seen == {0, 1, 2, 3}
    stats = data.dataset_stats()
    whole = np.concatenate([image.reshape(-1, 3) for image in images])
    assert stats.mean_square_radiance == pytest.approx(np.mean(np.square(whole, dtype=np.float64)), rel=1e-5)
    agrees(stats.sample, images)


@pytest.mark.parametrize("alpha", [False, True])
def test_every_patch_of_every_size_is_drawn_once(alpha):
    covered = torch.ones(len(SIZES), 48) if alpha else None
    sampler = PatchSampler.build(SIZES, 2, covered, 3)
    for view, (width, height) in enumerate(SIZES):
        count = int(sampler.count[sampler.views == view])
        assert count == (width - 1) * (height - 1)
        drawn = [sampler.draw(4 * i, 4) for i in range(count)]
        patches = torch.cat([pixel.view(4, 4)[v.view(4, 4)[:, 0] == view] for v, pixel in drawn])
        assert len({tuple(patch.tolist()) for patch in patches}) == count
        x, y = patches % width, patches // width
        assert (x - x[:, :1]).tolist() == [[0, 1, 0, 1]] * count
        assert (y - y[:, :1]).tolist() == [[0, 0, 1, 1]] * count
        assert int(y.max()) == height - 1


def test_a_patch_has_to_fit_in_the_smallest(folder):
    with pytest.raises(InputError, match="5 does not fit in photographs of 12 x 4 pixels"):
        ready(folder, patch_size=5)


def test_fireflies_of_different_sizes(folder):
    bright = np.full((9, 5, 3), 0.1, np.float32)
    bright[4, 2] = 1000.0
    write_exr(folder / "images/train_1.exr", bright, half=False)
    for settings in ({}, {"resident": 2}):
        data = ready(folder, **settings)
        before = data.dataset_stats().mean_square_radiance
        assert data.spread_fireflies(torch.zeros(4, 48, dtype=torch.bool)) > 0.5
        assert data.dataset_stats().mean_square_radiance < 0.5 * before


def test_masked_pixels_take_no_part(folder):
    black = np.zeros((6, 8), bool)
    black[:, :5] = True
    masked(folder, 2, black)
    data = ready(folder)
    left_out = data.ignored()
    assert left_out.shape == (4, 48)
    assert left_out[2].view(6, 8).numpy().tolist() == black.tolist()
    assert not left_out[[0, 1, 3]].any()
    sample = data.dataset_stats(left_out).sample
    assert not left_out[sample.view, sample.pixel].any()
    assert ready(write_scene(folder.parent / "plain")).ignored() is None


def test_masked_pixels_are_not_scored(folder):
    """A rendering that is wrong behind the mask alone is perfect; without the mask it is not."""
    black = np.zeros((6, 8), bool)
    black[2:4] = True
    masked(folder, 2, black)
    scene = load_scene(str(folder), None)
    geometry = Geometry(scene)
    tracer = EmbreeTracer(geometry.vertices, geometry.faces)
    scores = []
    for test in ([scene.train[2]], [replace(scene.train[2], mask=None)]):
        held_out = HeldOut(replace(scene, test=test), geometry, tracer).read()
        wrong = held_out.truth(0)["photograph"] + black[..., None].astype(np.float32)
        scores.append(score(held_out, [{}], [wrong])["psnr_linear"])
    assert scores == [math.inf, pytest.approx(10 * math.log10(3.0))]


def test_pixels_outside_the_data_window_take_no_part(folder):
    """Beside those of a mask; of a photograph whose file has 5 x 4 of its 8 x 6 pixels."""
    image = np.random.default_rng(1).random((4, 5, 3), np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header |= {"dataWindow": ((1, 1), (5, 4)), "displayWindow": ((0, 0), (7, 5))}
    OpenEXR.File(header, {"RGB": image}).write(str(folder / "images/train_2.exr"))
    outside = np.ones((6, 8), bool)
    outside[1:5, 1:6] = False
    data = ready(folder)
    assert data.ignored()[2].view(6, 8).numpy().tolist() == outside.tolist()
    assert not data.ignored()[[0, 1, 3]].any()
    black = np.zeros((6, 8), bool)
    black[:, :3] = True
    masked(folder, 2, black)
    data = ready(folder)
    assert data.ignored()[2].view(6, 8).numpy().tolist() == (outside | black).tolist()
    inside = data.photographs[2, :48].view(6, 8, 3)[~outside]
    np.testing.assert_array_equal(inside, image.reshape(-1, 3))
    scene = load_scene(str(folder), None)
    geometry = Geometry(scene)
    held_out = HeldOut(replace(scene, test=scene.train[2:3]), geometry, EmbreeTracer(geometry.vertices, geometry.faces))
    np.testing.assert_array_equal(held_out.kept(0), ~(outside | black))


def test_what_takes_one_size_says_so(folder):
    scene = load_scene(str(folder), None)
    with pytest.raises(InputError, match="train_1: the peer takes photographs of one size and without masks"):
        _photographs(scene)


# ---- camera rays


def several(bent=True):
    """A small scene, and cameras of different sizes and lenses in it."""
    scene = small_scene(size=24)
    lenses = [Lens(), Lens(1.1, (0.4, 0.55), (-0.2, 0.02) if bent else ()), Lens(numerator=(0.05,), fisheye=bent)]
    sizes = [(24, 24), (20, 30), (16, 12)]
    cameras = [
        replace(view.camera, width=w, height=h, lens=lens)
        for view, (w, h), lens in zip(scene.train, sizes, lenses, strict=False)
    ]
    return scene, cameras, sizes


def test_kept_hits_lie_on_the_rays_of_their_pixels():
    scene, cameras, sizes = several()
    world = build_world(scene)
    for cached in (0, 4):
        primary = PrimaryHits(world, cameras, cached, 7, CPU)
        for view, (w, h) in enumerate(sizes):
            pixel = torch.arange(w * h)
            batch = PixelBatch(torch.full_like(pixel, view), pixel, torch.ones(w * h, 3), torch.ones(w * h), 0)
            si = primary(batch, 1, Stream(3)).si
            # The point is seen in its pixel: its direction lies between those through the pixel's corners.
            d = torch.nn.functional.normalize(si.p - torch.as_tensor(cameras[view].to_world[:3, 3]).float(), dim=-1)
            corner = torch.stack((pixel % w, pixel // w), -1).float()
            middle = camera_rays(cameras[view], corner + 0.5).d
            radius = torch.stack(
                [(camera_rays(cameras[view], corner + torch.tensor(o)).d * middle).sum(-1) for o in
                 ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0))]
            ).amin(0)  # fmt: skip
            assert bool(((d * middle).sum(-1) >= radius - 1e-5)[si.valid].all())
            assert si.valid.float().mean() > 0.5


@pytest.mark.parametrize("bent", [False, True])
def test_pixels_that_show_an_emitter(bent):
    scene, cameras, sizes = several(bent)
    world = build_world(scene)
    found = PrimaryHits(world, cameras, 0, 0, CPU).sees_emitter()
    every = PrimaryHits(world, cameras, emitter_pixels.POSITIONS, 0, CPU).sees_emitter()
    assert found.shape == every.shape == (3, 600)
    for view, (w, h) in enumerate(sizes):
        assert found[view, w * h :].all()
        assert every[view, w * h :].all()
        assert (found[view] != every[view]).float().mean() < 0.02
        assert every[view, : w * h].any() or not found[view, : w * h].any()
    nothing = PrimaryHits(world, cameras, 0, 0, CPU).nothing()
    assert nothing.sum(1).tolist() == [600 - w * h for w, h in sizes]


def test_few_pixels_are_looked_at_for_a_small_lamp():
    """Through a lens, too; and every pixel that shows it is among them."""
    _, cameras, _ = several()
    camera = cameras[1]
    eye, axes = torch.as_tensor(camera.to_world[:3, 3]), torch.as_tensor(camera.to_world[:3, :3])
    for xy in ((0.4, 0.3), (10.0, 15.0), (19.5, 29.5)):
        d = camera_rays(camera, torch.tensor([xy], dtype=torch.float64)).d[0]
        lamp = (eye + 2.0 * d + 0.005 * torch.stack((axes[:, 0], axes[:, 1], -axes[:, 0]))).unsqueeze(0)
        shown = emitter_pixels.shown_in(lamp, camera, 1.0).view(30, 20)
        assert shown[int(xy[1]), int(xy[0])]
        assert 1 <= int(shown.sum()) <= 9
