"""Mesh files of other programs: polygons, indices, names, and what is cut short."""

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from neurad.cli import main
from neurad.core.errors import InputError
from neurad.formats.meshes.files import read_meshes
from neurad.images.image_io import read_exr, to_srgb

CASES = Path(__file__).resolve().parents[3] / "shared" / "cases"
POINTS = np.array([(0, 0, 0), (2, 0, 0), (0.3, 0.3, 0), (0, 2, 0), (3, 0, 0), (3, 2, 0), (2, 2, 0)], float)
FACES = [[0, 1, 2, 3], [1, 4, 6], [4, 5, 6]]
"""A dart and two triangles: areas 0.6, 1 and 1."""
OBJ_POINTS = "".join(f"v {x} {y} {z}\n" for x, y, z in POINTS)


def area(mesh):
    return trimesh.triangles.area(np.asarray(mesh.vertices, np.float64)[mesh.faces]).sum()


def read(tmp_path, name, content):
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_meshes(tmp_path / name)


# ---- OBJ


def test_negative_indices_count_from_what_was_read_so_far(tmp_path):
    """Vertices, texture coordinates and normals between the faces, each counted by itself."""
    text = """
vt 9 9
v 0 0 0
v 1 0 0
v 0 1 0
vt 0 0
vt 1 0
vt 0 1
vn 0 0 1
f -3/-3/-1 -2/-2/-1 -1/-1/-1
v 0 0 5
v 2 0 5
v 0 2 5
vn 0 1 0
vt .5 .5
f -3/-1/1 5/-1/-1 -1/-1/2
f 1/2/1 -5/3/1 -6/4/1
"""
    (mesh,) = read(tmp_path, "a.obj", text).meshes
    corners = mesh.vertices[mesh.faces]
    np.testing.assert_array_equal(corners[0], [(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    np.testing.assert_array_equal(corners[1], [(0, 0, 5), (2, 0, 5), (0, 2, 5)])
    np.testing.assert_array_equal(corners[2], [(0, 0, 0), (1, 0, 0), (0, 0, 0)])
    np.testing.assert_array_equal(mesh.uvs[mesh.faces[:2]], [[(0, 0), (1, 0), (0, 1)], [(0.5, 0.5)] * 3])
    np.testing.assert_array_equal(mesh.normals[mesh.faces[:2]], [[(0, 0, 1)] * 3, [(0, 0, 1), (0, 1, 0), (0, 1, 0)]])


@pytest.mark.parametrize(
    ("lines", "names"),
    [
        ("o walls|0|o lamp|1 2", ["walls", "lamp"]),
        ("g walls|0|g lamp two|1 2", ["walls", "lamp two"]),
        ("g all|o walls|0|o lamp|1|o walls|2", ["walls", "lamp"]),
        ("o room|g walls|0|g lamp|1 2", ["walls", "lamp"]),
        ("usemtl white|o walls|0|o lamp|1 2", ["walls", "lamp"]),
        ("o walls|usemtl red|0|usemtl blue|1 2", ["red", "blue"]),
        ("0|g lamp|1 2", ["a", "lamp"]),
        ("o walls|0 1 2", ["a"]),
    ],
)
def test_names_of_meshes(tmp_path, lines, names):
    rows = []
    for line in lines.split("|"):
        faces = line.split() if line[0].isdigit() else []
        rows += ["f " + " ".join(str(i + 1) for i in FACES[int(k)]) for k in faces] or [line]
    found = read(tmp_path, "a.obj", OBJ_POINTS + "\n".join(rows) + "\n")
    assert [mesh.name for mesh in found.meshes] == names
    assert sum(map(area, found.meshes)) == pytest.approx(2.6)


def test_material_files_are_found_whatever_their_case_and_missing_ones_are_named(tmp_path):
    (tmp_path / "Room.MTL").write_text("newmtl glow\nKe 1 2 3\nnewmtl dark\nKe 0 0 0\n")
    text = OBJ_POINTS + "mtllib room.mtl\nmtllib gone.mtl\nusemtl glow\nf 1 2 3\nusemtl other\nf 1 3 4\n"
    found = read(tmp_path, "a.obj", text)
    np.testing.assert_array_equal(found.meshes[0].radiance, [1, 2, 3])
    assert found.meshes[1].radiance is None
    assert "its material file gone.mtl is not there" in found.notes[0]
    assert "its material files have no material other" in found.notes[1]


def test_coordinates_keep_all_digits_and_lines_go_on_or_end_in_any_way(tmp_path):
    (mesh,) = read(tmp_path, "a.obj", "v 441545.5021 0 0\nv 441549.5023 0 0\nv 0 1 -5121948.0137\nf 1 2 3\n").meshes
    np.testing.assert_array_equal(mesh.vertices[:, 0], [441545.5021, 441549.5023, 0])
    assert mesh.vertices[2, 2] == -5121948.0137

    text = OBJ_POINTS.replace("\n", "\r\n") + "vt 0 0\r\nf 1 2 \\\r\n 3 4 # a dart\r\nf 2/1 5 7/1/\r\nl 1 2\r\nf 5 6 7"
    (mesh,) = read(tmp_path, "a.obj", text).meshes
    assert area(mesh) == pytest.approx(2.6)
    assert mesh.uvs is None

    (mesh,) = read(tmp_path, "a.obj", (OBJ_POINTS + "f 1 2 3 4\n").replace("\n", "\r")).meshes
    assert area(mesh) == pytest.approx(0.6)


CUT = {
    "in a vertex": ("f 1 2 3\nv 1 2", r"line 9 is 'v 1 2'.*; the file is cut short"),
    "in a face": ("f 1 2 3\nf 5 6", r"line 9 is 'f 5 6'.*; the file is cut short"),
    "in a corner": ("f 1/2/3 2/2/3 3/2/3\nf 1/1/1 2/1/1 3/", r"line 9 is .*cut short"),
    "before the faces": ("", "it has no triangle"),
    "back too far": ("f -1 -2 -9", "line 8 is|counts back"),
    "vertex 0": ("f 0 1 2\n", "face 1 names vertex 0, of 7"),
}


@pytest.mark.parametrize("case", CUT)
def test_an_obj_that_is_cut_short_is_refused(tmp_path, case):
    rest, said = CUT[case]
    with pytest.raises(InputError, match=said):
        read(tmp_path, "a.obj", OBJ_POINTS + rest)


def test_vertices_after_the_last_face_are_told(tmp_path):
    (note,) = read(tmp_path, "a.obj", OBJ_POINTS + "f 1 2 3\nv 0 0 0\nv 0 0 1\n").notes
    assert "2 vertices follow its last face" in note


# ---- PLY

NUMBERS = {"uchar": "B", "char": "b", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}


def ply(kind, faces=FACES, length="uchar", index="int", real="float", cut=None, said=None):
    """A file with elements and properties beside vertices and faces, and lists before and after the corners."""
    rows = [("vertex", [(real, p[0]), ("uchar", 7), (real, p[1]), (real, p[2])]) for p in POINTS]
    rows += [("strip", [("ushort", [*range(k)]), ("int", -k)]) for k in (2, 0, 3)]
    rows += [("face", [("float", [0.5] * len(f)), (index, f), ("char", -1)]) for f in faces]
    rows += [("camera", [("double", 1.5)])]
    header = [
        "ply", f"format {kind} 1.0", "comment Küche", f"element vertex {len(POINTS)}", f"property {real} x",
        "property uchar red", f"property {real} y", f"property {real} z", "element strip 3",
        "property list int ushort ids", "property int k", f"element face {said or len(faces)}",
        f"property list {length} float weights", f"property list {length} {index} vertex_indices", "property char mark",
        "element camera 1", "property double f", "end_header",
    ]  # fmt: skip
    order = ">" if "big" in kind else "<"
    body = b""
    for element, values in rows:
        words = []
        for number, value in values:
            if isinstance(value, list):
                words.append(("int" if element == "strip" else length, len(value)))
            words += [(number, x) for x in (value if isinstance(value, list) else [value])]
        if kind == "ascii":
            body += " ".join(f"{x:.17g}" for _, x in words).encode() + b"\n"
        else:
            body += b"".join(struct.pack(order + NUMBERS[number], x) for number, x in words)
    return "\n".join([*header, ""]).encode() + body[:cut]


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("faces", [FACES, FACES[:1], FACES[1:]], ids=["mixed", "quads", "triangles"])
@pytest.mark.parametrize(("length", "index", "real"), [("uchar", "int", "float"), ("uint", "uchar", "double")])
def test_ply_files_of_every_kind(tmp_path, kind, faces, length, index, real):
    found = read(tmp_path, "a.ply", ply(kind, faces, length, index, real))
    (mesh,) = found.meshes
    expected = sum({4: 0.6, 3: 1.0}[len(face)] for face in faces)
    assert area(mesh) == pytest.approx(expected, rel=1e-6)
    used = sorted({i for face in faces for i in face})
    np.testing.assert_allclose(mesh.vertices, POINTS[used], rtol=1e-7)
    assert not found.linkable  # it has lists that are no triangles


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("faces", [FACES, FACES[1:]], ids=["mixed", "triangles"])
def test_a_ply_that_is_cut_short_is_refused_with_both_counts(tmp_path, kind, faces):
    whole = ply(kind, faces)
    start = whole.index(b"end_header\n") + len(b"end_header\n")
    size = len(whole) - start - 8  # the last number may lose digits in text, which nothing tells
    seen = set()
    for cut in range(0, size, 3):
        with pytest.raises(InputError, match=r"says \d+ .*, but \d+ are there|something else than numbers") as told:
            read(tmp_path, "a.ply", whole[: start + cut])
        seen.add(str(told.value).partition(" says ")[2].partition(":")[0])
    assert f"{len(faces)} faces, but {len(faces) - 1} are there" in seen
    assert "7 vertices, but 6 are there" in seen
    with pytest.raises(InputError, match="follow after what its PLY header announces"):
        read(tmp_path, "a.ply", whole + b" 7")


def test_broken_lists_are_refused(tmp_path):
    with pytest.raises(InputError, match="face 1 names vertex 9, of 7"):
        read(tmp_path, "a.ply", ply("ascii", [[0, 1, 2], [0, 1, 9]]))
    with pytest.raises(InputError, match="its header says 1 faces, but 0 are there"):
        read(tmp_path, "a.ply", ply("ascii", [[0, 1, 2]]).replace(b"\n3 0.5", b"\n-1 0.5"))
    with pytest.raises(InputError, match="its header says 9000000000000 faces"):
        read(tmp_path, "a.ply", ply("binary_little_endian", said=9 * 10**12))
    with pytest.raises(InputError, match="property list float float weights"):
        read(tmp_path, "a.ply", ply("ascii", length="float"))


# ---- STL


def stl(count):
    facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
    return "".join(f"solid part {k}\n{facet * (k + 1)}endsolid part {k}\n" for k in range(count))


def test_an_stl_of_text_has_its_solids_and_is_whole(tmp_path):
    assert [(mesh.name, len(mesh.faces)) for mesh in read(tmp_path, "a.stl", stl(2)).meshes] == [
        ("part 0", 1), ("part 1", 2),
    ]  # fmt: skip
    for lost in (10, 30, 60, 80):
        with pytest.raises(InputError, match=r"cut short|it has no triangle"):
            read(tmp_path, "a.stl", stl(2)[:-lost])


def test_a_binary_stl_that_is_cut_short_is_refused(tmp_path):
    triangle = struct.pack("<12fH", 0, 0, 1, *POINTS[[0, 1, 3]].ravel(), 0)
    data = b"solid, says who".ljust(80) + struct.pack("<I", 3) + triangle * 3
    (mesh,) = read(tmp_path, "a.stl", data).meshes
    assert area(mesh) == pytest.approx(6.0)
    with pytest.raises(InputError, match="its header says 3 triangles, but 2 are there"):
        read(tmp_path, "a.stl", b"binary".ljust(80) + data[80:-9])


# ---- files by others


@pytest.mark.skipif(not CASES.is_dir(), reason="../shared/cases is not there")
@pytest.mark.parametrize(
    ("name", "true"), [("c12/room.obj", 55.9), ("concave_polygon.obj", 0.2454967), ("wallhole.obj", 721.4213562)]
)
def test_files_with_concave_polygons_have_their_area(name, true):
    found = read_meshes(CASES / name)
    assert sum(map(area, found.meshes)) == pytest.approx(true, rel=1e-6)


@pytest.mark.skipif(not CASES.is_dir(), reason="../shared/cases is not there")
@pytest.mark.parametrize(
    ("name", "meshes", "lamp"),
    [("c14", ["room.obj"], ["--lamp", "lamp=12,11,9"]),
     ("c18mixed", ["room.ply", "lamp.obj"], []), ("c27utm", ["room.obj"], [])],
)  # fmt: skip
def test_imports_look_like_their_photographs(tmp_path, name, meshes, lamp):
    """At 12 samples a pixel the noise leaves about 30 dB, and the mean 0.5 %."""
    source, out = CASES / name, tmp_path / "room"
    files = [str(source / mesh) for mesh in meshes]
    main(["data", "nerfstudio", str(source), "--mesh", *files, *lamp, "--out", str(out)])
    main(["render", "--root", str(out), "--out", str(tmp_path / "pictures"), "--spp", "12"])
    for photograph in sorted((source / "images").glob("*.exr")):
        true, made = read_exr(photograph)[..., :3], read_exr(tmp_path / "pictures/images" / photograph.name)[..., :3]
        error = np.square(to_srgb(made / true.mean() / 4.0) - to_srgb(true / true.mean() / 4.0)).mean()
        assert -10.0 * np.log10(error) > 26.0
        assert made.mean() == pytest.approx(true.mean(), rel=0.02)
