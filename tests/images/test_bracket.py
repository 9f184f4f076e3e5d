"""Brackets merged to linear EXR: simulated sensors, files, and what is refused."""

import struct

import cv2
import numpy as np
import pytest
from helpers.tiff import longs, shorts, tiff
from helpers.tiny_fit import fails
from PIL import Image

from neurad.cli import main
from neurad.images.hdr import FULL_WELL, READ_NOISE, merge
from neurad.images.image_io import read_exr, to_srgb

TIMES = [1 / 1000, 1 / 250, 1 / 60, 1 / 15, 1 / 4]
PATCH = 32
"""Side of a patch of one radiance in pixels."""


def scene(levels=24):
    """Patches [PATCH, levels * PATCH, 3] from what the longest exposure shows with 400 electrons to what only the
    shortest one shows, and the radiance of each patch [levels, 3].
    """
    low, high = 0.02 / TIMES[-1], 0.9 / TIMES[0]
    values = np.geomspace(low, high, levels)[:, None] * [1.0, 0.8, 0.6]
    return np.broadcast_to(np.repeat(values, PATCH, 0), (PATCH, levels * PATCH, 3)), values


def exposed(radiance, time, rng, bits=14):
    """What a sensor says: shot noise of electrons, noise of reading, a ceiling, codes."""
    electrons = rng.poisson(radiance * time * FULL_WELL) + rng.normal(0, READ_NOISE, radiance.shape)
    codes = np.round(np.clip(electrons / FULL_WELL, 0, 1) * (2**bits - 1))
    return codes / (2**bits - 1)


def patch_means(picture):
    return picture.reshape(PATCH, -1, PATCH, 3).mean((0, 2))


def test_five_raw_exposures_merge_within_one_percent():
    """Everywhere but where all are clipped; the stated spread is that of the pixels."""
    rng = np.random.default_rng(5)
    radiance, values = scene()
    found, spread, clipped = merge([exposed(radiance, time, rng) for time in TIMES], TIMES)
    assert not clipped.any()
    means = patch_means(found)
    error = np.abs(means / values - 1)
    noise = patch_means(spread) / values / PATCH  # of a patch's mean
    assert (error < 0.01).all()
    assert (
        error < 4.5 * noise + 4e-3
    ).all()  # 72 patches; of a sample near its ceiling noise decides whether it counts
    relative = (found - radiance) / spread
    assert np.std(relative) == pytest.approx(1, abs=0.05)


# ---- files


def brackets(folder, ending=".tif", exif=False):
    """Photographs of one view in 16 bits, linear, or in 8 by sRGB's curve."""
    folder.mkdir()
    rng = np.random.default_rng(8)
    radiance, values = scene()
    files = []
    for index, time in enumerate(TIMES):
        path = folder / f"{index}{ending}"
        linear = exposed(radiance, time, rng)
        if ending == ".tif":
            cv2.imwrite(str(path), np.round(linear * 65535).astype(np.uint16)[..., ::-1])
        else:
            entries = Image.Exif()
            entries[0x0110] = "camera"
            if exif:
                entries.get_ifd(0x8769).update({0x829A: time})
            Image.fromarray(np.round(to_srgb(linear) * 255).astype(np.uint8)).save(path, exif=entries)
        files.append(str(path))
    return files, values


def data(*words):
    main(["data", "hdr", *map(str, words)])


def test_files_with_times(tmp_path, capfd):
    files, values = brackets(tmp_path / "raw")
    data(*files, "--times", *TIMES, "--response", "linear", "--out", tmp_path / "images")
    assert (np.abs(patch_means(read_exr(tmp_path / "images/0.exr")) / values - 1) < 0.01).all()
    assert np.median(read_exr(tmp_path / "spread/0.exr") / np.repeat(values, PATCH, 0)) < 0.02
    said = capfd.readouterr().out
    assert "5 photographs, exposures 0.001 to 0.25" in said
    assert "--data.ceiling 999" in said
    assert "is there already" in fails(capfd, "data", "hdr", *files, "--times", *TIMES, "--out", tmp_path / "images")


def test_codes_with_exif(tmp_path, capfd):
    files, values = brackets(tmp_path / "raw", ".png", exif=True)
    data(*files, "--out", tmp_path / "images")
    assert "sRGB's curve is undone, as nothing else is said" in capfd.readouterr().out
    assert (np.abs(patch_means(read_exr(tmp_path / "images/0.exr")) / values - 1) < 0.015).all()


def test_several_views(tmp_path):
    files, _ = brackets(tmp_path / "raw")
    data(*files[:4], "--bracket", 2, "--times", 1, 4, "--response", "linear", "--out", tmp_path / "images")
    assert sorted(path.name for path in (tmp_path / "images").iterdir()) == ["0.exr", "2.exr"]


def test_what_cannot_be_merged(tmp_path, capfd):
    files, _ = brackets(tmp_path / "raw", ".png")
    out = ["--out", tmp_path / "images"]
    said = fails(capfd, "data", "hdr", *files, *out)
    assert "0.png: its EXIF has no exposure time; give those of a view with --times" in said
    assert "--times: there are 2 exposures for the 5" in fails(capfd, "data", "hdr", *files, *out, "--times", 1, 2)
    assert "--times" in fails(capfd, "data", "hdr", *files, *out, "--times", 1, 2, 4, 8, -16)
    assert "--bracket 2: 5 photographs" in fails(capfd, "data", "hdr", *files, *out, "--bracket", 2)
    assert "--mesh: it is for scene folders" in fails(capfd, "data", "hdr", *files, *out, "--mesh", "a.obj")
    assert "--close-holes: it is for scene" in fails(capfd, "data", "hdr", *files, *out, "--close-holes", "1")
    assert "choose linear, srgb" in fails(capfd, "data", "hdr", *files, *out, "--response", "other")
    assert "a merge has to know it" in fails(capfd, "data", "hdr", *files, *out, "--response", "fit")
    (tmp_path / "a.exr").write_bytes(b"x")
    assert "not from .exr" in fails(capfd, "data", "hdr", tmp_path / "a.exr", *out, "--times", 1)
    (tmp_path / "a.nef").write_bytes(b"x")
    assert "a.nef" in fails(capfd, "data", "hdr", tmp_path / "a.nef", *out, "--times", 1)
    Image.new("RGB", (4, 4)).save(tmp_path / "small.png")
    said = fails(capfd, "data", "hdr", files[0], tmp_path / "small.png", *out, "--times", 1, 2)
    assert "small.png: it has 4 x 4 pixels, but" in said
    capfd.readouterr()
    with pytest.raises(SystemExit):
        main(["data", "colmap", str(tmp_path), str(tmp_path), "--out", str(tmp_path / "x")])
    assert "takes one folder, not 2" in capfd.readouterr().err


SRGB = [32405, -15371, -4985, -9693, 18760, 416, 556, -2040, 10572]
"""sRGB of XYZ, ten thousandths."""


def dng(path, mosaic, white, time=None):
    """A small raw file, uncompressed, of 16 bits: a mosaic, red first, or with three colours a pixel.

    Args:
        path: of the file.
        mosaic: codes [h, w] or [h, w, 3].
        white: largest code.
        time: exposure time in seconds for EXIF; None writes none.
    """
    height, width = mosaic.shape[:2]
    linear = mosaic.ndim == 3
    matrix = struct.pack("<18i", *[number for value in SRGB for number in (value, 10000)])
    entries = [
        (254, 4, longs(0)), (256, 4, longs(width)), (257, 4, longs(height)),
        (258, 3, shorts(*[16] * (3 if linear else 1))), (259, 3, shorts(1)),
        (262, 3, shorts(34892 if linear else 32803)), (271, 2, b"None\0"), (272, 2, b"None\0"),
        (277, 3, shorts(3 if linear else 1)), (278, 4, longs(height)),
        *([] if linear else [(33421, 3, shorts(2, 2)), (33422, 1, bytes((0, 1, 1, 2)))]),
        *([] if time is None else [(33434, 5, longs(round(1e6 * time), 1000000))]),
        (50706, 1, bytes((1, 4, 0, 0))), (50708, 2, b"None\0"),
        (50714, 3, shorts(*[0] * (3 if linear else 1))), (50717, 3, shorts(*[white] * (3 if linear else 1))),
        (50721, 10, matrix), (50728, 5, longs(*[10000] * 6)), (50778, 3, shorts(21)),
    ]  # fmt: skip
    path.write_bytes(tiff(entries, [mosaic.astype("<u2").tobytes()]))


def test_raw_files(tmp_path):
    """Grey patches through a mosaic: the merged picture has their radiance, up to a factor that all share."""
    pytest.importorskip("rawpy")
    rng = np.random.default_rng(9)
    radiance, values = scene()
    grey = radiance[..., 0]
    files = []
    for index, time in enumerate(TIMES):
        files.append(tmp_path / f"{index}.dng")
        dng(files[-1], np.round(exposed(grey, time, rng) * 16383), 16383)
    data(*files, "--times", *TIMES, "--out", tmp_path / "images")
    found = read_exr(tmp_path / "images/0.exr")
    inner = found.reshape(PATCH, -1, PATCH, 3)[4:-4, :, 4:-4].mean((0, 2))  # colours are interpolated between patches
    ratio = inner / values[:, :1]
    assert np.abs(ratio / np.median(ratio) - 1).max() < 0.01
    assert np.median(ratio) == pytest.approx(1, abs=0.02)


def mosaic_of(colors):
    """What each photosite says, red first, of colours [h, w, 3] in [0, 1]."""
    codes = np.round(np.clip(colors, 0, 1) * 16383)
    found = codes[..., 1].copy()
    found[::2, ::2], found[1::2, 1::2] = codes[::2, ::2, 0], codes[1::2, 1::2, 2]
    return found


def test_what_raw_files_clip_in_one_colour_says_nothing(tmp_path, capfd):
    """Conversion to other primaries mixes it into all: it is no lower bound of them, nor is what lies around it."""
    pytest.importorskip("rawpy")
    colors = np.full((64, 96, 3), 0.02)
    colors[16:48, 16:40] = 1.5, 0.4, 0.1
    colors[16:48, 56:80] = 2.0
    dng(tmp_path / "0.dng", mosaic_of(colors), 16383, time=0.5)
    data(tmp_path / "0.dng", "--out", tmp_path / "images")
    found, spread = read_exr(tmp_path / "images/0.exr"), read_exr(tmp_path / "spread/0.exr")
    assert "exposures 0.5 to 0.5" in capfd.readouterr().out  # of the raw file's own EXIF
    ceiling = 1 / 0.5
    assert (found[20:44, 20:36] < 0.999 * ceiling).all()
    assert (spread[20:44, 20:36] > 100 * ceiling).all()
    assert np.isfinite(spread[:, :50]).all()
    white = found[20:44, 60:76]
    assert (white == ceiling).all()
    assert np.isinf(spread[20:44, 60:76]).all()
    ring = spread[14:50, 14] > 100  # two steps beside the patch
    assert ring.any()
    dark = found[:10]
    np.testing.assert_allclose(dark, 0.02 / 0.5, rtol=0.02)
    assert (spread[:10] < 0.1).all()


def test_a_sensor_that_is_full_before_its_range_ends(tmp_path, monkeypatch):
    """What is clipped in all colours is as bright as the sensor's own level or more, not as the range's end."""
    pytest.importorskip("rawpy")
    from neurad.images import hdr

    class Raw:
        white_level, camera_white_level_per_channel = 16383, [15360] * 4
        black_level_per_channel, camera_whitebalance = [0] * 4, [2.0, 1.0, 1.4, 0.0]
        raw_image_visible = np.full((8, 8), 15500)
        raw_colors_visible = np.array([[0, 1], [3, 2]]).repeat(4, 0).repeat(4, 1)

    full, level = hdr._full(Raw)
    assert full.all()
    assert level == pytest.approx(15360 / 16383)
    Raw.raw_image_visible = np.full((8, 8), 12000)
    full, _ = hdr._full(Raw)
    np.testing.assert_array_equal(full, np.isin(Raw.raw_colors_visible, (0, 2)))  # green alone is not
    y, mask = np.full((1, 2, 2, 3), 0.93), np.ones((1, 2, 2, 3), bool)
    found, spread, clipped = merge(y, [2.0], clipped=mask)
    np.testing.assert_allclose(found, 0.93 / 2)
    assert clipped.all()
    assert np.isinf(spread).all()


def test_raw_files_without_a_mosaic(tmp_path):
    """What telephones and merging programs write."""
    pytest.importorskip("rawpy")
    colors = np.full((32, 32, 3), 0.1) * [1, 2, 3]
    colors[8:24, 8:24] = 1.0
    dng(tmp_path / "0.dng", np.round(colors * 16383), 16383, time=0.25)
    data(tmp_path / "0.dng", "--out", tmp_path / "images")
    found, spread = read_exr(tmp_path / "images/0.exr"), read_exr(tmp_path / "spread/0.exr")
    np.testing.assert_allclose(found[:4], np.broadcast_to(colors[:4] / 0.25, (4, 32, 3)), rtol=0.02)
    assert np.isinf(spread[10:22, 10:22]).all()
    assert np.isfinite(spread[:4]).all()


def test_no_view_is_written_over_another(tmp_path, capfd):
    files, _ = brackets(tmp_path / "raw")
    other, _ = brackets(tmp_path / "raw2")
    words = ["--bracket", 2, "--times", 1, 4, "--response", "linear", "--out"]
    said = fails(capfd, "data", "hdr", *files[:2], *other[:2], *words, tmp_path / "images")
    assert "raw/0.tif" in said
    assert "raw2/0.tif are alike" in said
    data(*files[:2], *words, tmp_path / "a")
    assert "spread/0.exr is there already" in fails(capfd, "data", "hdr", *other[:2], *words, tmp_path / "b")
