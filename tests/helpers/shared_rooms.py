"""The shared rooms in the layouts of other programs: written without a line of the product's writers, their photographs
linked, and read back by ``neurad data``.
"""

import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from helpers import layouts
from helpers.gltf_rooms import coded, shown, written
from neurad.cli import main
from neurad.core.records import Constant, Material
from neurad.core.reflection import PrincipledModel
from neurad.formats.load import read_folder
from neurad.images.image_io import from_srgb

ROOMS = Path(__file__).resolve().parents[3] / "shared" / "scenes"
PAINT = Material(
    "paint", PrincipledModel(), Constant(np.full(3, 0.5, np.float32)), Constant(np.full(1, 0.5, np.float32))
)
"""As ``neurad data`` makes it up for surfaces of which it knows no more."""


def views_of(scene):
    """Training views, then those held out."""
    return [*scene.train, *scene.test]


# ---- meshes


def _solid(mesh, moved=lambda p, normal: (p, normal)):
    vertices, normals = moved(mesh.vertices.astype(np.float64), mesh.normals.astype(np.float64))
    return trimesh.Trimesh(vertices, mesh.faces, vertex_normals=normals, process=False)


def ply_files(scene, folder, moved=None):
    """One PLY file a mesh by trimesh, with normals, and what says that lamps shine."""
    folder.mkdir()
    words = ["--mesh"]
    for mesh in scene.meshes:
        solid = _solid(mesh) if moved is None else _solid(mesh, moved)
        (folder / f"{mesh.name}.ply").write_bytes(solid.export(file_type="ply", vertex_normal=True))
        words.append(str(folder / f"{mesh.name}.ply"))
    return words + shining(scene)


def own_files(scene, folder):
    """The room's own PLY files, whose bits all stay."""
    words = ["--mesh"]
    for shape in ElementTree.parse(ROOMS / scene.name / "scene.xml").getroot().findall("shape"):
        assert shape.find("transform") is None
        path = folder / f"{shape.get('id')}.ply"
        path.parent.mkdir(exist_ok=True)
        path.symlink_to((ROOMS / scene.name / shape.find("string[@name='filename']").get("value")).resolve())
        words.append(str(path))
    return words + shining(scene)


def shining(scene):
    """What says that lamps shine."""
    lamps = [mesh for mesh in scene.meshes if mesh.radiance is not None]
    return [x for m in lamps for x in ("--lamp", f"{m.name}={','.join(repr(float(x)) for x in m.radiance)}")]


def centimetres(scene, folder):
    """As :func:`ply_files`, in centimetres and with +Z up."""
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # (x, y, z) of z up to (x, z, -y)
    words = ply_files(scene, folder, lambda p, normal: (100.0 * p @ turn, normal @ turn))
    return [*words, "--up", "z", "--scale", "0.01"]


def _rows(letter, values):
    form = f"{letter} " + " ".join(["%.9g"] * values.shape[1])
    return "\n".join(form % tuple(row) for row in values.tolist())


def obj_file(scene, folder, name="room.obj"):
    """One OBJ file with a material a mesh, whose ``Ke`` says how lamps shine."""
    folder.mkdir(parents=True, exist_ok=True)
    materials, parts, first = [], ["mtllib room.mtl"], 1
    for mesh in scene.meshes:
        materials.append(f"newmtl {mesh.name}\nKd 0.5 0.5 0.5")
        if mesh.radiance is not None:
            materials.append("Ke " + " ".join(repr(float(x)) for x in mesh.radiance))
        parts += [_rows("v", mesh.vertices), _rows("vn", mesh.normals), f"usemtl {mesh.name}"]
        corners = (mesh.faces + first).tolist()
        parts.append("\n".join(f"f {a}//{a} {b}//{b} {c}//{c}" for a, b, c in corners))
        first += len(mesh.vertices)
    (folder / "room.mtl").write_text("\n".join(materials) + "\n")
    (folder / name).write_text("\n".join(parts) + "\n")
    return folder / name


def usd_file(scene, path):
    """A stage of meshes, and materials that shine."""
    from pxr import Sdf, Usd, UsdGeom, UsdShade, Vt

    stage = Usd.Stage.CreateNew(str(path))
    for mesh in scene.meshes:
        prim = UsdGeom.Mesh.Define(stage, f"/room/{mesh.name.replace('-', '_')}")
        prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.vertices, np.float32)))
        prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
        prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.ravel().astype(np.int32)))
        prim.CreateSubdivisionSchemeAttr("none")
        prim.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.normals, np.float32)))
        prim.SetNormalsInterpolation("vertex")
        if mesh.radiance is not None:
            material = UsdShade.Material.Define(stage, f"/looks/{mesh.name.replace('-', '_')}")
            shader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("shader"))
            shader.CreateIdAttr("UsdPreviewSurface")
            value = tuple(float(x) for x in mesh.radiance)
            shader.CreateInput("emissiveColor", Sdf.ValueTypeNames.Color3f).Set(value)
            material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
            UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)
    stage.GetRootLayer().Save()
    return path


# ---- layouts: each writes a room into a folder and answers with the words of ``neurad data`` that read it


def _shots(scene):
    """Puts links to a room's own photographs and maps where a layout has them."""
    by_camera = {id(view.camera): view for view in views_of(scene)}

    def shoot(path, camera, kind, index):
        path.parent.mkdir(parents=True, exist_ok=True)
        if (source := getattr(by_camera[id(camera)], kind)) is not None:
            path.symlink_to(Path(source).resolve())

    return shoot


def _cameras(scene):
    return [view.camera for view in views_of(scene)]


def _nerfstudio(scene, folder):
    """With lists of names that say what is held out."""
    layouts.write_nerfstudio(folder, _cameras(scene), shoot=_shots(scene))
    described = json.loads((folder / "transforms.json").read_text())
    names = [frame["file_path"] for frame in described["frames"]]
    count = len(scene.train)
    described |= {"train_filenames": names[:count], "test_filenames": names[count:]}
    (folder / "transforms.json").write_text(json.dumps(described))


def nerfstudio(scene, folder):
    _nerfstudio(scene, folder / "src")
    return ["nerfstudio", str(folder / "src"), *ply_files(scene, folder / "mesh")]


def nerfstudio_own(scene, folder):
    _nerfstudio(scene, folder / "src")
    return ["nerfstudio", str(folder / "src"), *own_files(scene, folder / "mesh")]


def usd(scene, folder):
    _nerfstudio(scene, folder / "src")
    return ["nerfstudio", str(folder / "src"), "--mesh", str(usd_file(scene, folder / "room.usdc"))]


def colmap_text(scene, folder):
    layouts.write_colmap(folder / "src", _cameras(scene), False, shoot=_shots(scene))
    return ["colmap", str(folder / "src"), "--mesh", str(obj_file(scene, folder / "mesh"))]


def colmap_binary(scene, folder):
    layouts.write_colmap(folder / "src", _cameras(scene), True, shoot=_shots(scene))
    return ["colmap", str(folder / "src"), *centimetres(scene, folder / "mesh")]


def polycam(scene, folder):
    layouts.write_polycam(folder / "src", _cameras(scene), _shots(scene))
    mesh = written(replace(scene, materials=[shown(m) for m in scene.materials]), folder / "room.glb")
    return ["polycam", str(folder / "src"), "--mesh", str(mesh)]


def fipt_rendered(scene, folder):
    cameras = [view.camera for view in (*scene.test, *scene.train)]
    layouts.write_fipt_rendered(
        folder / "src", cameras, len(scene.test), _shots(scene), lambda place: obj_file(scene, place)
    )
    return ["fipt", str(folder / "src")]


def fipt_photographed(scene, folder):
    layouts.write_fipt_photographed(
        folder / "src", _cameras(scene), _shots(scene), lambda place: obj_file(scene, place)
    )
    return ["fipt", str(folder / "src")]


def gltf(scene, folder):
    (folder / "photographs").mkdir()
    for view in views_of(scene):
        (folder / f"photographs/{view.name}.exr").symlink_to(Path(view.image).resolve())
    shining = replace(scene, materials=[shown(material) for material in scene.materials])
    glb = written(shining, folder / "room.glb", views_of(scene))
    return ["gltf", str(glb), "--images", str(folder / "photographs")]


LAYOUTS: dict[str, Callable] = {
    "nerfstudio, its own PLY": nerfstudio_own,
    "nerfstudio, PLY": nerfstudio,
    "COLMAP text, OBJ": colmap_text,
    "COLMAP binary, PLY in cm with +Z up": colmap_binary,
    "Polycam, GLB": polycam,
    "FIPT rendered": fipt_rendered,
    "FIPT photographed": fipt_photographed,
    "glTF": gltf,
    "nerfstudio, USD": usd,
}


def read_back(name, layout, folder):
    """Write a shared room in a layout, and make a scene folder of that.

    Returns:
        The room, and the folder.
    """
    scene = read_folder(ROOMS / name)
    folder.mkdir()
    words = LAYOUTS[layout](scene, folder)
    if scene.environment is not None:
        words += ["--environment", str(ROOMS / name / "env.exr")]
    main(["data", *words, "--out", str(folder / "room")])
    return scene, folder / "room"


def in_order(scene, again):
    """The meshes of a room that was read back, in the order of those that were written."""
    named = {mesh.name.replace("_", "-"): mesh for mesh in again.meshes}
    assert len(named) == len(again.meshes) == len(scene.meshes)
    return [named[mesh.name.replace("_", "-")] for mesh in scene.meshes]


# ---- what a layout cannot say


def original(view):
    """The file that a photograph of a folder is in the end."""
    return Path(view.image).resolve()


def hand_over(scene, room):
    """Add to a folder, as its documentation says, what its layout has no place for: which views are held out and their
    true maps, how long its paths are, and what lamps are made of, which no photograph shows.
    """
    known = {original(view): view for view in views_of(scene)}
    held_out = {original(view) for view in scene.test}
    if (room / "transforms.json").is_file():
        described = json.loads((room / "transforms.json").read_text())
        names = [frame["file_path"] for frame in described["frames"]]
        for part, there in (("train_filenames", False), ("test_filenames", True)):
            described[part] = [name for name in names if ((room / name).resolve() in held_out) == there]
        (room / "transforms.json").write_text(json.dumps(described))
    for view in views_of(read_folder(room)):
        for kind in ("albedo", "roughness"):
            if getattr(view, kind) is None:
                place = room / kind / Path(view.image).name
                place.parent.mkdir(exist_ok=True)
                place.symlink_to(Path(getattr(known[original(view)], kind)).resolve())
    if (room / "scene.xml").is_file():
        _describe(scene, room / "scene.xml", (scene.max_depth, scene.rr_depth))


def as_gltf_has_it(name, folder):
    """A shared room with what glTF says of it: paths have no longest length, and what lamps reflect has 8 bits."""
    scene = read_folder(ROOMS / name)
    folder.mkdir()
    for entry in (ROOMS / name).iterdir():
        if entry.name != "scene.xml":
            (folder / entry.name).symlink_to(entry)
    (folder / "scene.xml").write_bytes((ROOMS / name / "scene.xml").read_bytes())
    of_bytes = [
        replace(m, albedo=Constant(from_srgb(coded(m.albedo, True)[0, 0] / np.float32(255))))
        if isinstance(m.albedo, Constant)
        else m
        for m in scene.materials
    ]
    _describe(replace(scene, materials=of_bytes), folder / "scene.xml", (-1, 5))
    return folder


def _describe(scene, path, depths):
    """Give a scene file the longest paths, and its lamps their own surfaces."""
    tree = ElementTree.parse(path)
    integrator = tree.getroot().find("integrator")
    for name, depth in zip(("max_depth", "rr_depth"), depths, strict=True):
        for said in integrator.findall(f"integer[@name='{name}']"):
            integrator.remove(said)
        ElementTree.SubElement(integrator, "integer", name=name, value=str(depth))
    shapes = [shape for shape in tree.getroot().findall("shape") if shape.find("emitter") is not None]
    by_name = {shape.get("id").replace("_", "-"): shape for shape in shapes}  # USD has no names with a hyphen
    lamps = [mesh for mesh in scene.meshes if mesh.radiance is not None]
    assert len(lamps) == len(shapes)
    for mesh in lamps:
        shape = by_name[mesh.name.replace("_", "-")]
        for made_up in (*shape.findall("ref"), *shape.findall("bsdf")):
            shape.remove(made_up)
        material = scene.materials[mesh.material]
        around = ElementTree.SubElement(shape, "bsdf", type="twosided")
        surface = ElementTree.SubElement(around, "bsdf", type="principled")
        colour = ", ".join(repr(float(x)) for x in np.broadcast_to(material.albedo.value, 3))
        ElementTree.SubElement(surface, "rgb", name="base_color", value=colour)
        ElementTree.SubElement(surface, "float", name="roughness", value=repr(float(material.roughness.value[0])))
    tree.write(path)


def painted(scene, meshes):
    """A scene of these meshes, all of one paint."""
    return replace(scene, meshes=[replace(mesh, material=0) for mesh in meshes], materials=[PAINT])
