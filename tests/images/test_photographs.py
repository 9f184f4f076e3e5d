"""Photographs of all formats as linear radiance, and what is said of how they were taken."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.tiff import longs, shorts, tiff
from helpers.tiny_scene import as_png, read_json, write_json, write_scene
from PIL import Image, ImageCms

from neurad.core.errors import InputError
from neurad.core.scene_records import Development
from neurad.formats.load import load_scene
from neurad.images.development import Photography, exif_exposure, sentence_of_profiles
from neurad.images.image_io import from_srgb, write_exr
from neurad.images.photographs import ceiling_of, colour_profile, largest_code, picture_size, read_photograph, read_view
from neurad.images.response import check_response, linear_values

CODES = np.random.default_rng(3).integers(0, 256, (6, 9, 3), dtype=np.uint8)
DEEP = CODES.astype(np.uint16) * 257 - (CODES > 200)  # 16 bits that 8 cannot hold


def saved(path, codes):
    if codes.dtype == np.uint8:
        Image.fromarray(codes).save(path, **({"quality": 100, "subsampling": 0} if path.suffix == ".jpg" else {}))
    else:
        assert cv2.imwrite(str(path), codes[..., [2, 1, 0, 3][: codes.shape[2]]])
    return path


@pytest.mark.parametrize("ending", [".png", ".tif", ".jpg"])
@pytest.mark.parametrize("response", ["srgb", "linear", "gamma=2.2"])
def test_codes_of_8_and_of_16_bits(tmp_path, ending, response):
    codes = CODES if ending == ".jpg" or response == "srgb" else DEEP
    most = np.iinfo(codes.dtype).max
    path = saved(tmp_path / f"a{ending}", codes)
    assert (largest_code(path), picture_size(path)) == (most, (9, 6))
    found = read_photograph(path, Development(response, int(most)))
    assert found.dtype == np.float32
    want = from_srgb(codes / most) if response == "srgb" else (codes / most) ** (2.2 if "gamma" in response else 1.0)
    if ending == ".jpg":  # noise of every pixel anew: compression moves codes
        assert np.abs(found - want).mean() < 0.02
    else:
        np.testing.assert_allclose(found, want, rtol=1e-6)


def test_a_radiance_picture(tmp_path):
    values = np.random.default_rng(1).random((6, 9, 3), np.float32) * 50
    cv2.imwrite(str(tmp_path / "a.hdr"), values[..., ::-1])
    assert picture_size(tmp_path / "a.hdr") == (9, 6)
    found = read_photograph(tmp_path / "a.hdr")
    assert np.abs(found - values).max() <= 0.5  # a byte beside a common exponent
    assert np.median(np.abs(found / values - 1)) < 0.01


def test_a_radiance_picture_says_its_exposure_and_primaries(tmp_path):
    """Half a stop and two stops more; Rec.2020, in which white is white."""
    values = np.full((6, 9, 3), 8.0, np.float32)
    values[2, 3] = 4.0, 2.0, 2.0
    cv2.imwrite(str(tmp_path / "a.hdr"), values[..., ::-1])
    head, _, rest = (tmp_path / "a.hdr").read_bytes().partition(b"\n\n")
    more = b"\nEXPOSURE= 2.0\nEXPOSURE=4\nPRIMARIES= 0.708 0.292 0.170 0.797 0.131 0.046 0.3127 0.3290\n\n"
    (tmp_path / "a.hdr").write_bytes(head + more + rest)
    found = read_photograph(tmp_path / "a.hdr")
    np.testing.assert_allclose(found[0, 0], 1.0, rtol=0.01)
    np.testing.assert_allclose(
        found[2, 3], [0.25 + 0.25 * 1.660491, 0.25 - 0.25 * 0.1245505, 0.25 - 0.25 * 0.0181508], rtol=0.01
    )
    (tmp_path / "b.hdr").write_bytes(head + b"\nEXPOSURE=x\n\n" + rest)
    with pytest.raises(InputError, match=r"b\.hdr: the EXPOSURE or PRIMARIES in its header are no numbers"):
        read_photograph(tmp_path / "b.hdr")


@pytest.mark.parametrize("codes", [CODES, DEEP])
def test_alpha_is_linear_and_colour_is_premultiplied(tmp_path, codes):
    levels = 255 if codes.dtype == np.uint8 else 65535
    alpha = np.full((6, 9, 1), levels // 3, codes.dtype)
    found = read_photograph(
        saved(tmp_path / "a.png", np.concatenate((codes, alpha), -1)), Development("srgb", levels, None, 4.0)
    )
    np.testing.assert_allclose(found[..., 3], levels // 3 / levels, rtol=1e-6)
    np.testing.assert_allclose(found[..., :3], from_srgb(codes / levels) * (levels // 3 / levels) / 4, rtol=1e-4)


def test_other_pictures_are_refused(tmp_path):
    for name, mode in (("grey.png", "L"), ("ink.tif", "CMYK")):
        Image.new(mode, (4, 4)).save(tmp_path / name)
        with pytest.raises(InputError, match=rf"{name[:4]}.*RGB or RGBA of 8 or 16 bits, this one is {mode}"):
            largest_code(tmp_path / name)
    (tmp_path / "text.jpg").write_text("no picture")
    with pytest.raises(InputError, match=r"text\.jpg: it cannot be read as an image"):
        picture_size(tmp_path / "text.jpg")
    whole = saved(tmp_path / "cut.png", DEEP).read_bytes()
    (tmp_path / "cut.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"cut\.png: it cannot be read as an image"):
        read_photograph(tmp_path / "cut.png", Development("srgb", 65535))


def test_a_curve_of_a_file(tmp_path):
    path = tmp_path / "curve.csv"
    path.write_text("# code, value\n0, 0\n100, 1\n\n200 4\n")
    check_response(str(path))
    np.testing.assert_allclose(linear_values(str(path), 4), [0, 0.125, 0.25, 0.625, 1])
    bad = {
        "0 0\n50 .7\n100 .5\n": r"the response is not monotone: after code 50 \(linear value 0.7\)",
        "0 0\n100\n": "two numbers a line",
        "0 0\nx 1\n": "two numbers a line",
        "0 -1\n1 1\n": "begins at the linear value -1",
    }
    for index, (text, said) in enumerate(bad.items()):
        other = tmp_path / f"bad{index}.csv"
        other.write_text(text)
        with pytest.raises(InputError, match=rf"bad{index}\.csv: .*{said}"):
            check_response(str(other))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("gamma=0", "from 0.1 to 10"),
        ("gamma=x", "from 0.1 to 10"),
        ("rec709", "choose linear, srgb, gamma=G, fit"),
        ("emor", "fit recovers a monotone curve"),
        ("none.csv", "there is no such response"),
    ],
)
def test_responses_that_there_are_not(text, said):
    with pytest.raises(InputError, match=said):
        check_response(text)


# ---- folders


@pytest.fixture
def folder(tmp_path):
    pytest.importorskip("mitsuba")
    return write_scene(tmp_path / "room")


def with_exposures(folder, part, values):
    described = read_json(folder, part)
    for frame, value in zip(described["frames"], values, strict=True):
        frame |= {} if value is None else {"exposure": value}
    write_json(folder, part, described)


def test_photographs_of_mixed_formats(folder):
    before = [read_view(view) for view in load_scene(str(folder), None).train]
    as_png(folder)
    write_exr(folder / "images/train_0.exr", before[0])  # the name without its ending finds linear values first
    described = read_json(folder, "train")
    described["frames"][0]["file_path"] = "images/train_0"
    write_json(folder, "train", described)
    scene = load_scene(str(folder), None)
    assert [Path(view.image).suffix for view in scene.train] == [".exr", ".png", ".png"]
    [said] = scene.notes
    assert "4 PNG of 8 bits: sRGB's curve is undone, as nothing else is said" in said
    assert "from code 255 on they are clipped" in said
    for view, want in zip(scene.train, before, strict=True):
        assert np.abs(read_view(view) - want).max() < 0.005
    assert [ceiling_of(view) for view in scene.train] == [
        np.inf,
        pytest.approx(1, rel=1e-3),
        pytest.approx(1, rel=1e-3),
    ]
    stated = load_scene(str(folder), None, photography=Photography("gamma=2", 0.5))
    assert "the response gamma=2 is undone; from code 128 on they are clipped" in stated.notes[0]
    assert ceiling_of(stated.train[1]) == pytest.approx(0.25, rel=1e-3)
    assert ceiling_of(stated.train[0]) == pytest.approx(0.5, rel=1e-3)


def test_a_photograph_is_what_its_bytes_say(folder):
    """A JPEG that is named PNG is clipped as JPEGs are, and the other way about."""
    from PIL import Image

    as_png(folder)
    for path, kind in ((folder / "images/train_1.png", "JPEG"), (folder / "images/train_2.png", "PNG")):
        Image.open(path).save(path, kind)
    [said] = load_scene(str(folder), None).notes
    assert "1 JPEG of 8 bits" in said
    assert "4 PNG of 8 bits" in said
    assert "from code 250 or 255 on they are clipped" in said


def test_exposures_of_the_camera_file_are_divided_out(folder):
    before = [read_view(view) for view in load_scene(str(folder), None).train]
    with_exposures(folder, "train", [0.5, 1, 4])
    with_exposures(folder, "test", [1, 1])
    scene = load_scene(str(folder), None)
    assert scene.notes == ("exposures from 0.5 to 4 (the camera file) are divided out",)
    for view, want, value in zip(scene.train, before, (0.5, 1, 4), strict=True):
        np.testing.assert_allclose(read_view(view), want / value, rtol=1e-6)


def test_exposures_that_some_views_lack(folder):
    with_exposures(folder, "train", [1, None, 4])
    with pytest.raises(InputError, match=r"3 of 5 photographs have no exposure in the camera file \(train_1, test_0"):
        load_scene(str(folder), None)
    scene = load_scene(str(folder), None, photography=Photography(exposure="fit"))
    assert scene.train[1].development.exposure == pytest.approx(2)
    assert scene.notes[0].startswith("warning: 3 of 5 photographs have no exposure in the camera file")


@pytest.mark.parametrize("value", [-1, 0, "x", float("nan")])
def test_exposures_that_are_none(folder, value):
    with_exposures(folder, "train", [1, value, 1])
    with pytest.raises(InputError, match=r"frame 1 \(images/train_1.exr\): its exposure is"):
        load_scene(str(folder), None)


def test_exposures_of_exif(folder):
    as_png(folder)
    times = {"train": [1 / 50, 1 / 200, 1 / 100], "test": [1 / 100, 1 / 100]}
    for part, values in times.items():
        described = read_json(folder, part)
        for frame, time in zip(described["frames"], values, strict=True):
            path = folder / frame["file_path"]
            exif = Image.Exif()
            exif.get_ifd(0x8769).update({0x829A: time, 0x829D: 2.0, 0x8827: 400})
            Image.open(path).save(path.with_suffix(".jpg"), exif=exif)
            path.unlink()
            frame["file_path"] = frame["file_path"].replace(".png", ".jpg")
        write_json(folder, part, described)
    assert exif_exposure(folder / "images/train_0.jpg") == pytest.approx(1 / 50, rel=1e-4)
    scene = load_scene(str(folder), None)
    found = [view.development.exposure for view in (*scene.train, *scene.test)]
    np.testing.assert_allclose(found, [2, 0.5, 1, 1, 1], rtol=1e-4)
    assert "5 JPEG of 8 bits" in scene.notes[0]
    assert "from code 250 on" in scene.notes[0]
    assert "(EXIF, relative to their mean) are divided out" in scene.notes[1]
    path = folder / "images/train_2.jpg"
    Image.open(path).save(path)
    found = load_scene(str(folder), None)
    assert all(view.development.exposure is None for view in found.train)
    assert found.notes[1].startswith("warning: 1 photographs have no exposure in their EXIF (train_2)")


def test_settings_of_a_run_are_read_again():
    data = {"response": "gamma=2", "ceiling": None, "exposure": "fit", "patches": 4}
    assert Photography.of(json.loads(json.dumps(data))) == Photography("gamma=2", exposure="fit")
    with pytest.raises(InputError, match="'some' is unknown, choose known or fit"):
        Photography(exposure="some")


@pytest.mark.parametrize(("planar", "extra"), [(2, None), (1, 1)])
def test_16_bit_tiff_that_would_be_read_wrongly(tmp_path, planar, extra):
    """Its reader takes planes for rows, and premultiplied colours for others."""
    count = 3 if extra is None else 4
    entries = [
        (256, 4, longs(4)), (257, 4, longs(4)), (258, 3, shorts(*[16] * count)), (259, 3, shorts(1)),
        (262, 3, shorts(2)), (277, 3, shorts(count)), (284, 3, shorts(planar)),
        *([] if extra is None else [(338, 3, shorts(extra))]),
    ]  # fmt: skip
    planes = count if planar == 2 else 1
    path = tmp_path / "a.tif"
    path.write_bytes(tiff(entries, [bytes(32 * count // planes)] * planes))
    with pytest.raises(InputError, match=r"a\.tif: TIFF of 16 bits is read with interleaved channels"):
        largest_code(path)


def test_other_colour_profiles_are_named(tmp_path):
    """Codes of other primaries are other colours."""
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    other = profile.replace("sRGB".encode("utf-16-be"), "P3-D".encode("utf-16-be")).replace(b"sRGB", b"P3-D")
    first = tmp_path / "a.png"
    Image.new("RGB", (4, 4)).save(first, icc_profile=profile)
    assert "srgb" in colour_profile(first).lower()
    assert sentence_of_profiles([first]) is None
    Image.new("RGB", (4, 4)).save(tmp_path / "b.png")
    Image.new("RGB", (4, 4)).save(tmp_path / "c.jpg", icc_profile=other)
    said = sentence_of_profiles([first, tmp_path / "b.png", tmp_path / "c.jpg"])
    assert said.startswith("1 of 3 photographs have the colour profile 'P3-D")
    assert "convert them to sRGB" in said
