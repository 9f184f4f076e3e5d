"""``neurad check`` on rooms like those of users: nothing is wrong, and each of many damages is named."""

import json
import math
import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from trimesh.transformations import rotation_matrix

from neurad.cli import main
from neurad.images.image_io import write_exr
from neurad.images.photographs import read_photograph

ROOMS = Path(__file__).resolve().parents[3] / "shared" / "scenes"
NAMES = ("staircase", "kitchen", "living-room-2", "veach-ajar", "bunny")

pytestmark = [pytest.mark.slow, pytest.mark.main, pytest.mark.skipif(not ROOMS.is_dir(), reason="no shared rooms here")]


def checked(folder, out, capsys):
    """Exit code, and what was printed."""
    code = 0
    try:
        main(["check", "--root", str(folder), "--out", str(out)])
    except SystemExit as end:
        code = end.code
    told = capsys.readouterr()
    return code, told.out + told.err


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_wrong(name, tmp_path, capsys):
    code, told = checked(ROOMS / name, tmp_path / "out", capsys)
    assert code == 0, told
    assert "Nothing looks wrong." in told


# ---- damages: each changes a copy of veach-ajar or kitchen


def frames(folder, change):
    """Change the frames of the training views."""
    path = folder / "transforms_train.json"
    described = json.loads(path.read_text())
    change(described["frames"])
    path.write_text(json.dumps(described))


def pose(index, change):
    def damage(folder):
        def edit(all_frames):
            matrix = np.array(all_frames[index]["transform_matrix"])
            all_frames[index]["transform_matrix"] = change(matrix).tolist()

        frames(folder, edit)

    return damage


def photograph(index, change):
    def damage(folder):
        path = folder / f"images/train_{index:03d}.exr"
        pixels = change(read_photograph(path))
        path.unlink()
        write_exr(path, np.asarray(pixels, np.float32), half=False)

    return damage


def scene_file(change):
    def damage(folder):
        path = folder / "scene.xml"
        tree = ElementTree.parse(path)
        change(tree.getroot())
        tree.write(path)

    return damage


def turned(degrees, axis):
    turn = rotation_matrix(math.radians(degrees), axis)
    return lambda matrix: matrix @ turn


def all_frames_along_z(folder):
    def edit(found):
        for frame in found:
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])).tolist()

    frames(folder, edit)


def larger(root):
    """The geometry a hundred times as large, the cameras where they were."""
    for shape in root.findall("shape"):
        place = shape.find("transform[@name='to_world']")
        if place is None:
            place = ElementTree.SubElement(shape, "transform", name="to_world")
        ElementTree.SubElement(place, "scale", value="100")


def lamps(change):
    def edit(root):
        for shape in root.findall("shape"):
            emitter = shape.find("emitter")
            if emitter is not None:
                change(shape, emitter)

    return edit


def brighter(shape, emitter):
    radiance = emitter.find("rgb")
    values = [10.0 * float(x) for x in radiance.get("value").replace(",", " ").split()]
    radiance.set("value", ", ".join(map(str, values)))


def first_lamp_out(root):
    """The first of several lamps does not shine."""
    lit = [shape for shape in root.findall("shape") if shape.find("emitter") is not None]
    assert len(lit) > 1
    lit[0].remove(lit[0].find("emitter"))


def spoilt(pixels):
    pixels[7, 9] = np.nan
    return pixels


def foreign(folder):
    """A photograph of another room."""
    path = folder / "images/train_004.exr"
    path.unlink()
    pixels = read_photograph(ROOMS / "staircase/images/train_004.exr")
    size = read_photograph(folder / "images/train_005.exr").shape[0]
    by = pixels.shape[0] // size
    write_exr(path, pixels.reshape(size, by, size, by, 3).mean((1, 3)), half=False)


def behind_the_wall(matrix):
    moved = matrix.copy()
    moved[:3, 3] += 40.0 * matrix[:3, 2]  # back, out of the room
    return moved


DAMAGES = {
    "turned by 3 degrees": (
        pose(3, turned(3.0, (0, 1, 0))),
        1,
        "view train_003: its photograph does not show the edges",
    ),
    "pitched by 3 degrees": (
        pose(5, turned(-3.0, (1, 0, 0))),
        1,
        "view train_005: its photograph does not show the edges",
    ),
    "a frame along +z": (pose(2, lambda m: m @ np.diag([1.0, -1, -1, 1])), 1, "the frame is OpenCV's"),
    "all frames along +z": (all_frames_along_z, 2, "most photographs"),
    "scale 100": (scene_file(larger), 1, "which is no room in metres"),
    "lamps x 10": (scene_file(lamps(brighter)), 2, "times darker"),
    "another room": (foreign, 1, "view train_004: its photograph does not show the edges"),
    "outside": (pose(6, behind_the_wall), 1, "view train_006: its camera is outside of the room"),
    "NaN": (photograph(1, spoilt), 2, "train_001.exr: it has pixels that are NaN"),
    "clipped": (photograph(8, lambda x: np.minimum(x, np.quantile(x, 0.9))), 1, "train_008: its photograph is clipped"),
    "mirrored": (photograph(9, lambda x: x[:, ::-1]), 1, "view train_009: its photograph does not show the edges"),
    "two stops": (photograph(7, lambda x: 4.0 * x), 1, "view train_007: its photograph is"),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", ["veach-ajar", "kitchen"])
def test_damage_is_named(name, damage, tmp_path, capsys):
    folder = tmp_path / name
    folder.mkdir()
    for entry in (ROOMS / name).iterdir():
        if entry.name in ("images", "scene.xml") or entry.suffix == ".json":
            (shutil.copytree if entry.is_dir() else shutil.copy)(entry, folder / entry.name)
        else:
            (folder / entry.name).symlink_to(entry)
    for path in (folder, *folder.rglob("*")):
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() else 0o644)
    spoil, expected, sentence = DAMAGES[damage]
    spoil(folder)
    code, told = checked(folder, tmp_path / "out", capsys)
    assert sentence in told
    assert code == expected  # of all frames along +z a fit refuses the lamp, which is not where the photographs show it


def test_a_lamp_that_is_missing_is_named(tmp_path, capsys):
    folder = tmp_path / "kitchen"
    folder.mkdir()
    for entry in (ROOMS / "kitchen").iterdir():
        if entry.name == "scene.xml":
            (folder / entry.name).write_text(entry.read_text())
        else:
            (folder / entry.name).symlink_to(entry)
    scene_file(first_lamp_out)(folder)
    code, told = checked(folder, tmp_path / "out", capsys)
    assert code == 1
    assert "has no lamp there" in told
