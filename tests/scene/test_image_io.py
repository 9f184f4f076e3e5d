"""EXR, PNG and texture files, written and read back or against what other libraries write."""

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from neurad.core.errors import InputError
from neurad.scene.image_io import from_srgb, read_bitmap, read_exr, to_srgb, write_exr
from neurad.scene.photographs import read_photograph

HEADER = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}


def picture(channels, height=5, width=7):
    return np.random.default_rng(channels).random((height, width, channels), np.float32)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("half", [True, False])
def test_exr_round_trip(tmp_path, channels, half):
    image = picture(channels)
    write_exr(tmp_path / "a.exr", image, half)
    back = read_exr(tmp_path / "a.exr")
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, image.astype(np.float16).astype(np.float32) if half else image)


def test_exr_bytes_depend_on_the_pixels_only(tmp_path):
    image = picture(3)
    for name in ("a", "b"):
        write_exr(tmp_path / f"{name}.exr", image)
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_half_floats_saturate_instead_of_becoming_infinite(tmp_path):
    write_exr(tmp_path / "a.exr", np.full((2, 2, 3), 1e6, np.float32))
    assert read_exr(tmp_path / "a.exr").max() == 65504


@pytest.mark.parametrize("names", ["RGB", "RGBA", "Y", "V", ["room.R", "room.G", "room.B"], ["alpha.weight"]])
def test_channels_by_name(tmp_path, names):
    image = picture(len(names))
    channels = {name: np.ascontiguousarray(image[..., i]) for i, name in enumerate(names)}
    OpenEXR.File(dict(HEADER), channels).write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr"), image)


@pytest.mark.parametrize("names", ["XYZ", "RG", ["a.R", "b.G", "b.B"], ["R", "G", "B", "Z"]])
def test_other_channels_are_refused(tmp_path, names):
    channels = {name: np.zeros((3, 4), np.float32) for name in names}
    OpenEXR.File(dict(HEADER), channels).write(str(tmp_path / "a.exr"))
    with pytest.raises(InputError, match=r"a\.exr: its channels are"):
        read_exr(tmp_path / "a.exr")


@pytest.mark.parametrize("origin", [(2, 1), (-2, -1), (6, 4)])
def test_data_window_is_placed_in_the_display_window(tmp_path, origin):
    """Data of 4 x 3 pixels at ``origin`` of a picture of 8 x 6: inside, cut at the first corner and at the last."""
    data = picture(1, 3, 4)[..., 0] + 1
    x, y = origin
    header = {**HEADER, "dataWindow": ((x, y), (x + 3, y + 2)), "displayWindow": ((0, 0), (7, 5))}
    OpenEXR.File(header, {"Y": data}).write(str(tmp_path / "a.exr"))
    want = np.zeros((6, 8), np.float32)
    for j in range(3):
        for i in range(4):
            if 0 <= y + j < 6 and 0 <= x + i < 8:
                want[y + j, x + i] = data[j, i]
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[..., 0], want)


def test_missing_and_unreadable_exr(tmp_path):
    with pytest.raises(InputError, match=r"none\.exr: there is no such file"):
        read_exr(tmp_path / "none.exr")
    (tmp_path / "text.exr").write_text("no picture")
    with pytest.raises(InputError, match=r"text\.exr: it cannot be read"):
        read_exr(tmp_path / "text.exr")
    write_exr(tmp_path / "cut.exr", picture(3, 64, 64))
    whole = (tmp_path / "cut.exr").read_bytes()
    (tmp_path / "cut.exr").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"cut\.exr: it cannot be read"):
        read_exr(tmp_path / "cut.exr")


@pytest.mark.parametrize(
    ("value", "said"), [(np.nan, "NaN or infinite"), (np.inf, "NaN or infinite"), (-0.5, "negative")]
)
def test_photographs_with_bad_pixels(tmp_path, value, said):
    image = picture(3)
    image[2, 3, 1] = value
    write_exr(tmp_path / "bad.exr", image, half=False)
    with pytest.raises(InputError, match=rf"bad\.exr: it has .*{said}"):
        read_photograph(tmp_path / "bad.exr")


def test_a_photograph_has_colour(tmp_path):
    write_exr(tmp_path / "grey.exr", picture(1))
    with pytest.raises(InputError, match=r"grey\.exr: a photograph has channels RGB or RGBA"):
        read_photograph(tmp_path / "grey.exr")


def test_srgb_curve_and_its_inverse():
    x = np.linspace(0, 1, 1001, dtype=np.float32)
    np.testing.assert_allclose(from_srgb(to_srgb(x)), x, atol=2e-6)
    np.testing.assert_allclose(to_srgb(np.array([-1.0, 0.002, 0.5, 7.0])), [0, 0.02584, 0.735357, 1], atol=1e-5)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_a_png_is_read_as_linear_values(tmp_path, channels):
    image = picture(channels)
    shown = np.round(to_srgb(image) * 255.0).astype(np.uint8)
    Image.fromarray(shown[..., 0] if channels == 1 else shown).save(tmp_path / "a.png")
    back = read_bitmap(tmp_path / "a.png")
    assert back.shape[2] == min(channels, 3)
    np.testing.assert_allclose(to_srgb(back), to_srgb(image[..., :3]), atol=0.51 / 255)


def test_bitmaps_of_16_bits_keep_them(tmp_path):
    grey = np.random.default_rng(0).integers(0, 65536, (3, 4), dtype=np.uint16)
    Image.fromarray(grey).save(tmp_path / "a.png")
    np.testing.assert_allclose(read_bitmap(tmp_path / "a.png", raw=True)[..., 0], grey / 65535, atol=1e-7)
    np.testing.assert_allclose(read_bitmap(tmp_path / "a.png")[..., 0], from_srgb(grey / 65535), atol=1e-6)


def test_exr_bitmaps_are_linear_whatever_raw_says(tmp_path):
    image = picture(4)
    write_exr(tmp_path / "a.exr", image, half=False)
    for raw in (False, True):
        np.testing.assert_array_equal(read_bitmap(tmp_path / "a.exr", raw), image[..., :3])


def test_missing_and_unreadable_bitmaps(tmp_path):
    with pytest.raises(InputError, match=r"none\.png: there is no such texture"):
        read_bitmap(tmp_path / "none.png")
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(InputError, match=r"text\.png: it cannot be read"):
        read_bitmap(tmp_path / "text.png")
