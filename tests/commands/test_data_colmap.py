"""COLMAP's models as its versions and other programs write them: lines left out, several models, rigs, folders."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import layouts
from helpers.tiny_fit import fails
from trimesh.transformations import rotation_matrix

from neurad.cli import main
from neurad.core.scene_records import Camera
from neurad.formats.load import load_scene
from neurad.images.image_io import read_exr

pytest.importorskip("mitsuba")


def made(source, *words):
    mesh = layouts.write_mesh(Path("mesh"))
    main(["data", "colmap", str(source), "--mesh", str(mesh), "--out", "room", *words])
    return load_scene("room", None, 0).train


def agree(views, cameras, images):
    assert len(views) == len(cameras)
    for view, camera, image in zip(views, cameras, images, strict=True):
        np.testing.assert_allclose(view.camera.to_world, camera.to_world, atol=1e-9)
        np.testing.assert_array_equal(read_exr(view.image), read_exr(image))


def photographs(source):
    return sorted((source / "images").rglob("*.exr"))


@pytest.mark.parametrize("keep", ["every empty line", "none", "some", "Windows"])
def test_empty_lines_of_points_may_be_left_out(place, keep):
    """Points of whole numbers, of which every image has some, could be taken for an image: they are not."""
    cameras = layouts.cameras()
    source = layouts.write_colmap(place / "src", cameras, False)
    path = source / "sparse/0/images.txt"
    lines = path.read_text().splitlines()
    lines[2] = "10 20 5 30 40 6 50 60 7 70 80 9"
    kept = [line for index, line in enumerate(lines) if line or keep in ("every empty line", "Windows") or
            (keep == "some" and index % 4 == 0)]  # fmt: skip
    assert (len(kept) < len(lines)) == (keep in ("none", "some"))
    path.write_bytes(("\r\n" if keep == "Windows" else "\n").join([*kept, ""]).encode())
    agree(made(source), cameras, photographs(source))


def test_a_file_that_announces_more_images_is_noted(place, capfd):
    source = layouts.write_colmap(place / "src", layouts.cameras(), False)
    path = source / "sparse/0/images.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(["# Number of images: 10, mean observations per image: 2", *lines[:15]]))
    assert len(made(source)) == 7
    assert "images.txt: it announces 10 images and has 7; is it cut short?" in capfd.readouterr().err


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("named", ["src", "src/sparse"])
def test_the_largest_of_several_models_is_taken(place, binary, named, capfd):
    cameras = layouts.cameras()
    source = layouts.write_colmap(place / "src", cameras, binary)
    (source / "sparse/0").rename(source / "sparse/2")
    layouts.write_colmap(place / "small", cameras[:3], binary)
    (place / "small/sparse/0").rename(source / "sparse/0")
    layouts.write_colmap(place / "mid", cameras[:6], not binary)
    (place / "mid/sparse/0").rename(source / "sparse/1")
    words = ("--images", "src/images") if named != "src" else ()
    agree(made(named, *words), cameras, photographs(source))
    said = "of its 3 models the one in 2 is taken, which has most images, 10 (0 has 3, 1 has 6)"
    assert said in capfd.readouterr().err


@pytest.mark.parametrize("model", ["dense/sparse", "colmap/sparse/0", "sparse"])
def test_photographs_lie_beside_or_above_the_model(place, model):
    """An undistorted model has photographs of its own; a model that is named itself has those of its project."""
    cameras = layouts.cameras("opencv", 4)
    source = layouts.write_colmap(place / "src", cameras, True)
    (source / model).parent.mkdir(exist_ok=True, parents=True)
    if model == "sparse":
        (source / "sparse/0").rename(source / "moved")
        (source / "sparse").rmdir()
        (source / "moved").rename(source / model)
    else:
        (source / "sparse/0").rename(source / model)
    expected = photographs(source)
    if model == "dense/sparse":
        (source / "images").rename(source / "dense/images")
        (source / "images").mkdir()
        (source / "images/IMG 000 ä.JPG").write_text("distorted")
        expected = photographs(source / "dense")
    agree(made(source), cameras, expected)
    main(["data", "colmap", str(source / model), "--out", "again"])
    assert len(list((place / "again/images").iterdir())) == 4


# ---- rigs


def rigid(camera):
    """Rotation and translation from the world to a camera that looks along +Z with Y down."""
    rotation = np.diag([1.0, -1.0, -1.0]) @ camera.to_world[:3, :3].T
    return rotation, -rotation @ camera.to_world[:3, 3]


ON_RIG = {
    number: (rotation_matrix(angle, (0, 1, 0))[:3, :3], np.array(shift))
    for number, angle, shift in ((7, 0.0, (0, 0, 0)), (8, 0.4, (0.1, 0, -0.02)), (9, -1.0, (-0.2, 0.05, 0)))
}
"""Cameras by their number: the reference, and where two others are from it."""


def with_rigs(source, cameras, ending, unposed=()):
    """``rigs`` and ``frames`` of a model whose images in threes are of the three cameras of a rig."""
    words = []
    numbers = lambda rotation, translation: [float(x) for x in (*layouts.quaternion(rotation), *translation)]  # noqa: E731
    rig = [("I", 3), ("I", 4 if unposed else 3), ("i", 0), ("I", 7)]
    for number in (8, 9):
        rig += [("i", 0), ("I", number), ("B", int(number not in unposed))]
        rig += [("d", x) for x in numbers(*ON_RIG[number])] if number not in unposed else []
    rig += [("i", 1), ("I", 1), ("B", 0)] if unposed else []  # an IMU
    for index in range(0, len(cameras), 3):
        frame = [("I", index + 1), ("I", 3), *(("d", x) for x in numbers(*rigid(cameras[index]))), ("I", 4)]
        frame += [("i", 1), ("I", 1), ("Q", 55)]
        for i in range(3):
            frame += [("i", 0), ("I", 7 + i), ("Q", index + i + 100)]
        words.append(frame)
    for name, entries in (("rigs", [rig]), ("frames", words)):
        path = source / f"sparse/0/{name}.{ending}"
        if ending == "bin":
            data = struct.pack("<Q", len(entries))
            path.write_bytes(data + b"".join(struct.pack("<" + kind, x) for entry in entries for kind, x in entry))
        else:
            sensors = {"i": {0: "CAMERA", 1: "IMU"}}
            lines = [" ".join(str(sensors.get(kind, {}).get(x, repr(x))) for kind, x in entry) for entry in entries]
            path.write_text("\n".join([f"# {name}, a line each", *lines, ""]))


def rigged(place, binary, wrong):
    """A project of two frames of a rig of three cameras; images that are ``wrong`` stand somewhere else in images."""
    first = layouts.cameras(count=4)[::2]
    cameras = []
    for camera in first:
        rotation, translation = rigid(camera)
        for turn, shift in ON_RIG.values():
            pose = np.eye(4)
            pose[:3, :3] = (turn @ rotation).T @ np.diag([1.0, -1.0, -1.0])
            pose[:3, 3] = -(turn @ rotation).T @ (turn @ translation + shift)
            cameras.append(Camera(pose, first[0].fov_x, *layouts.SIZES[0]))
    written = []
    for index, camera in enumerate(cameras):
        pose = np.array(camera.to_world)
        pose[:3, 3] += (0.3, 0.0, 0.0) if index in wrong else 0.0
        written.append(replace(camera, to_world=pose))
    return layouts.write_colmap(place / "src", written, binary, lenses=3), cameras


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize(("wrong", "unposed"), [((), ()), ((1, 2, 5), ()), ((), (9,))])
def test_frames_say_where_cameras_are_and_one_whose_place_on_the_rig_is_not_known_keeps_its_pose(
    place, binary, wrong, unposed, capfd
):
    source, cameras = rigged(place, binary, wrong)
    ending = "bin" if binary else "txt"
    with_rigs(source, cameras, ending, unposed=unposed)
    agree(made(source), cameras, photographs(source))
    said = f"say otherwise than images.{ending} where 3 of 6 cameras are; they are taken"
    assert (said in capfd.readouterr().err) == bool(wrong)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("frames", "1 9 1 0 0 0 0 0 0 1 CAMERA 7 100\n", r"frames.txt: frame 1: its rig 9 is not in rigs.txt"),
        ("frames", "1 3 1 0 0 0 0 0\n", r"frames.txt: line 1: it is cut short, or a word of it is no number"),
        ("frames", "1 3 0 0 0 0 0 0 0 1 CAMERA 7 100\n", r"frames.txt: frame 1: its quaternion is 0"),
        ("rigs", "3 2 CAMERA 7 LIDAR 8 0\n", r"rigs.txt: line 1: it is cut short, or a word of it is no number"),
        ("rigs", "3 2 CAMERA 7 CAMERA 8 1 1 0 0 0 nan 0 0\n", r"sensor 8 of rig 3: its translation is nan"),
    ],
)
def test_broken_rigs(place, name, text, said, capfd):
    source, cameras = rigged(place, False, ())
    with_rigs(source, cameras, "txt")
    (source / f"sparse/0/{name}.txt").write_text(text)
    assert said in fails(capfd, "data", "colmap", str(source), "--out", "room")


# ---- folders of photographs


@pytest.mark.parametrize("binary", [False, True])
def test_names_of_two_cameras_do_not_meet(place, binary):
    cameras = layouts.cameras(count=6)
    source = layouts.write_colmap(place / "src", cameras, binary, "cam1/{:04d} b.jpg")
    model = source / "sparse/0"
    path = model / f"images.{'bin' if binary else 'txt'}"
    data = path.read_bytes()
    (source / "images/cam2").mkdir()
    for index in (3, 4, 5):
        data = data.replace(b"cam1/%04d b.jpg" % index, b"cam2/%04d b.jpg" % (index - 3))
        (source / f"images/cam1/{index:04d} b.exr").rename(source / f"images/cam2/{index - 3:04d} b.exr")
    path.write_bytes(data)
    views = made(source)
    assert [view.name for view in views] == [f"cam{c}_{i:04d}_b" for c in (1, 2) for i in range(3)]
    agree(views, cameras, photographs(source))


def test_one_photograph_for_two_images_is_refused(place, capfd):
    """EXR files in one folder, of photographs that COLMAP has in two."""
    source = layouts.write_colmap(place / "src", layouts.cameras(count=2), False, "cam{}/a.jpg")
    (place / "developed").mkdir()
    (source / "images/cam0/a.exr").rename(place / "developed/a.exr")
    error = fails(capfd, "data", "colmap", str(source), "--images", "developed", "--out", "room")
    assert "image 101 (cam1/a.jpg): its photograph" in error
    assert "is also that of image 100 (cam0/a.jpg); put each into a folder" in error
