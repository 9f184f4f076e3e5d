"""EXR, PNG and texture files, written and read back or against what other libraries write."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from neurad.core.errors import InputError
from neurad.core.scene_records import Camera, View
from neurad.images.image_io import data_window, from_srgb, read_bitmap, read_exr, to_srgb, write_exr
from neurad.images.photographs import kept_pixels, read_photograph
from neurad.images.picture_notes import say_pictures

CASES = Path(__file__).resolve().parents[3] / "shared/cases"
HEADER = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}


@pytest.fixture(autouse=True)
def said(capsys):
    """Nothing that tests before have read waits to be said."""
    say_pictures()
    capsys.readouterr()


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


@pytest.mark.parametrize(
    ("factor", "half"),
    [(1.0, True), (6e4, True), (1e6, False), (1e-3, True), (1e-7, False)],
    ids=["usual", "bright", "too bright", "dim", "too dim"],
)
def test_half_floats_are_written_where_they_hold_the_values(tmp_path, factor, half):
    image = factor * picture(3, 40, 50)
    write_exr(tmp_path / "a.exr", image)
    kind = next(iter(OpenEXR.File(str(tmp_path / "a.exr")).channels().values())).pixels.dtype
    assert kind == (np.float16 if half else np.float32)
    step = 2.0**-11 * np.maximum(image, np.median(image))  # the rounding of half floats, below the median its own
    assert (np.abs(read_exr(tmp_path / "a.exr") - image) <= step).all()


@pytest.mark.parametrize("names", ["RGB", "RGBA", "Y", "V", ["room.R", "room.G", "room.B"], ["alpha.weight"]])
def test_channels_by_name(tmp_path, names):
    image = picture(len(names))
    channels = {name: np.ascontiguousarray(image[..., i]) for i, name in enumerate(names)}
    OpenEXR.File(dict(HEADER), channels).write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr"), image)


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ("XYZ", "its channels are"),
        ("RG", "its channels are"),
        (["a.R", "b.G", "b.B"], "its channels are"),
        (["Y", "Z"], "its channels are"),
        ([f"{layer}.Combined.{c}" for layer in ("left", "right") for c in "RGB"],
         "it has several pictures, left.Combined, right.Combined"),
        ([f"{layer}.{c}" for layer in ("diffuse", "specular") for c in "RGB"],
         "it has several pictures, diffuse, specular"),
    ],
)  # fmt: skip
def test_other_channels_are_refused(tmp_path, names, said):
    OpenEXR.File(dict(HEADER), {name: np.zeros((3, 4), np.float32) for name in names}).write(str(tmp_path / "a.exr"))
    with pytest.raises(InputError, match=rf"a\.exr: {said}"):
        read_exr(tmp_path / "a.exr")


@pytest.mark.parametrize("origin", [(2, 1), (-2, -1), (6, 4), (-1, -1)])
def test_data_window_is_placed_in_the_display_window(tmp_path, origin):
    """Data of 4 x 3 pixels at ``origin`` of a picture of 8 x 6: inside, cut at the first corner and at the last.
    Outside they are those of the edge, and known to be made up.
    """
    data = picture(1, 3, 4)[..., 0] + 1
    x, y = origin
    header = {**HEADER, "dataWindow": ((x, y), (x + 3, y + 2)), "displayWindow": ((0, 0), (7, 5))}
    OpenEXR.File(header, {"Y": data}).write(str(tmp_path / "a.exr"))
    want, known = np.zeros((6, 8), np.float32), np.zeros((6, 8), bool)
    for j in range(6):
        for i in range(8):
            want[j, i] = data[min(max(j - y, 0), 2), min(max(i - x, 0), 3)]
            known[j, i] = 0 <= j - y < 3 and 0 <= i - x < 4
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[..., 0], want)
    np.testing.assert_array_equal(data_window(tmp_path / "a.exr"), known)


def test_a_larger_data_window_is_cut_and_one_outside_is_refused(tmp_path):
    image = picture(3, 9, 12)
    header = {**HEADER, "dataWindow": ((-2, -1), (9, 7)), "displayWindow": ((0, 0), (6, 4))}
    OpenEXR.File(header, {"RGB": image}).write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr"), image[1:6, 2:9])
    assert data_window(tmp_path / "a.exr") is None

    header = {**HEADER, "dataWindow": ((8, 0), (11, 2)), "displayWindow": ((0, 0), (7, 5))}
    OpenEXR.File(header, {"RGB": picture(3, 3, 4)}).write(str(tmp_path / "a.exr"))
    with pytest.raises(InputError, match=r"a\.exr: its data window lies outside"):
        data_window(tmp_path / "a.exr")


def test_a_cut_photograph_of_another_size_than_its_camera_is_refused(tmp_path):
    """Which pixels it has is asked before it is read."""
    header = {**HEADER, "dataWindow": ((2, 1), (5, 3)), "displayWindow": ((0, 0), (7, 5))}
    OpenEXR.File(header, {"RGB": picture(3, 3, 4)}).write(str(tmp_path / "a.exr"))
    view = View("a", Camera(np.eye(4, dtype=np.float32), 0.8, 8, 6), image=str(tmp_path / "a.exr"))
    assert kept_pixels(view).sum() == 12
    with pytest.raises(InputError, match=r"a\.exr: it has 8 x 6 pixels, its camera 8 x 4; calibrate"):
        kept_pixels(replace(view, camera=replace(view.camera, height=4)))


PASSES = ["Depth.Z", "Normal.X", "Normal.Y", "Normal.Z", "DiffCol.R", "DiffCol.G", "DiffCol.B"]


@pytest.mark.parametrize(
    ("names", "prefix"),
    [
        (["R", "G", "B", "Z"], ""),
        (["R", "G", "B", "A", "albedo.R", "albedo.G", "albedo.B", "Z"], ""),
        ([f"ViewLayer.{name}" for name in ["Combined.R", "Combined.G", "Combined.B", "Combined.A", *PASSES]],
         "ViewLayer.Combined."),
        ([f"{layer}.Combined.{c}" for layer in ("Composite", "Raum 1", "Raum 2") for c in "RGBA"],
         "Composite.Combined."),
        (["r", "g", "b", "z"], ""),
        (["beauty.R", "beauty.G", "beauty.B", "depth.Z"], "beauty."),
    ],
    ids=["depth", "plain beside layers", "Blender", "Blender's compositor", "small letters", "one layer of colours"],
)  # fmt: skip
@pytest.mark.parametrize("several", [False, True], ids=["one part", "parts"])
def test_the_picture_among_layers(tmp_path, names, prefix, several):
    """The right one of several layers, in one part or each layer in a part of its own."""
    images = {name: picture(1)[..., 0] + index for index, name in enumerate(names)}
    if several:
        layers = {}
        for name, pixels in images.items():
            layer, _, channel = name.rpartition(".")
            layers.setdefault(layer or "rgba", {})[channel] = pixels
        parts = [OpenEXR.Part({**HEADER, "name": layer}, channels) for layer, channels in layers.items()]
        OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    else:
        OpenEXR.File(dict(HEADER), dict(images)).write(str(tmp_path / "a.exr"))
    wanted = [images[n] for c in "RGBA" for n in (prefix + c, prefix + c.lower()) if n in images]
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr"), np.stack(wanted, -1))


WHITE, ACES = (0.3127, 0.3290), (0.32168, 0.33767)
PRIMARIES = {  # by the matrices that colour-science gives for Bradford's adaptation, from Rec.709
    "ACEScg (AP1)": ((0.713, 0.293, 0.165, 0.830, 0.128, 0.044, *ACES),
        [[0.6130974, 0.3395231, 0.0473795], [0.0701937, 0.9163539, 0.0134524], [0.0206156, 0.1095698, 0.8698147]]),
    "ACES2065-1 (AP0)": ((0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, *ACES),
        [[0.4396330, 0.3829889, 0.1773782], [0.0897764, 0.8134394, 0.0967842], [0.0175412, 0.1115466, 0.8709123]]),
    "Rec.2020": ((0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *WHITE),
        [[0.6274039, 0.3292830, 0.0433131], [0.0690973, 0.9195404, 0.0113623], [0.0163914, 0.0880133, 0.8955953]]),
    "P3 D65": ((0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *WHITE),
        [[0.8224620, 0.1775380, 0.0], [0.0331942, 0.9668058, 0.0], [0.0170826, 0.0723974, 0.9105199]]),
    "CIE XYZ": ((1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3),
        [[0.4123908, 0.3575843, 0.1804808], [0.2126390, 0.7151687, 0.0721923], [0.0193308, 0.1191948, 0.9505322]]),
}  # fmt: skip


def by_primaries(path, image, chromaticities, **more):
    OpenEXR.File({**HEADER, "chromaticities": chromaticities, **more}, {"RGBA"[: image.shape[2]]: image}).write(
        str(path)
    )


@pytest.mark.parametrize("name", PRIMARIES)
@pytest.mark.parametrize("channels", [3, 4])
def test_colours_become_those_of_rec_709(tmp_path, capsys, name, channels):
    chromaticities, matrix = PRIMARIES[name]
    image = picture(channels)
    there = image.copy()
    there[..., :3] = image[..., :3] @ np.array(matrix, np.float32).T
    by_primaries(tmp_path / "a.exr", there, chromaticities)
    for _ in range(2):
        np.testing.assert_allclose(read_exr(tmp_path / "a.exr"), image, atol=2e-5)
    say_pictures()
    said = capsys.readouterr().err
    assert said == f"neurad: a.exr: colours by the primaries of {name} are converted to linear Rec.709\n"
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr", raw=True), there)


@pytest.mark.parametrize("chromaticities", [(0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.312727, 0.329024), None])
def test_primaries_of_rec_709_say_nothing(tmp_path, capsys, chromaticities):
    image = picture(3)
    header = {**HEADER, **({} if chromaticities is None else {"chromaticities": chromaticities})}
    OpenEXR.File(header, {"RGB": image}).write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr"), image)
    say_pictures()
    assert capsys.readouterr().err == ""


def test_primaries_that_are_none_and_colours_outside(tmp_path, capsys):
    image = picture(3)
    by_primaries(tmp_path / "a.exr", image, (0.0,) * 8)
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr"), image)
    say_pictures()
    assert "a.exr: its chromaticities are those of no primaries" in capsys.readouterr().err

    image = np.full((4, 5, 3), 0.5, np.float32)
    image[1, 2] = 0.0, 1.0, 0.0  # green of Rec.2020 is outside in red and blue
    by_primaries(tmp_path / "a.exr", image, PRIMARIES["Rec.2020"][0])
    np.testing.assert_allclose(read_exr(tmp_path / "a.exr")[1, 2], [0, 1.1328999, 0], atol=1e-5)
    say_pictures()
    assert "a.exr: 1 pixels have colours outside of Rec.709" in capsys.readouterr().err


def test_rounding_and_ringing_below_0_are_cut_and_counted(tmp_path, capsys):
    """Lanczos' filter beside a point of light, and rounding in the dark; one dark pixel without light around stays."""
    image = np.full((20, 30, 3), 0.5, np.float32)
    image[8, 10] = 40.0
    image[8, 12, 1] = -5.0
    image[15, 20] = -1e-6
    write_exr(tmp_path / "a.exr", image, half=False)
    want = np.maximum(image, 0.0)
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr"), want)
    say_pictures()
    assert (
        "a.exr: 2 pixels are negative by rounding or filters (down to -5), and are taken as 0"
        in capsys.readouterr().err
    )
    image[3, 25, 0] = -0.3
    write_exr(tmp_path / "b.exr", image, half=False)
    np.testing.assert_array_equal(read_exr(tmp_path / "b.exr"), image)
    with pytest.raises(InputError, match=r"b\.exr: it has negative pixels"):
        read_photograph(tmp_path / "b.exr")


@pytest.mark.skipif(not CASES.is_dir(), reason="needs ../shared/cases")
def test_one_picture_by_two_primaries():
    """OpenEXR's own: as far as half floats tell them apart."""
    first, second = (read_exr(CASES / f"{name}.exr") for name in ("XYZ", "Rec709"))
    np.testing.assert_allclose(first, second, rtol=2e-3, atol=5e-4)


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


def test_bitmaps_of_16_bits_keep_them_and_exr_is_linear_whatever_raw_says(tmp_path):
    grey = np.random.default_rng(0).integers(0, 65536, (3, 4), dtype=np.uint16)
    Image.fromarray(grey).save(tmp_path / "a.png")
    np.testing.assert_allclose(read_bitmap(tmp_path / "a.png", raw=True)[..., 0], grey / 65535, atol=1e-7)
    np.testing.assert_allclose(read_bitmap(tmp_path / "a.png")[..., 0], from_srgb(grey / 65535), atol=1e-6)

    image = picture(4)
    write_exr(tmp_path / "a.exr", image, half=False)
    for raw in (False, True):
        np.testing.assert_array_equal(read_bitmap(tmp_path / "a.exr", raw), image[..., :3])
