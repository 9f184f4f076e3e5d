"""Names of photographs from other systems: case, separators, drives, missing endings; and what photographs hold."""

import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from helpers import layouts
from helpers.pathtraced import picture
from helpers.tiny_fit import fails
from PIL import Image

from neurad.cli import main
from neurad.core.errors import InputError
from neurad.formats.cameras.photograph_files import Photographs
from neurad.formats.load import load_scene
from neurad.images import picture_notes
from neurad.images.image_io import read_exr, write_exr
from neurad.images.photographs import kept_pixels, read_view

pytest.importorskip("mitsuba")
CASES = Path(__file__).resolve().parents[3] / "shared/cases"
EXR = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    """A working folder; nothing that tests before have read waits to be said."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(picture_notes, "_waiting", {})
    return tmp_path


def mesh(place):
    return str(layouts.write_mesh(place / "mesh"))


def nerfstudio(place, name, file, count=2, write=None):
    """A source of ``count`` photographs, whose names and files are formats of their number."""
    cameras = layouts.cameras(count=count)
    source = layouts.write_nerfstudio(place / "src", cameras)
    described = json.loads((source / "transforms.json").read_text())
    images = sorted((source / "images").glob("*.exr"))
    for index, (frame, image, camera) in enumerate(zip(described["frames"], images, cameras, strict=True)):
        target = place / file.format(index)
        target.parent.mkdir(parents=True, exist_ok=True)
        image.rename(target)
        if write is not None:
            write(target, camera)
        frame["file_path"] = name.format(index)
    (source / "transforms.json").write_text(json.dumps(described))
    return source


def png(target, camera):
    levels = np.random.default_rng(camera.width).integers(0, 256, (camera.height, camera.width, 3), dtype=np.uint8)
    Image.fromarray(levels).save(target, "PNG")


MOVED = ["--images", "photos"]
FOUND = {
    "upper case": ("images/a_{}.exr", "src/images/A_{}.EXR", [], True),
    "case of the folder": ("Images/a_{}.exr", "src/images/a_{}.exr", [], True),
    "a JPEG's ending": ("images/a_{}.JPG", "src/images/a_{}.Exr", [], True),
    "backslashes": ("images\\a b_{}.exr", "src/images/a b_{}.exr", [], False),
    "a drive": ("C:\\Users\\me\\images\\a_{}.png", "photos/a_{}.exr", MOVED, False),
    "a drive and folders": ("D:\\x\\left\\{}.png", "photos/left/{}.exr", MOVED, False),
    "a share": ("\\\\server\\photos\\a_{}.exr", "photos/A_{}.exr", MOVED, True),
    "another computer": ("/home/me/x/a_{}.exr", "photos/a_{}.exr", MOVED, False),
    "a folder above": ("..\\x\\a_{}.exr", "photos/a_{}.exr", MOVED, False),
    "a number behind a dot": ("images/a.{}", "src/images/a.{}.exr", [], False),
}


@pytest.mark.parametrize("case", FOUND)
def test_photographs_are_found(place, case, capfd):
    name, file, words, noted = FOUND[case]
    source = nerfstudio(place, name, file)
    main(["data", "nerfstudio", str(source), *words, "--out", "room", "--mesh", mesh(place)])
    assert ("in other upper and lower case" in capfd.readouterr().err) is noted
    views = load_scene("room", None, 0).train
    for index, view in enumerate(views):
        np.testing.assert_array_equal(read_view(view), read_exr(place / file.format(index)))
    assert len(views) == 2


@pytest.mark.parametrize("file", ["src/images/r_{}.png", "src/images/R_{}.PNG"])
def test_names_without_endings(place, file):
    source = nerfstudio(place, "./images/r_{}", file, write=png)
    main(["data", "nerfstudio", str(source), "--out", "room", "--mesh", mesh(place)])
    views = load_scene("room", None, 0).train
    assert [Path(view.image).suffix for view in views] == [".png", ".png"]


@pytest.mark.parametrize(
    ("name", "file", "write", "said"),
    [
        ("images/r_{}", "src/images/r_{}", png, ["r_0: this is none of .exr", "it is .png: name it r_0.png"]),
        (
            "C:\\photos\\a_{}.exr",
            "src/images/a_{}.exr",
            None,
            ["leads out of the folder; say where"],
        ),
        ("images/a_{}.exr", "src/images/a_{}.exr", lambda t, c: damaged(t, c, np.inf), ["a_0.exr: it has "]),
    ],
    ids=["no ending", "elsewhere", "infinite"],
)
def test_photographs_that_cannot_be_taken(place, capfd, name, file, write, said):
    """By their names, or by what a fit would refuse."""
    error = fails(capfd, "data", "nerfstudio", str(nerfstudio(place, name, file, write=write)), "--out", "room")
    assert all(words in error for words in said)


def test_two_files_of_other_case_are_no_guess(tmp_path):
    for name in ("aB.exr", "Ab.exr", "c.exr"):
        write_exr(tmp_path / name, np.ones((2, 2, 3)))
    if len(list(tmp_path.glob("*.exr"))) < 3:
        pytest.skip("the file system does not tell them apart")
    assert Photographs(tmp_path)("Ab.exr", "x").name == "Ab.exr"
    assert Photographs(tmp_path)("C.exr", "x").name == Photographs(tmp_path).named("C").name == "c.exr"
    with pytest.raises(InputError, match=r"AB\.exr: it is missing, and Ab\.exr and aB\.exr differ from it"):
        Photographs(tmp_path)("AB.exr", "x")


@pytest.mark.parametrize("reader", ["polycam", "fipt"])
def test_every_reader_finds_other_case(place, reader, capfd):
    cameras = layouts.cameras(count=3)
    if reader == "polycam":
        source = layouts.write_polycam(place / "src", cameras)
        files = list((source / "keyframes/corrected_images").glob("*.exr"))
    else:
        source = layouts.write_fipt_photographed(place / "src", cameras)
        files = list((source / "Image").glob("*.exr"))
    for file in files:
        file.rename(file.with_suffix(".EXR"))
    main(["data", reader, str(source), "--out", "room", "--mesh", mesh(place)])
    said = capfd.readouterr().err
    assert f"and {len(files) - 1} others: the cameras write such names in other upper and lower case" in said
    assert len(load_scene("room", None, 0).train) == len(files)


# ---- what data and fit take


def damaged(target, camera, value):
    image = np.full((camera.height, camera.width, 3), 0.5, np.float32)
    image[2, 3, 1] = value
    write_exr(target, image, half=False)


def test_what_is_read_otherwise_is_noted_once_for_all_photographs(place, capfd):
    """Primaries of ACEScg and rounding below 0."""

    def write(target, camera):
        image = np.full((camera.height, camera.width, 3), 0.5, np.float32)
        image[:2, 0, 0] = -1e-7
        header = {**EXR, "chromaticities": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)}
        OpenEXR.File(header, {"RGB": image}).write(str(target))

    source = nerfstudio(place, "images/a_{}.exr", "src/images/a_{}.exr", count=4, write=write)
    main(["data", "nerfstudio", str(source), "--out", "room", "--mesh", mesh(place)])
    said = capfd.readouterr().err
    assert said.count("a_0.exr and 3 others: colours by the primaries of ACEScg (AP1) are converted") == 1
    assert said.count("a_0.exr and 3 others: 8 pixels are negative by rounding or filters") == 1


# ---- rooms by others, read and rendered again


@pytest.mark.skipif(not CASES.is_dir(), reason="needs ../shared/cases")
def test_a_room_of_small_data_windows(place, capfd):
    main(["data", "nerfstudio", str(CASES / "c25"), "--mesh", str(CASES / "c25/room.obj"), "--out", "room"])
    scene = load_scene("room", None, 0)
    for view in scene.train:
        photograph, kept = read_view(view), kept_pixels(view)
        assert kept.mean() < 0.5
        error = (picture(scene, view.camera, 12, 1) - photograph)[kept]
        assert -10 * np.log10((error**2).mean()) > 29.0
    main(["check", "--root", "room", "--out", "check"])
    assert "pose" not in capfd.readouterr().out
