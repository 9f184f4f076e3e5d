"""``neurad data``: each layout written and read back, and one sentence for everything that can be wrong with it."""

import json
import os
import re
import shutil
import struct

import numpy as np
import pytest
import torch
import trimesh
from helpers import layouts
from helpers.spoil import both, cut, removed, replaced, written
from helpers.tiny_fit import fails, write_tiny_config
from PIL import Image

from neurad.cli import main
from neurad.core.camera import camera_rays, project, to_camera
from neurad.core.lens import Lens, folded
from neurad.formats.load import load_scene
from neurad.formats.meshes.files import read_meshes
from neurad.images.image_io import read_exr, write_exr
from neurad.scene.geometry import Geometry

pytest.importorskip("mitsuba")


def made(*words):
    """The scene of a folder that the verb makes; nothing is held out that the source does not hold out."""
    main(["data", *map(str, words), "--out", "room"])
    return load_scene("room", None, 0)


def agrees(scene, cameras, images):
    """Views by the order of the cameras: rays to 1e-5 pixels, and the photographs themselves."""
    views = sorted([*scene.train, *scene.test], key=lambda view: view.name)
    assert len(views) == len(cameras)
    for view, camera, image in zip(views, cameras, images, strict=True):
        found, rng = view.camera, np.random.default_rng(3)
        assert (found.width, found.height) == (camera.width, camera.height)
        xy = torch.from_numpy(rng.uniform(0, 1, (300, 2)) * (camera.width, camera.height))
        rays = camera_rays(camera, xy)
        assert float((project(found, to_camera(found, rays.o + 2.0 * rays.d)) - xy).abs().max()) < 1e-5
        assert np.abs(found.to_world[:3, 3] - camera.to_world[:3, 3]).max() * camera.fl_x < 1e-5
        np.testing.assert_array_equal(read_exr(view.image), read_exr(image))


def room_is_whole(scene):
    """The mesh that all layouts have: floor and lamp, where they belong, the lamp shining down."""
    assert {mesh.name: len(mesh.faces) for mesh in scene.meshes} == {"Wände": 2, "lamp 1": 2}
    lamp = next(mesh for mesh in scene.meshes if mesh.radiance is not None)
    assert lamp.name == "lamp 1"
    np.testing.assert_array_equal(lamp.radiance, [3, 2, 1])
    geometry = Geometry(scene)
    normal = geometry.face_normal[(geometry.emission > 0).any(-1)]
    torch.testing.assert_close(normal, torch.tensor([[0.0, -1.0, 0.0]]).expand(2, 3))
    np.testing.assert_allclose(scene.bounds, [[-2, 0, -2], [2, 3, 2]], atol=1e-6)


# ---- layouts


@pytest.mark.parametrize("kind", ["nerfstudio", "colmap", "colmap binary"])
@pytest.mark.parametrize("lens", layouts.LENSES)
def test_cameras_of_every_lens(place, lens, kind):
    cameras, mesh = layouts.cameras(lens), layouts.write_mesh(place / "mesh")
    if kind == "nerfstudio":
        source, words = layouts.write_nerfstudio(place / "src", cameras), []
    else:
        source, words = layouts.write_colmap(place / "src", cameras, "binary" in kind), ["--copy"]
    if lens == "radial":  # has one focal length
        assert all(layouts.colmap_line(camera)[0] == "RADIAL" for camera in cameras)
    scene = made(kind.split()[0], source, "--mesh", mesh, *words)
    agrees(scene, cameras, sorted((source / "images").glob("*.exr")))
    room_is_whole(scene)
    assert sorted(p.name for p in (place / "room").iterdir()) == ["images", "meshes", "scene.xml", "transforms.json"]
    assert {path.is_symlink() for path in (place / "room/images").iterdir()} == {not words}


def test_polycam(place, capfd):
    cameras = layouts.cameras("off-centre")
    source = layouts.write_polycam(place / "src", cameras)
    scene = made("polycam", source, "--mesh", layouts.write_mesh(place / "mesh"))
    agrees(scene, cameras, sorted((source / "keyframes/corrected_images").glob("*.exr")))
    room_is_whole(scene)
    assert "before Polycam's adjustment" not in capfd.readouterr().err
    for name in ("cameras", "images"):
        (source / f"keyframes/corrected_{name}").rename(source / f"keyframes/{name}")
    (source / "keyframes/corrected_cameras").mkdir()  # an adjustment that was not finished
    main(["data", "polycam", str(source / "keyframes"), "--out", "raw"])
    captured = capfd.readouterr()
    assert "cameras before Polycam's adjustment" in captured.err
    assert "no --mesh was given" in captured.out


def test_fipt_rendered(place):
    cameras = layouts.one_angle(layouts.cameras())
    source = layouts.write_fipt_rendered(place / "src", cameras)
    scene = made("fipt", source)
    assert [v.name for v in scene.test] == ["val_000", "val_001", "val_002"]
    images = [*sorted((source / "train/Image").glob("*")), *sorted((source / "val/Image").glob("*"))]
    agrees(scene, [*cameras[3:], *cameras[:3]], images)
    room_is_whole(scene)
    for view in scene.test:
        index = view.name[-3:]
        np.testing.assert_array_equal(read_exr(view.maps["albedo"]), read_exr(source / f"val/DiffCol/{index}_0001.exr"))
        np.testing.assert_array_equal(
            read_exr(view.maps["roughness"]), read_exr(source / f"val/Roughness/{index}_0001.exr")
        )


def test_fipt_photographed(place):
    cameras = layouts.cameras("off-centre")
    source = layouts.write_fipt_photographed(place / "src", cameras)
    scene = made("fipt", source)
    agrees(scene, cameras, sorted((source / "Image").glob("*")))
    assert scene.test == []
    room_is_whole(scene)


def test_what_is_held_out_stays_so(place, capfd):
    cameras = layouts.cameras()
    source = layouts.write_nerfstudio(place / "src", cameras)
    described = json.loads((source / "transforms.json").read_text())
    names = [frame["file_path"] for frame in described["frames"]]
    described |= {"train_filenames": names[:6], "val_filenames": names[6:8]}
    (source / "transforms.json").write_text(json.dumps(described))
    main(["data", "nerfstudio", str(source), "--mesh", str(layouts.write_mesh(place / "mesh")), "--out", "room"])
    captured = capfd.readouterr()
    assert "8 photographs of 12 x 9 or 10 x 14 pixels, 2 of them held out" in captured.out
    assert "2 of 10 photographs are in none of its lists of names" in captured.err
    scene = load_scene("room", None)
    assert ([v.name for v in scene.test], len(scene.train)) == (["frame_00006", "frame_00007"], 6)


@pytest.mark.parametrize("kept", ["inside", "one pixel more", "no mask"])
def test_a_lens_may_fold_over_where_a_mask_leaves_it_out(place, kept, capfd):
    """Read, rendered and checked; one pixel that is kept where the picture folds over is refused, by its place."""
    source = layouts.write_nerfstudio(place / "src", layouts.cameras(count=2))
    described = json.loads((source / "transforms.json").read_text())
    described |= {"camera_model": "OPENCV", "k1": -0.45}
    masks = []
    for index, frame in enumerate(described["frames"]):
        width, height = layouts.SIZES[index]
        lost = folded(Lens(numerator=(-0.45,)), 1.0 / frame["fl_x"], width, height)
        assert 0 < lost.sum() < lost.size
        mask = ~lost
        if kept == "one pixel more" and index == 1:
            mask[tuple(np.argwhere(lost)[-1])] = True
        frame |= {} if kept == "no mask" else {"mask_path": f"{index}.png"}
        Image.fromarray(mask.astype(np.uint8) * 255).save(source / f"{index}.PNG")  # in another case, and found
        masks.append(mask)
    (source / "transforms.json").write_text(json.dumps(described))
    mesh = layouts.write_mesh(place / "mesh")
    if kept != "inside":
        row, column = np.argwhere(~masks[1] if kept == "no mask" else lost)[-1]
        where = rf"frame 1 .*belongs to pixel \({column}, {row}\)" if kept == "one pixel more" else "2 things .*frame 0"
        refused(capfd, rf"{where}.*leave that out by a mask \(mask_path\)", "nerfstudio", source, "--mesh", mesh)
        return
    scene = made("nerfstudio", source, "--mesh", mesh)
    assert [view.camera.lens.numerator for view in scene.train] == [(-0.45,)] * 2
    main(["render", "--root", "room", "--out", "pictures", "--spp", "1", "--map-spp", "1"])
    assert all(np.isfinite(read_exr(path)).all() for path in (place / "pictures/images").iterdir())
    shutil.rmtree("room/masks")
    main(["render", "--root", "room", "--camera", "room/transforms.json", "--out", "again", "--spp", "1"])


# ---- meshes


@pytest.fixture
def source(place):
    """Cameras that hold +Y up, inside the room."""
    cameras = [layouts.cameras()[0]]
    cameras[0].to_world[:3, :3] = np.eye(3)
    return layouts.write_nerfstudio(place / "src", cameras)


@pytest.mark.parametrize("kind", ["ply", "stl", "obj"])
def test_kinds_of_meshes(place, source, kind):
    ball = trimesh.creation.icosphere(2, radius=2.0)
    (place / f"Kugel.{kind}").write_bytes(b"")
    assert ball.vertex_normals is not None  # so that PLY and OBJ get them
    ball.export(place / f"Kugel.{kind}", **({"vertex_normal": True} if kind == "ply" else {}))
    scene = made("nerfstudio", source, "--mesh", f"Kugel.{kind}", "--lamp", "Kugel=1,2,3")
    (mesh,) = scene.meshes
    assert len(mesh.faces) == len(ball.faces)
    corners = mesh.vertices[mesh.faces]
    np.testing.assert_allclose(corners, ball.vertices[ball.faces], atol=1e-5)
    assert (mesh.normals is None) == (kind == "stl")
    np.testing.assert_array_equal(mesh.radiance, [1, 2, 3])
    assert (place / "room/meshes/Kugel.ply").is_symlink() == (kind == "ply")


@pytest.mark.parametrize("coordinates", ["none", "of vertices", "of corners"])
def test_a_ply_keeps_its_normals(place, coordinates):
    """Where a vertex is not used, and where corners have texture coordinates of their own, which are dropped."""
    rng = np.random.default_rng(5)
    n = rng.normal(size=(5, 3)).astype(np.float32)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    p, uv = rng.normal(size=(5, 3)).astype(np.float32), rng.uniform(size=(5, 2)).astype(np.float32)
    faces = np.array([[4, 1, 2], [1, 0, 2]])  # 3 is not used
    names = ["x", "y", "z", "nx", "ny", "nz", *(["u", "v"] if coordinates == "of vertices" else [])]
    values = np.concatenate((p, n, uv), 1)[:, : len(names)]
    corners = coordinates == "of corners"
    rows = [
        "ply", "format ascii 1.0", "element vertex 5", *(f"property float {name}" for name in names),
        "element face 2", "property list uchar int vertex_indices",
        *(["property list uchar float texcoord"] if corners else []), "end_header",
        *(" ".join(repr(float(x)) for x in row) for row in values),
        *(f"3 {a} {b} {c}" + (" 6 0 0 1 0 1 1" if corners else "") for a, b, c in faces),
    ]  # fmt: skip
    (place / "room.ply").write_text("\n".join(rows) + "\n")
    (mesh,) = read_meshes(place / "room.ply").meshes
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], p[faces])
    np.testing.assert_allclose(mesh.normals[mesh.faces], n[faces], atol=1e-6)
    if coordinates == "of vertices":
        np.testing.assert_array_equal(mesh.uvs[mesh.faces], uv[faces])
    else:
        assert mesh.uvs is None


@pytest.mark.parametrize(
    ("up", "corner"), [("y", (1, 2, 3)), ("z", (1, 3, -2)), ("-y", (1, -2, -3)), ("x", (-2, 1, 3))]
)
def test_the_mesh_is_turned_and_scaled_to_the_cameras(place, source, up, corner, capfd):
    """By the shortest way to what the cameras hold up; a lamp's side turns with it."""
    (place / "m.obj").write_text("v 0 0 0\nv 1 2 3\nv 0 1 0\nf 1 2 3\n")
    words = ("--mesh", "m.obj", f"--up={up}", "--scale", "0.5", "--lamp", "m=1,1,1")
    scene = made("nerfstudio", source, *words)
    np.testing.assert_allclose(scene.meshes[0].vertices[1], 0.5 * np.array(corner), atol=1e-6)
    assert f"{up} of the mesh is turned to y, which the cameras hold up" in capfd.readouterr().err


@pytest.mark.parametrize("kind", ["ply", "obj"])
def test_holes_of_a_scan_are_closed_if_asked(place, source, kind, capfd):
    """A hole as wide as a hand; a window stays open, a file that has none is linked as it is."""
    room = trimesh.creation.box((4, 4, 4))
    for _ in range(5):
        room = room.subdivide()
    middle = room.triangles_center
    hole, window = np.abs(middle - [0, 0, 2]).max(1) < 0.25, np.abs(middle - [2, 0, 0]).max(1) < 0.625
    room.export(place / f"whole.{kind}")
    room.update_faces(~(hole | window))
    room.export(place / f"scan.{kind}")
    words = "nerfstudio", source, "--mesh", f"scan.{kind}", "--lamp", "scan=1,1,1"
    assert len(made(*words).meshes[0].faces) == len(room.faces)
    assert "holes" not in capfd.readouterr().err
    shutil.rmtree("room")
    closed = made(*words, "--close-holes", "0.8")
    lost = sum(trimesh.Trimesh(mesh.vertices, mesh.faces).area for mesh in closed.meshes) - room.area
    assert lost == pytest.approx(0.25, abs=1e-4)
    said = capfd.readouterr().err
    assert f"scan.{kind}: 1 holes of 0.25 square units are closed; 1 stay open, 1.77 wide or more" in said
    shutil.rmtree("room")
    words = "nerfstudio", source, "--mesh", f"whole.{kind}", "--lamp", "whole=1,1,1", "--close-holes", "0.8"
    made(*words)
    assert f"whole.{kind}: 0 holes" in capfd.readouterr().err
    assert (place / f"room/meshes/whole.{kind}").is_symlink() == (kind == "ply")


def test_several_meshes_and_an_environment(place, source):
    for index in range(2):
        (place / f"{index}").mkdir()
        (place / f"{index}/part.obj").write_text(f"v 0 0 {index}\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    write_exr(place / "sky.exr", np.ones((4, 8, 3), np.float32))
    (place / "c.obj").write_text("v 0 0 9\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    meshes = ("--mesh", "0/part.obj", "1/part.obj", "--mesh", "c.obj")
    scene = made("nerfstudio", source, *meshes, "--environment", "sky.exr")
    assert [mesh.name for mesh in scene.meshes] == ["part", "part-2", "c"]
    assert scene.features.has_environment
    assert sorted(p.name for p in (place / "room/meshes").iterdir()) == ["c.ply", "part-2.ply", "part.ply"]


@pytest.mark.parametrize("name", ["paint", "ColladaAutoName$_12"])
def test_names_that_scene_xml_cannot_have(place, source, name):
    """Mitsuba takes a dollar for a parameter, and a name twice for a mistake."""
    (place / f"{name}.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    meant = {"paint": "paint-2"}.get(name, name.replace("$", "_"))
    scene = made("nerfstudio", source, "--mesh", f"{name}.obj", "--lamp", f"{meant}=1,1,1")
    assert [mesh.name for mesh in scene.meshes] == [meant]


def test_a_room_without_light_says_what_to_give(place, source, capfd):
    (place / "m.obj").write_text("v 0 0 0\nv 1 2 3\nv 0 1 0\nf 1 2 3\n")
    main(["data", "nerfstudio", str(source), "--mesh", "m.obj", "--out", "room"])
    captured = capfd.readouterr()
    assert "nothing in the room is said to shine: give --lamp NAME=R,G,B (meshes: m)" in captured.err
    assert "neurad fit --config scan.yaml --data.root" in captured.out
    assert "most cameras lie outside of the mesh's box" in captured.err
    said = fails(capfd, "fit", "--config", "scene.yaml", "--data.root", "room")
    assert "it has no emitter" in said


def test_a_fit_of_what_was_made(place, capfd):
    cameras = layouts.cameras("opencv", 8)
    source = layouts.write_colmap(place / "src", cameras, True)
    made("colmap", source, "--mesh", layouts.write_mesh(place / "mesh"))
    write_tiny_config("tiny.yaml", "scene.yaml", data={"root": "room", "patches": 16})
    random = ["--model.lighting.lamp_mismatch", "warn"]  # such photographs show no lamp as it is
    main(["fit", "--config", "tiny.yaml", "--trainer.max_steps", "2", *random])
    assert "does not say which photographs are held out: every 8th by name is, 1 of 8" in capfd.readouterr().err


# ---- bad input


def colmap(place, binary=False):
    return layouts.write_colmap(place / "src", layouts.cameras("opencv", 3), binary)


def camera_line(line):
    """Camera 7, the first one, described anew."""

    def spoil(source):
        path = source / "sparse/0/cameras.txt"
        lines = path.read_text().splitlines()
        path.write_text("\n".join([f"7 {line}", *lines[3:]]) + "\n")

    return spoil


def image_line(line):
    return lambda source: (source / "sparse/0/images.txt").write_text(f"{line}\n\n")


IMAGE = "1 1 0 0 0 0 0 0 7 {}".format
TEXT = {
    "no model": (removed("sparse/0/cameras.txt"),
        r"src: it has no COLMAP model \(cameras\.bin or cameras"),
    "no images": (removed("sparse/0/images.txt"), r"images\.txt: there is no such file"),
    "empty images": (written("sparse/0/images.txt", "# none\n"), r"images\.txt: it has no image"),
    "words": (camera_line("PINHOLE a b"), r"cameras\.txt: line 1 is '7 PINHOLE a b', not CAMERA_ID MODEL WIDTH"),
    "unknown model": (camera_line("FOV 12 9 9 9 6 4 0.1"), r"camera 7: its model FOV is not supported \(SIMPLE_PIN"),
    "few parameters": (camera_line("OPENCV 12 9 9 9 6 4.5"), r"camera 7: it has 4 parameters, but OPENCV has 8"),
    "NaN focal length": (camera_line("PINHOLE 12 9 nan 9 6 4"), r"camera 7: fl_x is nan"),
    "no size": (camera_line("PINHOLE 0 9 9 9 6 4"), r"camera 7: its size is 0, which has to be a number from 1"),
    "another size": (camera_line("PINHOLE 24 18 9 9 6 4"), r"IMG 000 ä\.exr: it has 12 x 9 pixels, its camera 24 x 18"),
    "folds over": (camera_line("RADIAL 12 9 5 6 4 -0.9 0"), r"camera 7: its lens distortion \(k1 -0\.9\) folds over"),
    "short line": (image_line("1 1 0 0 0 0"), r"images\.txt: line 1 is '1 1 0 0 0 0', not IMAGE_ID QW QX"),
    "no such camera": (image_line("1 1 0 0 0 0 0 0 99 a.jpg"),
        r"image 1 \(a\.jpg\): its camera 99 is not in cameras\.txt"),
    "no rotation": (image_line("1 0 0 0 0 0 0 0 7 IMG 000 ä.JPG"), r"image 1 \(IMG 000 ä\.JPG\): its quaternion is 0"),
    "NaN rotation": (image_line("1 nan 0 0 0 0 0 0 7 IMG 000 ä.JPG"), r"image 1 .*: its quaternion is nan"),
    "far away": (image_line("1 1 0 0 0 1e30 0 0 7 IMG 000 ä.JPG"), r"image 1 .*: its translation is 1e\+30"),
    "leaves the folder": (image_line(IMAGE("../../other.jpg")),
        r"image 1 .*'\.\./\.\./other\.jpg', leads out of the folder"),
    "drive": (image_line(IMAGE("C:\\a.jpg")), r"image 1 .*leads out of the folder"),
    "NUL": (image_line(IMAGE("a\0b.jpg")), r"has a NUL character"),
    "no photograph": (image_line(IMAGE("none.jpg")),
        r"image 1 \(none\.jpg\): its photograph none\.exr is in none of .*images"),
    "a JPEG alone": (both(written("images/b.jpg", "jpeg"), image_line(IMAGE("b.jpg"))),
        r"b\.jpg: it cannot be read as an image"),
    "broken photograph": (written("images/IMG 000 ä.exr", "text"),
        r"IMG 000 ä\.exr: it cannot be read as an EXR image"),
    "not text": (written("sparse/0/cameras.txt", b"\xff\xfe"), r"cameras\.txt: it is not text in UTF-8"),
}  # fmt: skip


def binary_camera(kind, *values, size=(12, 9), key=7):
    data = struct.pack("<Q", 1) + struct.pack("<iiQQ", key, kind, *size) + struct.pack(f"<{len(values)}d", *values)
    return written("sparse/0/cameras.bin", data)


BINARY = {
    "cut cameras": (cut("sparse/0/cameras.bin", 30), r"cameras\.bin: it announces 3 entries, and ends before them"),
    "cut images": (cut("sparse/0/images.bin", 300),
        r"images\.bin: (it ends before what it announces|it announces|the name)"),
    "no header": (cut("sparse/0/images.bin", 3), r"images\.bin: it ends before what it announces"),
    "endless count": (written("sparse/0/images.bin", b"\xff" * 200), r"images\.bin: it announces 18446744073709551615"),
    "unknown number": (binary_camera(77, 1.0), r"camera 7: its model has the number 77, which is not known"),
    "huge size": (binary_camera(1, 9.0, 9, 6, 4, size=(2**40, 9)), r"camera 7: its size is 1099511627776"),
    "a name of bytes": (
        lambda s: (path := s / "sparse/0/images.bin").write_bytes(path.read_bytes().replace(b"IMG", b"\xff\xfe\xfd")),
        r"images\.bin: the name .* of an image is not text in UTF-8"),
}  # fmt: skip


def polycam_key(number=1001, **changes):
    def spoil(source):
        path = source / f"keyframes/corrected_cameras/{number}.json"
        described = {**json.loads(path.read_text()), **changes}
        path.write_text(json.dumps({key: value for key, value in described.items() if value is not ...}))

    return spoil


POLYCAM = {
    "no cameras": (lambda s: (s / "keyframes").rename(s / "frames"), r"src: it has no keyframes/corrected_cameras"),
    "no matrix": (polycam_key(t_12=...), r"1001\.json: it lacks one of t_00 to t_23"),
    "NaN": (polycam_key(t_12=float("nan")), r"1001\.json: its matrix t_00 to t_23: row 2, column 3 is nan"),
    "singular": (polycam_key(t_00=0, t_01=0, t_02=0), r"1001\.json: its matrix t_00 to t_23 is not rigid"),
    "words": (polycam_key(t_00="a"), r"1001\.json: its matrix t_00 to t_23: row 1, column 1 is 'a'"),
    "no size": (polycam_key(width=...), r"1001\.json: width is None, not a number"),
    "json of another kind": (written("keyframes/corrected_cameras/1001.json", "[]"),
        r"1001\.json: it is not the camera"),
    "json bomb": (written("keyframes/corrected_cameras/1001.json", "[" * 100000),
        r"1001\.json: it is nested too deeply"),
    "no photograph": (removed("keyframes/corrected_images/1001.exr"),
        r"photograph 1001\.exr is in none of"),
}  # fmt: skip


FIPT = {
    "neither": (removed("cam.txt"), r"src: it has neither train/transforms\.json nor cam\.txt"),
    "no K_list": (removed("K_list.txt"), r"K_list\.txt: a photographed room of FIPT has this file"),
    "no mesh": (removed("scene.obj"), r"scene\.obj: there is no such mesh file"),
    "no photograph": (removed("Image/001_0001.exr"),
        r"001_0001\.exr: the photograph of camera 1 is missing"),
    "words": (written("cam.txt", "three\n"), r"cam\.txt: it is not a number of cameras and then numbers"),
    "few lines": (written("cam.txt", "3\n0 0 0\n"), r"cam\.txt: it has 1 lines of numbers, but 3 cameras have three"),
    "one less": (written("cam.txt", "1\n0 0 0\n0 0 1\n0 1 0\n"), r"K_list\.txt: it has 3 cameras, but cam\.txt has 1"),
    "NaN": (written("cam.txt", "3\n" + "nan 0 0\n" * 9), r"cam\.txt: a number of camera 0 is nan"),
    "looks up": (written("cam.txt", "3\n" + "0 0 0\n0 1 0\n0 1 0\n" * 3),
        r"camera 0: the directions .* not perpendicular"),
    "skew": (written("K_list.txt", "3\n" + "9 1 6\n0 9 4\n0 0 1\n" * 3),
        r"camera 0: its matrix is not fx 0 cx, 0 fy cy"),
}  # fmt: skip


RENDERED = {
    "no frames": (replaced("train/transforms.json", '"frames"', '"shots"'),
        r"train/transforms\.json: it has no frames"),
    "no matrix": (replaced("train/transforms.json", "transform_matrix", "matrix"),
        r"frame 0: its transform_matrix is miss"),
    "bad frame": (written("val/transforms.json", '{"frames": [3]}'), r"val/transforms\.json: frame 0 is not an object"),
    "no angle": (replaced("val/transforms.json", "camera_angle_x", "angle"),
        r"frame 0: neither camera_angle_x nor fl_x"),
    "no photograph": (removed("val/Image/000_0001.exr"), r"the photograph of frame 0 is missing"),
}  # fmt: skip


LAYOUTS = {
    "colmap": (colmap, TEXT),
    "colmap binary": (lambda place: colmap(place, binary=True), BINARY),
    "polycam": (lambda place: layouts.write_polycam(place / "src", layouts.cameras(count=3)), POLYCAM),
    "fipt": (lambda place: layouts.write_fipt_photographed(place / "src", layouts.cameras(count=3)), FIPT),
    "fipt rendered": (
        lambda place: layouts.write_fipt_rendered(place / "src", layouts.one_angle(layouts.cameras(count=5)), 2),
        RENDERED,
    ),
}


@pytest.mark.parametrize(("layout", "case"), [(layout, case) for layout in LAYOUTS for case in LAYOUTS[layout][1]])
def test_sources_that_cannot_be_read(place, layout, case, capfd):
    write, cases = LAYOUTS[layout]
    spoil, said = cases[case]
    source = write(place)
    spoil(source)
    refused(capfd, said, layout.split()[0], source)


MESHES = {
    "no file": (None, "none.obj", r"none\.obj: there is no such mesh file"),
    "another kind": (b"x", "a.fbx", r"a\.fbx: it is no mesh that can be read; export it as one of \.obj, \.ply, \.stl"),
    "empty OBJ": (b"", "a.obj", r"a\.obj: it (has no triangle|cannot be read as OBJ)"),
    "words": (b"v a b c\nf 1 2 3\n", "a.obj", r"a\.obj: line 1 is 'v a b c', neither a vertex"),
    "corners that there are not": (b"v 0 0 0\nf 1 2 9\n", "a.obj", r"a\.obj: face 1 names vertex 2, of 1 \(numbered"),
    "NaN": (b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "a.obj", r"a\.obj: the coordinates of a: 1 of 9 values are not"),
    "garbage PLY": (b"\xff" * 100, "a.ply", r"a\.ply: it is not a PLY file"),
    "garbage STL": (b"\xff" * 10, "a.stl", r"a\.stl: it (cannot be read as STL|has no triangle)"),
    "a folder": (..., "a.obj", r"a\.obj: it is a folder, not a file"),
}  # fmt: skip


@pytest.mark.parametrize("case", MESHES)
def test_bad_meshes(place, source, case, capfd):
    data, name, said = MESHES[case]
    if data is ...:
        (place / name).mkdir()
    elif data is not None:
        (place / name).write_bytes(data)
    refused(capfd, said, "nerfstudio", source, "--mesh", name)


OPTIONS = {
    "lamp of no mesh": (["--lamp", "sun=1,1,1"], r"--lamp: there is no mesh sun, there are Wände, lamp 1"),
    "lamp of words": (["--lamp", "lamp 1=bright"], r"--lamp lamp 1=bright: it is not NAME=R,G,B"),
    "dark lamp": (["--lamp", "lamp 1=-1,0,0"], r"--lamp lamp 1: its radiance is -1"),
    "no environment": (["--environment", "none.exr"], r"none\.exr: there is no such environment map"),
    "environment of another kind": (["--environment", "src/transforms.json"],
        r"transforms\.json: it cannot be read as an EXR"),
    "no axis": (["--up", "w"], r"argument --up: invalid choice: 'w'"),
    "axes that there are not": (["--axes", "zxw"],
        r"--axes zxw: it is neither three axes such as zxy or x,-z,y, nor a matrix of nine numbers"),
    "an axis twice": (["--axes", "xxy"],
        r"--axes xxy: it is no rotation \(its rows are not of length 1 and perpendicular\)"),
    "axes that mirror": (["--axes", "xzy"], r"--axes xzy: it is no rotation \(it mirrors\)"),
    "axes that scale": (["--axes", "2 0 0 0 2 0 0 0 2"],
        r"--axes: a number is 2, which has to be a number from -1\.01 to 1\.01"),
    "axes twice": (["--axes", "zxy", "--up", "z"],
        r"--axes: it says where all axes of the mesh go, so --up has nothing to say"),
    "no images": (["--images", "none"], r"--images: there is no folder none"),
    "out is there": (["--out", "src"], r"--out .*src: it is there already"),
    "out in a file": (["--out", "mesh/room.obj/x"], r"--out .*: a part of its path is a file"),
    "out of no name": (["--out", "a\0b"], r"--out .*no file can have this name"),
}  # fmt: skip


@pytest.mark.parametrize("case", OPTIONS)
def test_bad_options(place, source, case, capfd):
    words, said = OPTIONS[case]
    refused(capfd, said, "nerfstudio", source, "--mesh", layouts.write_mesh(place / "mesh"), *words)


WAYS = {
    "metashape": ": it exports cameras in COLMAP's format .*data colmap.*ns-process-data metashape",
    "Agisoft": ": it exports cameras in COLMAP's format",
    "realitycapture": ": it exports its registration in COLMAP's format",
    "Reality_Capture": ": it exports its registration in COLMAP's format",
    "record3d": ": `ns-process-data record3d` of nerfstudio makes what `neurad data nerfstudio` reads",
    "instant-ngp": ": its transforms.json is read by `neurad data nerfstudio`",
    "kapture": ": programs that find cameras export them in COLMAP's format",
    "fbx": ": export the scene with its cameras as glTF",
    "colmp": ", did you mean colmap",
}
"""How what other programs write comes in."""


def test_other_bad_words(place, source, capfd):
    refused(capfd, "SRC: there is no folder nowhere", "colmap", "nowhere")
    said = r"SRC: src/transforms\.json is a file; name the folder that it is in"
    refused(capfd, said, "nerfstudio", "src/transforms.json")
    for word, said in WAYS.items():
        refused(capfd, rf"argument kind: {word} is none of nerfstudio, colmap, .*hdr{said}", word, "src")
    refused(capfd, "about what --mesh names, and there is no --mesh", "nerfstudio", "src", "--up", "y")
    described = json.loads((source / "transforms.json").read_text())
    pose = np.array(described["frames"][0]["transform_matrix"])
    pose[:3, :3] @= [[1, 0, 0], [0, 0.6, -0.8], [0, 0.8, 0.6]]
    pose[:3, :3] @= [[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]
    described["frames"][0]["transform_matrix"] = pose.tolist()
    (source / "transforms.json").write_text(json.dumps(described))
    mesh = layouts.write_mesh(place / "mesh")
    refused(capfd, "--up: the cameras hold no axis up", "nerfstudio", "src", "--mesh", mesh, "--up", "y")


def test_all_that_is_wrong_with_cameras_is_said_at_once(place, capfd):
    """Of every reader: what is missing or broken in several frames, each once."""
    source = colmap(place)
    for name in ("IMG 000 ä.exr", "IMG 002 ä.exr"):
        (source / "images" / name).unlink()
    said = r"2 things stand in the way: \(1\) .*IMG 000 ä\.exr is in none of .*; \(2\) .*IMG 002 ä\.exr is in none of"
    refused(capfd, said, "colmap", source)
    source = layouts.write_nerfstudio(place / "nerf", layouts.cameras(count=4))
    described = json.loads((source / "transforms.json").read_text())
    described["frames"][0]["transform_matrix"] = np.zeros((4, 4)).tolist()
    described["frames"][1]["fl_x"] = -1
    described["frames"][2].pop("file_path")
    (source / "transforms.json").write_text(json.dumps(described))
    said = r"3 things .*frame 0 .*is not rigid.*; \(2\) .*frame 1 .*fl_x is -1.*; \(3\) .*frame 2 has no file_path$"
    refused(capfd, said, "nerfstudio", source)
    source = layouts.write_polycam(place / "poly", layouts.cameras(count=3))
    for index in (0, 2):
        polycam_key(1000 + index, fx=0)(source)
    said = r"2 things .*1000\.json: fl_x is 0; \(2\) .*1002\.json: fl_x is 0$"
    refused(capfd, said, "polycam", source)
    source = layouts.write_fipt_photographed(place / "fipt", layouts.cameras(count=3))
    for index in (1, 2):
        (source / f"Image/{index:03d}_0001.exr").unlink()
    refused(capfd, r"2 things .*camera 1 is missing; \(2\) .*camera 2 is missing", "fipt", source)


def test_maps_that_lie_elsewhere_are_not_linked(place, source, capfd):
    Image.new("L", layouts.SIZES[0]).save(place / "secret.png")
    described = json.loads((source / "transforms.json").read_text())
    described["frames"][0]["mask_path"] = "images/../../secret.png"
    (source / "transforms.json").write_text(json.dumps(described))
    said = r"secret\.png: its name in the camera file leads out of the folder .*src"
    refused(capfd, said, "nerfstudio", "src")


def test_a_disk_that_refuses_leaves_nothing(place, source, capfd, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "symlink", full)
    refused(capfd, "no space is left on its disk", "nerfstudio", source)


def refused(capfd, said, kind, *words):
    """``neurad data`` of a kind ends with a sentence like this."""
    error = fails(capfd, "data", kind, *words, *([] if "--out" in words else ["--out", "room"]))
    assert re.search(said, error), error
