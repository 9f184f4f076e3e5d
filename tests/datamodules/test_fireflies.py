"""Fireflies of photographs: which pixels are ones, and where their light goes."""

import numpy as np
import pytest
import torch
from helpers.tiny_fit import fit, write_tiny_config
from helpers.tiny_scene import SIZE, ready, write_scene

from benchmarks.photos import PhotosInMemory
from datamodules.fireflies import RATIO, WORTH, Fireflies, spread_fireflies
from neurad.images.image_io import read_exr, write_exr

WIDTH, HEIGHT = 40, 30


def photograph(seed=0, noise=0.2):
    """Dark and bright halves with a little noise [h * w, 3]."""
    rng = np.random.default_rng(seed)
    image = np.where(np.arange(WIDTH) < WIDTH // 2, 0.1, 1.0)[None, :, None] * np.array([1.0, 0.5, 0.2])
    image = image * (1.0 + noise * rng.random((HEIGHT, WIDTH, 1)))
    return torch.from_numpy(image.astype(np.float32)).reshape(-1, 3)


def at(x, y):
    return y * WIDTH + x


def none_left_out(count=HEIGHT * WIDTH):
    return torch.zeros(count, dtype=torch.bool)


def test_a_clean_photograph_is_the_same_object():
    clean = photograph()
    clean.view(HEIGHT, WIDTH, 3)[:, 7] = 30.0  # a bright line of one pixel's width
    clean.view(HEIGHT, WIDTH, 3)[12, :] = 30.0
    clean.view(HEIGHT, WIDTH, 3)[range(20), range(20, 40)] = 30.0
    assert spread_fireflies(clean, none_left_out(), WIDTH) is clean
    assert Fireflies.measure(lambda _: clean, none_left_out().expand(1, -1), [WIDTH]) == Fireflies(0, 0.0)


@pytest.mark.parametrize("places", [[(9, 9)], [(20, 0), (1, 1), (39, 20)], [(19, 15), (20, 15), (21, 15)]])
def test_the_light_of_every_channel_stays_and_the_spike_goes(places):
    clean = photograph()
    spoilt = clean.clone()
    for x, y in places:
        spoilt[at(x, y)] = torch.tensor([40.0, 5.0, 0.0])
    found = spread_fireflies(spoilt, none_left_out(), WIDTH)
    torch.testing.assert_close(found.sum(0), spoilt.sum(0), rtol=1e-5, atol=0.0)
    assert float(found.mean(-1).max()) < 3.0 * float(clean.mean(-1).max())  # 23 times before
    assert float(found.min()) >= 0.0
    # What others receive is in proportion to what they have: a tenth of it from each firefly at the most.
    rest = torch.ones(len(clean), dtype=torch.bool)
    rest[[at(x, y) for x, y in places]] = False
    gained = (found.mean(-1) / clean.mean(-1))[rest]
    assert 1.0 - 1e-5 <= float(gained.min()) <= float(gained.max()) <= 1.0 + 0.1 * len(places) + 1e-5


def test_what_is_left_out_neither_gives_nor_takes():
    image = photograph()
    image[at(10, 10)] = 500.0  # a lamp
    image[at(14, 10)] = 5.0  # a firefly beside it
    left_out = none_left_out()
    left_out[at(10, 10)] = True
    found = spread_fireflies(image, left_out, WIDTH)
    torch.testing.assert_close(found[left_out], image[left_out], rtol=0.0, atol=0.0)
    assert float(found[at(14, 10)].max()) < 1.0
    torch.testing.assert_close(found[~left_out].sum(0), image[~left_out].sum(0), rtol=1e-5, atol=0.0)


def test_one_pixel_does_not_outweigh_the_photograph():
    image = photograph()
    image[at(5, 5)] = 1e6
    found = spread_fireflies(image, none_left_out(), WIDTH)
    assert float(found.sum() / photograph().sum()) == pytest.approx(1.1, abs=0.01)


def spoil(folder, views=3):
    """Write photographs with a firefly each, and return them with what they are to become."""
    rng = np.random.default_rng(5)
    images = rng.uniform(0.4, 0.6, (views, SIZE, SIZE, 3)).astype(np.float32)
    images[:, 3, 4] = 40.0
    for i, image in enumerate(images):
        write_exr(folder / f"images/train_{i}.exr", image, half=False)
    return torch.from_numpy(np.stack([read_exr(folder / f"images/train_{i}.exr") for i in range(views)])).flatten(1, 2)


@pytest.fixture
def folder(tmp_path):
    pytest.importorskip("mitsuba")
    return write_scene(tmp_path / "room")


def test_streamed_and_resident_photographs_become_the_same(folder):
    raw = spoil(folder)
    left_out = torch.zeros(raw.shape[:2], dtype=torch.bool)
    left_out[1, 0] = True
    expected = torch.stack([spread_fireflies(image, mask, SIZE) for image, mask in zip(raw, left_out, strict=True)])
    for settings in ({}, {"resident": 2, "replace_every": 1}):
        data = ready(folder, patches=200, **settings)
        before = data.dataset_stats(left_out)
        data.batch(0)
        for _ in range(2):  # the second time changes nothing
            assert data.spread_fireflies(left_out) > 0.5
        after = data.dataset_stats(left_out)
        assert after.checksums == before.checksums  # those of the files
        assert after.mean_square_radiance == pytest.approx(
            float(expected[~left_out].square().mean()), rel=1e-5
        )  # fmt: skip
        batch = data.batch(3)
        assert torch.equal(batch.color, expected[batch.view, batch.pixel]), settings


def test_few_fireflies_are_kept_bit_for_bit():
    clean = torch.stack([photograph(i) for i in range(3)])
    spoilt = clean.clone()
    spoilt[1, at(30, 10)] *= 3.0 * RATIO
    for images in (clean, spoilt):
        photos = PhotosInMemory(images, WIDTH)
        assert photos.spread_fireflies(torch.zeros(images.shape[:2], dtype=torch.bool)) == 0.0
        assert photos.photographs is images
    assert (
        0.0 < Fireflies.measure(lambda v: spoilt[v], torch.zeros(3, HEIGHT * WIDTH).bool(), [WIDTH] * 3).light < WORTH
    )


def test_what_may_be_a_small_light_is_asked_for_only_where_it_matters_and_stays():
    spoilt = torch.stack([photograph(i) for i in range(3)])
    spoilt[:, at(30, 10)] = 500.0  # a lamp in a mirror
    spoilt[:, at(10, 10)] = 500.0  # a firefly
    none, beyond = torch.zeros(2, 3, HEIGHT * WIDTH, dtype=torch.bool).unbind()
    beyond[:, at(30, 10)] = True
    photos = PhotosInMemory(spoilt, WIDTH)
    assert photos.spread_fireflies(none, lambda: beyond) > WORTH
    assert torch.equal(photos.photographs[beyond], spoilt[beyond])
    assert float(photos.photographs[:, at(10, 10)].max()) < 5.0
    spoilt[:, at(10, 10)] = 0.1
    photos = PhotosInMemory(spoilt, WIDTH)
    assert photos.spread_fireflies(none, lambda: beyond) == 0.0
    assert photos.photographs is spoilt

    def never():
        raise AssertionError

    assert PhotosInMemory(torch.stack([photograph(i) for i in range(3)]), WIDTH).spread_fireflies(none, never) == 0.0


def test_a_fit_says_once_that_it_spreads_them(folder, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    spoil(folder)
    write_tiny_config(data={"patches": 16, "scene": None, "root": str(folder)})
    fit("--trainer.max_steps", "1")
    assert capsys.readouterr().err.count("far brighter than all around") == 1
