"""Batches of photographed pixels: which ones, in what order, and which files are opened."""

import numpy as np
import OpenEXR
import pytest
import torch
from helpers.tiny_scene import SIZE, as_png, read_json, ready, write_json, write_scene

from datamodules.image_cache import blurred
from datamodules.scene_data import SceneData
from datamodules.settings import DataSettings
from neurad.core.errors import InputError
from neurad.core.patch_sampler import PatchSampler, validation_pixels
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


# ---- training pixels that are never drawn: which ones, in memory and streamed


VIEWS = 5


@pytest.fixture
def views(tmp_path):
    return write_scene(tmp_path / "room", VIEWS)


def kept_apart(folder, **settings):
    return ready(folder, validation_pixels=0.1, **settings)


def drawn(data):
    """All (view, pixel) of enough batches to see every pixel."""
    batches = [data.batch(i) for i in range(-(-2 * VIEWS * SIZE * SIZE // data.settings.patches))]
    return set(
        zip(torch.cat([b.view for b in batches]).tolist(), torch.cat([b.pixel for b in batches]).tolist(), strict=True)
    )


def test_batches_draw_all_pixels_but_these_also_of_streamed_photographs(views):
    data = kept_apart(views)
    kept = data.validation_batch()
    apart = set(zip(kept.view.tolist(), kept.pixel.tolist(), strict=True))
    assert len(apart) == len(kept.view) == VIEWS * round(0.1 * SIZE * SIZE)
    found = drawn(data)
    assert not found & apart
    assert len(found | apart) == VIEWS * SIZE * SIZE
    assert torch.equal(kept.color, data.photographs[kept.view, kept.pixel])

    resident, streamed = kept_apart(views), kept_apart(views, resident=2, replace_every=1)
    ours, theirs = resident.validation_batch(), streamed.validation_batch()
    for name in ("view", "pixel", "color", "alpha"):
        assert torch.equal(getattr(ours, name), getattr(theirs, name))
    assert not drawn(streamed) & set(zip(theirs.view.tolist(), theirs.pixel.tolist(), strict=True))


def test_without_any_everything_stays_as_it_was_and_patches_have_none(views):
    data = ready(views)
    assert data.validation_batch() is None
    sizes = [(SIZE, SIZE)] * VIEWS
    assert torch.equal(data._sampler.corners, PatchSampler.build(sizes, 1, None, 0).corners)
    assert len(validation_pixels((SIZE, SIZE), 0, 0.0)) == 0

    assert kept_apart(views, patch_size=2).validation_batch() is None


# ---- what batches say of values that are clipped, rounded, or of a known spread


def batch_of(folder, **settings):
    data = ready(folder, patches=3 * SIZE * SIZE, **settings)
    return data, data.batch(0)


@pytest.mark.parametrize("resident", [None, 1])
def test_codes_are_clipped_and_rounded(tmp_path, resident):
    data, batch = batch_of(as_png(write_scene(tmp_path / "room"), 2.0), resident=resident)
    at_top = batch.color >= 1.0
    assert torch.equal(batch.clipped, at_top)
    assert 0.3 < float(at_top.float().mean()) < 0.7
    assert torch.equal(data.clipped(batch.view, batch.pixel), at_top)
    step = 2.4 / 1.055 * (batch.color.clamp_min(0.0031) ** (1 / 2.4)) ** 1.4 / 255
    middle = (batch.color > 0.05) & ~at_top
    ratio = batch.variance[middle] / (step[middle] ** 2 / 12)
    torch.testing.assert_close(ratio, torch.ones_like(ratio), rtol=0.05, atol=0)


def test_a_ceiling_that_is_given(tmp_path):
    _, batch = batch_of(write_scene(tmp_path / "room"), ceiling=0.75)
    assert torch.equal(batch.clipped, batch.color >= 0.75 * (1 - 1e-4))
    assert batch.variance is None


def test_photographs_that_are_clipped_everywhere(tmp_path, capfd):
    folder = as_png(write_scene(tmp_path / "room"), 1e6)
    with pytest.raises(InputError, match="every photograph is at its ceiling everywhere and says nothing"):
        batch_of(folder)
    other = write_scene(tmp_path / "other")
    write_exr(other / "images/train_1.exr", np.full((SIZE, SIZE, 3), 2.0, np.float32))
    batch_of(other, ceiling=1.5)
    assert "warning: at their ceiling everywhere, so they say nothing: train_1" in capfd.readouterr().err


def test_a_known_spread(tmp_path):
    folder = write_scene(tmp_path / "room")
    (folder / "spread").mkdir()
    spread = np.random.default_rng(1).random((SIZE, SIZE, 3), np.float32)
    write_exr(folder / "spread/train_1.exr", spread, half=False)
    data, batch = batch_of(folder)
    assert batch.clipped is None
    assert data.clipped(batch.view, batch.pixel) is None  # nothing says from where on photographs are clipped
    spread[0, 0], spread[0, 1, 0] = np.inf, np.inf
    write_exr(folder / "spread/train_1.exr", spread, half=False)
    data, batch = batch_of(folder)
    mine = batch.view == 1
    blown = np.isinf(spread)
    want = torch.from_numpy(np.ma.masked_array(spread, blown).mean(-1).filled(0.0)).view(-1)[batch.pixel[mine]] ** 2
    want = want.float().unsqueeze(-1).expand(-1, 3).clone()
    clipped = torch.from_numpy(blown).view(-1, 3)[batch.pixel[mine]]
    want[clipped] = 0.0  # a lower bound has none; the other channels of its pixel keep theirs
    torch.testing.assert_close(batch.variance[mine], want, rtol=0.01, atol=0)
    assert not bool(batch.variance[~mine].any())
    assert torch.equal(batch.clipped[mine], clipped)
    assert clipped.sum() == 4
    assert not bool(batch.clipped[~mine].any())
    assert torch.equal(data.clipped(batch.view, batch.pixel), batch.clipped)
    write_exr(folder / "spread/train_1.exr", spread[:4])
    with pytest.raises(InputError, match=r"spread/train_1\.exr: it has 8 x 4 pixels, its camera 8 x 8"):
        batch_of(folder)
    write_exr(folder / "spread/train_1.exr", -spread)
    with pytest.raises(InputError, match="negative or not a number"):
        batch_of(folder)
