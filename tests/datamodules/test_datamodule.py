"""Batches of photographed pixels: which ones, in what order, and which files are opened."""

import time
from types import SimpleNamespace

import numpy as np
import OpenEXR
import pytest
import torch
from helpers.tiny_scene import SIZE, read_json, ready, write_json, write_scene

from datamodules.pixels import blurred
from datamodules.scene_data import SceneData
from datamodules.settings import DataSettings
from neurad.core.errors import InputError
from neurad.core.patch_sampler import PatchSampler
from neurad.core.records import PixelBatch
from neurad.images.image_io import read_exr, write_exr

pytest.importorskip("mitsuba")


@pytest.fixture
def folder(tmp_path):
    return write_scene(tmp_path / "room")


def with_alpha(folder, view=0, covered=6):
    """Photographs with alpha: ``covered`` pixels of one corner in every view; nothing at all in ``view``."""
    for i in range(3):
        image = np.zeros((SIZE, SIZE, 4), np.float32)
        if i != view:
            image[:2, : covered // 2] = (0.5, 0.25, 1, 1)
        write_exr(folder / f"images/train_{i}.exr", image)
    return folder


def test_batches_are_a_function_of_seed_iteration_and_rank(folder):
    first, second = ready(folder, seed=4), ready(folder, seed=4)
    second.batch(0)
    same = second.batch(7, 1)
    assert torch.equal(first.batch(7, 1).pixel, same.pixel)
    assert torch.equal(first.batch(7, 1).view, same.view)
    for other in (first.batch(8, 1), first.batch(7, 0), ready(folder, seed=5).batch(7, 1)):
        assert not torch.equal(other.pixel, same.pixel)


@pytest.mark.parametrize("covered", [None, 0.5])
@pytest.mark.parametrize("patch_size", [1, 4])
def test_every_corner_is_drawn_once_before_any_is_drawn_again(patch_size, covered):
    """Whatever the batches are that the draws come in; with alpha each view has its own corners."""
    random = torch.rand(3, 42, generator=torch.Generator().manual_seed(1))
    alpha = None if covered is None else (random > covered).float()
    sampler = PatchSampler.build([(7, 6)] * 3, patch_size, alpha, 1)
    assert alpha is not None or sampler.count.tolist() == 3 * [(7 - patch_size + 1) * (6 - patch_size + 1)]
    most = int(sampler.count.max())
    drawn = [sampler.draw(first, 5) for first in range(0, 9 * most + 5, 5)]
    view, pixel = (torch.cat(parts)[:: patch_size**2] for parts in zip(*drawn, strict=True))
    for one, count in zip(sampler.views.tolist(), sampler.count.tolist(), strict=True):
        turns = pixel[view == one][: 3 * count].view(3, count).sort().values
        assert turns.diff().min() > 0
        assert (turns == turns[0]).all()


def test_draws_have_no_order_that_follows_the_image():
    """Of a view's consecutive corners half lie below the one before, within five standard deviations."""
    _, pixel = PatchSampler.build([(128, 128)], 1, None, 0).draw(0, 128 * 128)
    assert abs(float((pixel.diff() < 0).double().mean()) - 0.5) < 5 / (12 * 128 * 128) ** 0.5


def test_means_are_over_the_five_by_five_pixels_around():
    """A mean over 5 x 5 pixels, over the covered ones where there is an alpha."""
    image = torch.arange(48.0).view(1, 48, 1).expand(1, 48, 3).contiguous()
    whole = blurred(image, None, 8)
    grid = image.view(6, 8, 3)
    torch.testing.assert_close(whole.view(6, 8, 3)[2, 3], grid[0:5, 1:6].mean((0, 1)))
    torch.testing.assert_close(whole.view(6, 8, 3)[0, 0], grid[0:3, 0:3].mean((0, 1)))
    alpha = torch.zeros(1, 48)
    alpha[0, 8:24] = 1.0
    flat = blurred(0.5 * alpha.unsqueeze(-1).expand(1, 48, 3), alpha, 8)
    torch.testing.assert_close(flat, 0.5 * alpha.unsqueeze(-1).expand(1, 48, 3))


@pytest.mark.parametrize("patch_size", [1, 2, 3])
def test_at_least_half_of_the_pixels_are_foreground(folder, patch_size):
    data = ready(with_alpha(folder), patches=200, patch_size=patch_size)
    assert data.has_alpha
    for iteration in range(5):
        batch = data.batch(iteration)
        assert (batch.alpha > 0).float().mean() >= 0.5
        assert set(batch.view.tolist()) == {1, 2}, "a view without foreground says nothing"
    assert data.dataset_stats().mean_square_radiance == pytest.approx((0.25 + 0.0625 + 1) / 3, rel=1e-3)


def test_the_sun_in_one_pixel_is_not_the_unit(folder):
    plain = ready(folder)
    before = plain.dataset_stats().mean_square_radiance
    image = read_exr(plain.scene.train[1].image)
    image[3, 5] = 1e6
    write_exr(plain.scene.train[1].image, image, half=False)
    after = ready(folder).dataset_stats().mean_square_radiance
    bright = np.sort(np.square(image, dtype=np.float64).mean(-1).ravel())[int(0.99 * SIZE * SIZE) - 1]
    assert before < after < before + 1.01e4 * bright / (len(plain.scene.train) * SIZE * SIZE)


@pytest.mark.parametrize("alpha", [1.0, 0.9995, 1.001])
def test_alpha_of_one_everywhere_says_nothing(folder, alpha):
    plain = ready(folder)
    for view in plain.scene.train:
        whole = np.concatenate((read_exr(view.image), np.full((SIZE, SIZE, 1), alpha, np.float32)), -1)
        write_exr(view.image, whole, half=False)
    for resident in (None, 1):
        data = ready(folder, resident=resident)
        assert not data.has_alpha
        assert torch.equal(torch.stack([data._streamed(i) for i in range(3)]), plain.photographs)
        assert data.dataset_stats().covered == ()


@pytest.mark.parametrize("resident", [None, 2])
def test_alpha_of_some_photographs_counts_and_is_said(folder, resident, capsys):
    """One without alpha, one where it is 1, and one where it is 0 somewhere."""
    colours = ready(folder).photographs
    for i, alpha in ((1, np.ones((SIZE, SIZE, 1), np.float32)), (2, np.eye(SIZE, dtype=np.float32)[..., None])):
        path = folder / f"images/train_{i}.exr"
        write_exr(path, np.concatenate((read_exr(path)[..., :3] * alpha, alpha), -1), half=False)
    data = ready(folder, resident=resident)
    assert data.has_alpha
    read = data._streamed if data.streams else data._resident
    images = torch.stack([read(i) for i in range(3)])
    assert torch.equal(images[:2, :, :3], colours[:2])
    assert bool((images[:2, :, 3] == 1).all())
    assert torch.equal(images[2, :, 3], torch.eye(SIZE).flatten())
    data.dataset_stats()
    data.dataset_stats()
    said = "alpha is 1 everywhere in 2 of 3 photographs (train_0, train_1) and below it in others"
    assert capsys.readouterr().err.count(said) == 1


def test_few_foreground_pixels_are_still_found(folder):
    """One covered pixel fills a quarter of a 2 x 2 patch at most: those patches are the best there are."""
    data = ready(with_alpha(folder, covered=2), patches=64, patch_size=3)
    assert (data.batch(0).alpha.view(64, 9) > 0).any(1).all()


@pytest.mark.parametrize("resident", [None, 2])
def test_alpha_of_zero_everywhere_is_an_error(folder, resident):
    for i in range(3):
        write_exr(folder / f"images/train_{i}.exr", np.zeros((SIZE, SIZE, 4), np.float32))
    with pytest.raises(InputError, match="alpha is 0 in every training photograph"):
        ready(folder, resident=resident).batch(0)


def test_loader_continues_where_the_module_is(folder):
    data = ready(folder)
    data.trainer = SimpleNamespace(lightning_module=SimpleNamespace(iteration=41), global_rank=2)
    stream = iter(data.train_dataloader())
    for iteration in (41, 42):
        batch = next(stream)
        assert isinstance(batch, PixelBatch)
        assert batch.iteration == iteration
        assert torch.equal(batch.pixel, data.batch(iteration, 2).pixel)


def test_held_out_photographs_and_maps_are_never_opened(folder, monkeypatch):
    """Not even their headers: setting up every stage and drawing batches opens training photographs only."""
    for part in ("train", "test"):
        described = read_json(folder, part)
        for kind in ("albedo", "roughness"):
            (folder / kind).mkdir(exist_ok=True)
            for i, frame in enumerate(described["frames"]):
                name = f"{kind}/{part}_{i}.exr"
                (folder / name).write_text("opening this fails")
                frame[f"{kind}_path"] = name
        del described["w"], described["h"]
        write_json(folder, part, described)
    for i in range(2):
        (folder / f"images/test_{i}.exr").write_text("opening this fails")
    opened = []
    exr, plain = OpenEXR.File, open

    def record(path, *rest, **more):
        opened.append(str(path))
        return exr(path, *rest, **more)

    def record_plain(path, *rest, **more):
        opened.append(str(path))
        return plain(path, *rest, **more)

    monkeypatch.setattr(OpenEXR, "File", record)
    monkeypatch.setattr("builtins.open", record_plain)
    data = SceneData(DataSettings(str(folder)))
    for stage in ("fit", "validate", "test", "predict"):
        data.setup(stage)
    data.batch(0)
    assert list(data.val_dataloader()) == [torch.tensor([0]), torch.tensor([1])]
    images = {path.rpartition("/")[2] for path in opened if path.endswith(".exr")}
    assert images == {"train_0.exr", "train_1.exr", "train_2.exr"}


def test_a_batch_costs_little(folder):
    """About 0.2 ms for 4096 pixels, by the best of many; the bound leaves room for slow machines."""
    data = ready(folder, patches=4096)
    seconds = []
    for iteration in range(50):
        begin = time.perf_counter()
        data.batch(iteration)
        seconds.append(time.perf_counter() - begin)
    assert min(seconds) < 1e-3
