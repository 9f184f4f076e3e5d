"""Rooms far from the origin of their coordinates, through every reader: the same room to float32's digits."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers import layouts
from helpers.gltf_writer import Document

from neurad.cli import main
from neurad.core.errors import InputError
from neurad.core.reflection import DiffuseModel
from neurad.core.scene_records import Camera, Material, Mesh, constant
from neurad.formats.cameras.write import transforms
from neurad.formats.load import read_folder, surface_notes
from neurad.formats.mitsuba.write import ORIGIN, describe, write_xml
from neurad.scene.description import Scene
from neurad.scene.origin import camera_in_scene, in_scene, near, origin_of

FAR = np.array([441545.5021, 2345.0873, -5121948.0137])
BOX = np.array([(x, y, z) for x in (0.0, 4.1) for y in (0.0, 2.7) for z in (0.0, 3.3)])
"""Corners of a room, as they are without the offset."""
TRIANGLES = np.array([[0, 1, 3], [0, 3, 2], [4, 7, 5], [4, 6, 7], [0, 4, 5], [0, 5, 1]])


def box(offset=FAR):
    return Mesh("box", BOX + offset, TRIANGLES, 0)


def obj(points):
    rows = ["v " + " ".join(f"{x:.10f}" for x in p) for p in points]
    return "\n".join([*rows, *("f " + " ".join(str(i + 1) for i in t) for t in TRIANGLES)]) + "\n"


def ply(points, kind):
    header = ["ply", f"format {kind} 1.0", f"element vertex {len(points)}", *(f"property double {a}" for a in "xyz")]
    header += [f"element face {len(TRIANGLES)}", "property list uchar int vertex_indices", "end_header", ""]
    if kind == "ascii":
        rows = [" ".join(f"{x:.10f}" for x in p) for p in points] + ["3 " + " ".join(map(str, t)) for t in TRIANGLES]
        return "\n".join([*header, *rows]).encode() + b"\n"
    faces = np.empty(len(TRIANGLES), [("count", "u1"), ("corners", ">i4", 3)])
    faces["count"], faces["corners"] = 3, TRIANGLES
    return "\n".join(header).encode() + np.asarray(points, ">f8").tobytes() + faces.tobytes()


def corners(scene, name="box"):
    """Positions in the files' coordinates, as float64."""
    mesh = next(mesh for mesh in scene.meshes if mesh.name == name)
    assert mesh.vertices.dtype == np.float32
    return mesh.vertices[mesh.faces].astype(np.float64) + scene.origin


def camera_file(folder, offset=FAR):
    pose = np.eye(4)
    pose[:3, 3] = np.add(offset, (2.0, 1.5, 1.0))
    frame = {"file_path": "a", "transform_matrix": pose.tolist()}
    (folder / "cameras.json").write_text(json.dumps({"camera_angle_x": 1.0, "w": 8, "h": 6, "frames": [frame]}))


def test_rooms_near_the_origin_stay_where_they_are():
    for offset in (np.zeros(3), (50.0, -20.0, 8.0), (150.0, 0.0, 0.0)):
        assert not origin_of([box(np.asarray(offset))]).any()
    assert not origin_of([]).any()
    stray = replace(box(), vertices=np.zeros((1, 3)), faces=TRIANGLES[:0])
    origin = origin_of([*[box()] * 5, stray])
    assert np.abs(origin - FAR).max() < 5.0  # whatever lies elsewhere
    np.testing.assert_array_equal(origin, np.round(origin))


@pytest.mark.parametrize("kind", ["obj", "ascii", "binary_big_endian"])
@pytest.mark.parametrize("up", [(), ("--up", "z", "--scale", "0.5")], ids=["as it is", "turned"])
def test_an_import_keeps_all_digits(place, capfd, kind, up):
    """Nerfstudio's cameras; COLMAP, Polycam and FIPT join them in one place."""
    cameras = [replace(camera, to_world=np.eye(4)) for camera in layouts.cameras(count=3)]
    scale, turn = (1.0, np.eye(3)) if not up else (0.5, np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]))
    there = scale * turn @ FAR
    for index, camera in enumerate(cameras):
        camera.to_world[:3, 3] = there + index
    layouts.write_nerfstudio(place / "src", cameras)
    name = "box.obj" if kind == "obj" else "box.ply"
    (place / name).write_bytes(obj(BOX + FAR).encode() if kind == "obj" else ply(BOX + FAR, kind))
    main(["data", "nerfstudio", "src", "--mesh", name, "--lamp", "box=1,1,1", "--out", "room", *up])
    assert "lies far from the origin of its coordinates" in capfd.readouterr().err
    scene = read_folder("room")
    np.testing.assert_allclose(corners(scene), (scale * (BOX + FAR) @ turn.T)[TRIANGLES], rtol=0, atol=1e-6)
    views = [*scene.train, *scene.test]
    assert np.abs([view.camera.to_world[:3, 3] for view in views]).max() < 100.0
    written = transforms(views, scene.origin)["frames"]
    given = sorted(camera.to_world[:3, 3].tolist() for camera in cameras)
    back = sorted(np.array(frame["transform_matrix"])[:3, 3].tolist() for frame in written)
    np.testing.assert_allclose(back, given, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("kind", "said"), [(np.float32, "32 bits, which are 0.5 apart"), (np.float64, "")])
def test_coordinates_that_32_bits_cannot_hold_are_said(kind, said):
    points = (BOX + FAR).astype(kind).astype(np.float64)
    grey = Material("grey", DiffuseModel(), constant(0.5, 3), constant(1.0))
    scene = near(Scene("room", [replace(box(), vertices=points)], [grey]), origin_of([box()]))
    assert said in surface_notes(scene)[0]
    assert surface_notes(scene)[0].startswith("warning") == bool(said)


SHAPES = f"""<scene version="3.0.0">
<bsdf type="diffuse" id="paint"/>
<shape type="ply" id="box"><string name="filename" value="box.ply"/><ref id="paint"/></shape>
<shape type="ply" id="text"><string name="filename" value="text.ply"/><ref id="paint"/></shape>
<shape type="obj" id="obj"><string name="filename" value="box.obj"/><ref id="paint"/></shape>
<shape type="ply" id="placed"><string name="filename" value="near.ply"/><ref id="paint"/>
 <transform name="to_world"><scale value="2"/><translate x="{FAR[0]}" y="{FAR[1]}" z="{FAR[2]}"/></transform></shape>
<shape type="rectangle" id="sheet"><ref id="paint"/>
 <transform name="to_world"><translate x="{FAR[0]}" y="{FAR[1]}" z="{FAR[2]}"/></transform></shape>
<shape type="sphere" id="ball"><point name="center" x="{FAR[0]}" y="{FAR[1]}" z="{FAR[2]}"/>
 <float name="radius" value="0.5"/><ref id="paint"/></shape>
<shape type="cylinder" id="tube"><point name="p0" x="{FAR[0]}" y="{FAR[1]}" z="{FAR[2]}"/>
 <point name="p1" x="{FAR[0]}" y="{FAR[1] + 1}" z="{FAR[2]}"/><float name="radius" value="0.5"/>
 <ref id="paint"/></shape>
<emitter type="point" id="bulb"><point name="position" x="{FAR[0]}" y="{FAR[1]}" z="{FAR[2]}"/></emitter>
<emitter type="spot" id="spot">
 <transform name="to_world"><translate x="{FAR[0]}" y="{FAR[1]}" z="{FAR[2]}"/></transform></emitter>
</scene>"""


def test_a_scene_file_keeps_all_digits(tmp_path):
    (tmp_path / "box.ply").write_bytes(ply(BOX + FAR, "binary_big_endian"))
    (tmp_path / "text.ply").write_bytes(ply(BOX + FAR, "ascii"))
    (tmp_path / "near.ply").write_bytes(ply(BOX, "binary_big_endian"))
    (tmp_path / "box.obj").write_text(obj(BOX + FAR))
    (tmp_path / "scene.xml").write_text(SHAPES)
    camera_file(tmp_path)
    scene = read_folder(tmp_path)
    for name in ("box", "text", "obj"):
        np.testing.assert_allclose(corners(scene, name), (BOX + FAR)[TRIANGLES], rtol=0, atol=1e-6)
    np.testing.assert_allclose(corners(scene, "placed"), (2 * BOX + FAR)[TRIANGLES], rtol=0, atol=2e-6)
    for name, low, high in (
        ("sheet", (-1, -1, 0), (1, 1, 0)),
        ("ball", (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)),
        ("tube", (-0.5, 0, -0.5), (0.5, 1, 0.5)),
    ):
        there = corners(scene, name).reshape(-1, 3) - FAR
        np.testing.assert_allclose([there.min(0), there.max(0)], [low, high], atol=1e-6)
    for light in scene.punctual:
        np.testing.assert_allclose(light.position + np.asarray(scene.origin), FAR, rtol=0, atol=1e-6)
    np.testing.assert_allclose(
        scene.test[0].camera.to_world[:3, 3] + scene.origin, np.add(FAR, (2, 1.5, 1)), rtol=0, atol=1e-6
    )


@pytest.mark.parametrize("name", ["scene.gltf", "scene.glb"])
def test_a_gltf_scene_keeps_all_digits(tmp_path, name):
    document = Document()
    mesh = document.mesh({"POSITION": document.accessor(BOX)}, document.accessor(TRIANGLES.ravel(), "u2"))
    inner = document.add("nodes", {"name": "box", "mesh": mesh, "translation": [1.0, 2.0, 3.0]})
    outer = document.add("nodes", {"translation": FAR.tolist(), "children": [inner]})
    document.json["scenes"][0]["nodes"] = [outer]
    getattr(document, name[-4:].strip("."))(tmp_path / name)
    camera_file(tmp_path)
    scene = read_folder(tmp_path)
    np.testing.assert_allclose(corners(scene), (BOX + FAR + (1, 2, 3))[TRIANGLES], rtol=0, atol=1e-6)
    np.testing.assert_allclose(
        scene.test[0].camera.to_world[:3, 3] + scene.origin, np.add(FAR, (2, 1.5, 1)), rtol=0, atol=1e-6
    )


def test_places_and_cameras_are_understood_in_both_ways(tmp_path):
    (tmp_path / "scene.xml").write_text(SHAPES.replace('"box.obj"', '"box.ply"').replace('type="obj"', 'type="ply"'))
    for name, data in (("box.ply", BOX + FAR), ("text.ply", BOX + FAR), ("near.ply", BOX)):
        (tmp_path / name).write_bytes(ply(data, "binary_big_endian"))
    camera_file(tmp_path)
    scene = read_folder(tmp_path)
    near = BOX + FAR - scene.origin
    np.testing.assert_allclose(in_scene(BOX + FAR, scene), near)
    np.testing.assert_allclose(in_scene(near, scene), near)
    pose = np.eye(4)
    pose[:3, 3] = FAR
    moved = camera_in_scene(Camera(pose, 1.0, 8, 6), scene)
    np.testing.assert_allclose(moved.to_world[:3, 3], FAR - scene.origin)
    np.testing.assert_array_equal(camera_in_scene(moved, scene).to_world, moved.to_world)
    unmoved = replace(scene, origin=(0.0, 0.0, 0.0))
    np.testing.assert_array_equal(in_scene(FAR, unmoved), FAR)


def test_copies_of_a_file_are_counted(tmp_path, monkeypatch):
    (tmp_path / "box.ply").write_bytes(ply(BOX, "ascii"))
    shape = '<shape type="ply"><string name="filename" value="box.ply"/></shape>'
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{shape * 3}</scene>')
    camera_file(tmp_path, np.zeros(3))
    assert len(read_folder(tmp_path).meshes) == 3
    monkeypatch.setattr("neurad.scene.polygons.MAX_TRIANGLES", 13)
    with pytest.raises(InputError, match=r"with shape .*: it would have 18 triangles"):
        read_folder(tmp_path)


def test_a_written_scene_has_its_place_and_mitsuba_may_leave_it_out(mi, tmp_path):
    (tmp_path / "near.ply").write_bytes(ply(BOX, "binary_big_endian"))
    lines = [line for line in SHAPES.splitlines() if "box" not in line and "text" not in line]
    (tmp_path / "scene.xml").write_text("\n".join(lines))
    camera_file(tmp_path)
    scene = read_folder(tmp_path)
    folder = tmp_path / "written"
    folder.mkdir()
    write_xml(describe(scene, folder), folder / "scene.xml")
    camera_file(folder)
    again = read_folder(folder)
    np.testing.assert_array_equal(again.origin, scene.origin)
    np.testing.assert_allclose(corners(again, "placed"), (2 * BOX + FAR)[TRIANGLES], rtol=0, atol=2e-6)
    for light in again.punctual:
        np.testing.assert_allclose(light.position + np.asarray(again.origin), FAR, rtol=0, atol=1e-6)
    loaded = mi.load_file(str(folder / "scene.xml"), **dict.fromkeys(ORIGIN, "0"))
    np.testing.assert_allclose([loaded.bbox().min, loaded.bbox().max], scene.bounds, atol=1e-5)
