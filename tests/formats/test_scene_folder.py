"""Scene folders: conventions against Mitsuba itself, and one sentence for everything that can be wrong."""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.tiny_scene import PLY, POSE, SIZE, XML, read_json, write_json, write_scene
from PIL import Image

from neurad.assembly.build import build_world
from neurad.core.camera import camera_rays
from neurad.core.errors import InputError
from neurad.core.lens import Lens
from neurad.core.records import Bitmap, Camera, Rays, View
from neurad.core.reflection import DiffuseModel, RoughPlasticModel
from neurad.formats.cameras.nerf import read_views
from neurad.formats.cameras.transforms import transforms
from neurad.formats.load import load_scene, read_folder
from neurad.formats.mitsuba.plugin import to_mitsuba
from neurad.images.image_io import write_exr
from neurad.scene.builtin import build_cornell
from neurad.scene.geometry import Geometry
from neurad.scene.textures import TrueMaterials
from neurad.tracing.embree import EmbreeTracer

mi = pytest.importorskip("mitsuba")
ROOMS = Path(__file__).resolve().parents[3] / "shared" / "scenes"

# Boxes and lights around the origin: mirrored and flipped, every texture, one-sided and two-sided.
CONVENTIONS = """<scene version="3.0.0">
  <integrator type="path"><integer name="max_depth" value="-1"/></integrator>
  <bsdf type="twosided" id="tiled"><bsdf type="principled">
    <texture type="bitmap" name="base_color"><string name="filename" value="rgb.png"/>
      <transform name="to_uv"><rotate z="1" angle="25"/><scale x="2.5" y="-1.5"/><translate x="0.3"/></transform>
    </texture>
    <texture type="bitmap" name="roughness"><string name="filename" value="grey.png"/>
      <boolean name="raw" value="true"/></texture>
  </bsdf></bsdf>
  <bsdf type="twosided" id="attribute"><bsdf type="principled">
    <texture type="mesh_attribute" name="base_color"><string name="name" value="vertex_color"/></texture>
    <texture type="bitmap" name="roughness"><string name="filename" value="rgb.png"/></texture>
  </bsdf></bsdf>
  <bsdf type="diffuse" id="plain"><texture type="bitmap" name="reflectance">
    <string name="filename" value="grey.png"/></texture></bsdf>
  <shape type="cube" id="box"><transform name="to_world"><scale x="2" y="-0.5" z="1"/><rotate y="1" angle="30"/>
    <translate z="-5"/></transform><ref id="tiled"/></shape>
  <shape type="ply" id="bowl"><string name="filename" value="bowl.ply"/>
    <transform name="to_world"><scale x="-1.5" y="1" z="1"/><translate z="4"/></transform><ref id="attribute"/></shape>
  <shape type="obj" id="kite"><string name="filename" value="kite.obj"/>
    <transform name="to_world"><translate x="4"/></transform><ref id="plain"/></shape>
  <shape type="cube" id="lamp"><boolean name="flip_normals" value="true"/>
    <transform name="to_world"><scale value="9"/></transform><ref id="plain"/>
    <emitter type="area"><rgb name="radiance" value="1, 2, 3"/></emitter></shape>
  <shape type="cube" id="mirrored"><transform name="to_world"><scale x="-1"/><translate x="-4"/></transform>
    <emitter type="area"><float name="radiance" value="4"/></emitter></shape>
  <shape type="rectangle" id="panel"><boolean name="flip_normals" value="true"/>
    <transform name="to_world"><scale x="-1"/><rotate x="1" angle="70"/><translate y="4"/></transform>
    <bsdf type="twosided"><bsdf type="principled"/></bsdf>
    <emitter type="area"><spectrum name="radiance" value="4"/></emitter></shape>
  <shape type="rectangle" id="flat"><boolean name="face_normals" value="true"/>
    <transform name="to_world"><rotate x="1" angle="90"/><translate y="-4"/></transform><ref id="tiled"/></shape>
</scene>
"""


def write_conventions(folder):
    rng = np.random.default_rng(3)
    Image.fromarray(rng.integers(0, 256, (5, 7, 3), dtype=np.uint8)).save(folder / "rgb.png")
    Image.fromarray(rng.integers(0, 256, (6, 4), dtype=np.uint8)).save(folder / "grey.png")
    names = ["x", "y", "z", "nx", "ny", "nz", "r", "g", "b"]
    head = "".join(f"property float {name}\n" for name in names)
    corners = np.array([[-1, -1, 0], [1, -1, 0.2], [1, 1, 0], [-1, 1, 0.3]])
    normals = np.array([[-0.3, -0.2, 1], [0.2, -0.1, 1], [0.1, 0.3, 1], [-0.2, 0.1, 1]])
    rows = np.hstack((corners, normals / np.linalg.norm(normals, axis=1, keepdims=True), rng.random((4, 3))))
    body = "\n".join(" ".join(f"{x:.7f}" for x in row) for row in rows)
    text = f"ply\nformat ascii 1.0\nelement vertex 4\n{head}element face 2\nproperty list uchar int vertex_indices\n"
    (folder / "bowl.ply").write_text(f"{text}end_header\n{body}\n3 0 1 2\n3 0 2 3\n")
    (folder / "kite.obj").write_text(
        "v 0 -1 -1\nv 0.3 -1 1\nv 0 1 1\nv 0.2 1 -1\nvt 0.1 0.2\nvt 0.9 0.1\nvt 0.8 0.7\nvt 0.2 0.9\n"
        "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    )
    (folder / "scene.xml").write_text(CONVENTIONS)
    return folder / "scene.xml"


def compare_with_mitsuba(path, scene, rays):
    """Both renderers' surfaces at the same rays: worst differences by quantity, over hits both agree on."""
    mi.set_variant("scalar_rgb")
    theirs = mi.load_file(str(path), optimize=False)  # do not merge meshes
    geometry = Geometry(scene)
    si = geometry.interact(rays, EmbreeTracer(geometry.vertices, geometry.faces).closest(rays))
    materials = TrueMaterials(scene, geometry)
    surface = materials(si)
    front = ((si.ng * si.wo).sum(-1) > 0) & si.valid
    emission = geometry.emission[si.prim.clamp_min(0)] * front[:, None]
    worst = dict.fromkeys(("valid", "p", "n", "uv", "albedo", "roughness", "emission", "side"), 0.0)
    seen = set()
    for i in range(len(rays)):
        ray = mi.Ray3f(mi.Point3f(*rays.o[i].tolist()), mi.Vector3f(*rays.d[i].tolist()))
        mi_si = theirs.ray_intersect(ray)
        worst["valid"] = max(worst["valid"], float(mi_si.is_valid() != bool(si.valid[i])))
        if not mi_si.is_valid():
            continue
        mesh = scene.meshes[int(geometry.mesh_index[si.prim[i]])]
        assert mi_si.shape.id() == mesh.name
        seen.add(mesh.name)
        bsdf = mi_si.bsdf()
        values = {
            "p": (mi_si.p, si.p[i]), "n": (mi_si.sh_frame.n, si.n[i]), "uv": (mi_si.uv, si.uv[i]),
            "albedo": (bsdf.eval_diffuse_reflectance(mi_si), surface.albedo[i]),
            "emission": (mi_si.shape.emitter().eval(mi_si) if mi_si.shape.is_emitter() else 0, emission[i]),
            "side": (mi_si.wi.z > 0, (si.n[i] * si.wo[i]).sum() > 0),
        }  # fmt: skip
        if bsdf.has_attribute("roughness"):
            values["roughness"] = (bsdf.eval_attribute_1("roughness", mi_si), surface.roughness[i, 0])
        for name, (a, b) in values.items():
            difference = torch.tensor(as_list(a), dtype=torch.float64) - torch.as_tensor(b, dtype=torch.float64)
            worst[name] = max(worst[name], float(difference.abs().max()))
    return worst, seen


def as_list(value):
    return list(value) if hasattr(value, "__len__") else float(value)


def random_rays(count, low, high):
    rng = np.random.default_rng(5)
    o = rng.uniform(low, high, (count, 3))
    d = rng.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return Rays(torch.tensor(o, dtype=torch.float32), torch.tensor(d, dtype=torch.float32))


def test_conventions_equal_mitsubas(tmp_path):
    """Positions, shading normals, uv, textures, roughness, the side that lights shine to and the black side."""
    from neurad.formats.mitsuba.read import read_xml

    path = write_conventions(tmp_path)
    scene = read_xml(path)
    worst, seen = compare_with_mitsuba(path, scene, random_rays(3000, -5, 5))
    assert seen == {"box", "bowl", "kite", "lamp", "mirrored", "panel", "flat"}
    assert worst.pop("valid") == 0
    assert worst.pop("side") == 0
    assert worst.pop("emission") < 1e-5
    assert max(worst.values()) < 1e-4, worst
    assert scene.max_depth > 10**6


def test_bilinear_lookup_equals_mitsubas(tmp_path):
    """Exact lookups, far outside the unit square and at texel centres and borders, for both to_uv and none."""
    from neurad.formats.mitsuba.read import read_xml

    scene = read_xml(write_conventions(tmp_path))
    mi.set_variant("scalar_rgb")
    geometry = Geometry(scene)
    materials = TrueMaterials(scene, geometry)
    by_name = {m.name: i for i, m in enumerate(scene.materials)}
    rng = np.random.default_rng(7)
    uv = np.concatenate((rng.uniform(-3, 4, (200, 2)), rng.integers(-14, 28, (200, 2)) / 14.0))
    for name, file, raw in (("tiled", "rgb.png", False), ("plain", "grey.png", False)):
        texture = scene.materials[by_name[name]].albedo
        assert isinstance(texture, Bitmap)
        to_uv = mi.ScalarTransform3f(np.asarray(texture.to_uv, np.float64).tolist())
        theirs = mi.load_dict({"type": "bitmap", "filename": str(tmp_path / file), "raw": raw, "to_uv": to_uv})
        here = torch.tensor(uv, dtype=torch.float32)
        ours = materials.fields["albedo"].table._bilinear(torch.full((len(uv),), by_name[name]), here)
        for point, value in zip(uv, ours, strict=True):
            si = mi.SurfaceInteraction3f()
            si.uv = mi.Point2f(*point)
            np.testing.assert_allclose(value.numpy(), list(theirs.eval(si)), atol=2e-5)


def test_materials_of_both_kinds_and_misses(tmp_path):
    from neurad.formats.mitsuba.read import read_xml

    scene = read_xml(write_conventions(tmp_path))
    geometry = Geometry(scene)
    prim = torch.arange(len(geometry.faces)).repeat(2)
    third = torch.full((len(prim),), 1 / 3)
    valid = torch.arange(len(prim)) < len(geometry.faces)
    si = geometry.interact_at(torch.where(valid, prim, -1), third, third, torch.randn(len(prim), 3), valid)
    surface = TrueMaterials(scene, geometry)(si)
    models = [scene.materials[int(m)].model for m in geometry.material[prim[valid]]]
    assert [scene.features.models[i] for i in surface.model[valid].tolist()] == models
    assert {model.is_diffuse for model in models} == {True, False}
    names = [scene.meshes[int(m)].name for m in geometry.mesh_index[prim[valid]]]
    assert (surface.albedo[valid].amin(-1) > 0).tolist() == [name != "mirrored" for name in names], "black by default"
    assert surface.albedo[~valid].abs().max() == 0
    assert surface.roughness[~valid].abs().max() == 0


def test_delta_materials_and_environments(tmp_path):
    from neurad.formats.mitsuba.read import read_xml

    text = """<scene version="3.0.0">
      <shape type="rectangle"><bsdf type="conductor" id="gold"><string name="material" value="Au"/></bsdf></shape>
      <shape type="rectangle"><bsdf type="dielectric" id="glass"><float name="int_ior" value="1.4"/>
        <float name="ext_ior" value="1.0"/></bsdf></shape>
      <shape type="rectangle"/>
      <emitter type="envmap"><string name="filename" value="sky.exr"/><float name="scale" value="2"/>
        <transform name="to_world"><rotate y="1" angle="90"/></transform></emitter>
    </scene>"""
    (tmp_path / "scene.xml").write_text(text)
    sky = np.random.default_rng(0).random((4, 8, 3), np.float32).astype(np.float16).astype(np.float32)
    write_exr(tmp_path / "sky.exr", sky)
    scene = read_xml(tmp_path / "scene.xml").check()
    assert [m.model.label for m in scene.materials] == ["conductor", "dielectric", "diffuse"]
    gold = scene.materials[0].albedo.value
    assert gold[0] > 0.9 > gold[1] > 0.7 > 0.5 > gold[2]
    assert scene.materials[1].model.eta == pytest.approx(1.4)
    assert not scene.materials[2].two_sided
    np.testing.assert_allclose(scene.environment.pixels, 2 * sky)
    np.testing.assert_allclose(scene.environment.to_world[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-6)
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><shape type="rectangle"/><emitter type="constant">'
        '<rgb name="radiance" value="1, 2, 3"/></emitter></scene>'
    )
    pixels = read_xml(tmp_path / "scene.xml").environment.pixels
    np.testing.assert_allclose(pixels.reshape(-1, 3), np.tile([1, 2, 3], (pixels.size // 3, 1)))


def test_the_integrator_within_another_one(tmp_path):
    """``aov`` records beside the paths that the integrator inside it traces."""
    from neurad.formats.mitsuba.read import read_xml

    inside = '<integrator type="path"><integer name="max_depth" value="3"/></integrator>'
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><integrator type="aov"><string name="aovs" value="z:depth"/>'
        f'{inside}</integrator><shape type="rectangle"/></scene>'
    )
    assert read_xml(tmp_path / "scene.xml").max_depth == 3


def test_a_correct_folder(tmp_path):
    scene = load_scene(str(write_scene(tmp_path / "room")), None)
    assert (scene.name, scene.max_depth, scene.rr_depth) == ("room", 6, 4)
    assert [v.name for v in scene.train] == ["train_0", "train_1", "train_2"]
    camera = scene.train[0].camera
    assert (camera.width, camera.height, camera.fov_x, camera.to_world.dtype) == (SIZE, SIZE, 0.9, np.float64)
    np.testing.assert_array_equal(camera.to_world, POSE)
    assert Path(scene.test[1].image).is_absolute()
    assert scene.test[1].maps == {}
    lamp = scene.meshes[1]
    np.testing.assert_array_equal(lamp.radiance, [1, 2, 3])
    geometry = Geometry(scene)
    assert geometry.face_normal[geometry.mesh_index == 1][:, 1].allclose(torch.tensor(-1.0)), "the lamp shines down"


def test_camera_files_of_other_writers(tmp_path):
    """No size, no ending, fl_x in place of the angle, maps beside the photographs."""
    folder = write_scene(tmp_path / "room")
    frames = [{"file_path": "./images/train_0", "transform_matrix": POSE}]
    write_json(folder, "train", {"fl_x": 10.0, "cx": 4.0, "frames": frames})
    (folder / "albedo").mkdir()
    write_exr(folder / "albedo/train_0.exr", np.zeros((SIZE, SIZE, 3), np.float32))
    view = read_views(folder / "transforms_train.json", folder)[0]
    assert (view.camera.width, view.camera.height) == (SIZE, SIZE)
    assert view.camera.fov_x == pytest.approx(2 * math.atan(0.4))
    assert view.maps == {"albedo": str(folder / "albedo/train_0.exr")}


def read_train(folder, described):
    write_json(folder, "train", described)
    return [view.camera for view in read_views(folder / "transforms_train.json", folder)]


def test_lenses_in_camera_files(tmp_path):
    """What a frame says goes before what the file says; lenses are written so that they are read again."""
    folder = write_scene(tmp_path / "room")
    frames = [{"file_path": f"images/train_{i}", "transform_matrix": POSE} for i in range(3)]
    frames[1] |= {"fl_x": 12.0, "cx": 3.0, "k1": -0.2, "p2": 0.01, "k3": 0.003}
    frames[2] |= {"camera_model": "OPENCV_FISHEYE", "fl_x": 5.0, "k1": 0.01, "k4": 0.002, "camera_angle_x": 2.0}
    described = {"camera_angle_x": 0.9, "camera_angle_y": 0.8, "cy": 4.5, "w": SIZE, "h": SIZE, "frames": frames}
    first, second, third = cameras = read_train(folder, described)
    assert (first.fov_x, first.lens.centre, first.lens.bends) == (0.9, (0.5, 4.5 / SIZE), False)
    assert first.fl_y == pytest.approx(0.5 * SIZE / math.tan(0.4))
    assert (second.fl_x, second.cx, second.cy) == pytest.approx((12.0, 3.0, 4.5))
    assert (second.lens.numerator, second.lens.tangential) == ((-0.2, 0.0, 0.003), (0.0, 0.01))
    assert third.fl_x == pytest.approx(5.0)
    assert (third.lens.numerator, third.lens.fisheye) == ((0.01, 0.0, 0.0, 0.002), True)
    written = transforms([View(f"train_{i}", camera) for i, camera in enumerate(cameras)])
    for old, new in zip(cameras, read_train(folder, plain(written)), strict=True):
        assert (new.width, new.height, new.lens.fisheye) == (old.width, old.height, old.lens.fisheye)
        xy = SIZE * torch.rand(200, 2, dtype=torch.float64, generator=torch.manual_seed(1))
        torch.testing.assert_close(camera_rays(new, xy).d, camera_rays(old, xy).d, rtol=0, atol=1e-12)


def plain(described):
    """A camera file without the maps that are not there."""
    frames = [{k: v for k, v in f.items() if k not in ("albedo_path", "roughness_path")} for f in described["frames"]]
    return {**described, "frames": frames}


def test_a_set_of_one_camera_says_so_once(tmp_path):
    camera = read_train(write_scene(tmp_path / "room"), read_json(tmp_path / "room", "train"))[0]
    written = transforms([View("a", camera), View("b", camera)])
    assert [*written] == ["camera_angle_x", "w", "h", "fl_x", "fl_y", "frames"]
    assert "fl_x" not in written["frames"][0]
    assert written["camera_angle_x"] == 0.9
    mixed = transforms([View("a", camera), View("b", replace(camera, width=4))])
    assert [*mixed] == ["frames"]
    assert [frame["w"] for frame in mixed["frames"]] == [SIZE, 4]


def test_photographs_say_how_large_they_are(tmp_path):
    folder = write_scene(tmp_path / "room")
    write_exr(folder / "images/train_1.exr", np.ones((5, 7, 3), np.float32))
    described = {k: v for k, v in read_json(folder, "train").items() if k not in "wh"}
    assert [(c.width, c.height) for c in read_train(folder, described)] == [(8, 8), (7, 5), (8, 8)]


def test_what_a_lens_sees_is_what_mitsuba_sees_off_the_centre(tmp_path):
    """The exported camera of an off-centre lens; one that distorts is refused."""
    camera = Camera(np.eye(4), 0.9, 64, 64, Lens(centre=(0.4, 0.55)))
    scene = replace(build_cornell(), train=[], test=[])
    mi.set_variant("scalar_rgb")
    sensor = to_mitsuba(scene, View("a", camera), 64).sensors()[0]
    for x, y in ((3.5, 60.5), (32.0, 32.0), (50.25, 10.0)):
        ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(x / 64, y / 64), mi.Point2f(0.5, 0.5))
        expected = camera_rays(camera, torch.tensor([[x, y]])).d[0]
        np.testing.assert_allclose(list(ray.d), expected.numpy(), atol=2e-6)
    for lens in (Lens(numerator=(0.1,)), Lens(aspect=1.1)):
        with pytest.raises(InputError, match="Mitsuba's cameras have no lens distortion"):
            to_mitsuba(scene, View("a", replace(camera, lens=lens)), 64)


def replaced(part, old, new):
    def spoil(folder):
        path = folder / part
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))

    return spoil


def frame(**changes):
    def spoil(folder):
        described = read_json(folder, "train")
        described["frames"][1].update(changes)
        described["frames"][1] = {k: v for k, v in described["frames"][1].items() if v is not ...}
        write_json(folder, "train", described)

    return spoil


def top(**changes):
    def spoil(folder):
        described = {**read_json(folder, "train"), **changes}
        write_json(folder, "train", {k: v for k, v in described.items() if v is not ...})

    return spoil


def removed(name):
    return lambda folder: (folder / name).unlink()


def written(name, text):
    return lambda folder: (folder / name).write_text(text)


PNG = '<texture type="bitmap" name="{}"><string name="filename" value="textures/paint.png"/></texture>'


def set_paint(parameter):
    """Adds a parameter to the floor's principled BSDF."""
    return replaced("scene.xml", "</bsdf></bsdf>", parameter + "</bsdf></bsdf>")


def inside(plugin):
    """Puts the floor's BSDF into another one."""

    def spoil(folder):
        replaced("scene.xml", '<bsdf type="principled">', f'<bsdf type="{plugin}"><bsdf type="principled">')(folder)
        replaced("scene.xml", "</bsdf></bsdf>", "</bsdf></bsdf></bsdf>")(folder)

    return spoil


def beside(bsdf):
    """Puts another BSDF beside the floor's inside the two-sided one."""
    return replaced("scene.xml", '<bsdf type="principled">', f'{bsdf}<bsdf type="principled">')


def as_floor(bsdf):
    """Gives the floor another BSDF."""
    return replaced("scene.xml", '<ref id="paint"/>', bsdf)


def rough(kind, parameters):
    """Gives the floor a rough BSDF with GGX."""
    ggx = '<string name="distribution" value="ggx"/>'
    return as_floor(f'<bsdf type="rough{kind}">{ggx}{parameters}</bsdf>')


def binary_mesh(value):
    head = "".join(f"property float {c}\n" for c in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex 3\n{head}element face 1\n"
    corners = np.array([[value, 0, 0], [1, 0, 0], [0, 0, 1]], "<f4").tobytes()
    face = bytes([3]) + np.array([0, 1, 2], "<i4").tobytes()
    data = f"{head}property list uchar int vertex_indices\nend_header\n".encode() + corners + face
    return lambda folder: (folder / "meshes/floor.ply").write_bytes(data)


def pose(rotation):
    matrix = np.array(POSE)
    matrix[:3, :3] = rotation
    return matrix.tolist()


BAD = {
    "no scene.xml": (removed("scene.xml"), r"scene\.xml: the scene folder lacks"),
    "no camera file": (removed("transforms_train.json"), r"transforms_train\.json: the scene folder lacks"),
    "broken json": (written("transforms_train.json", "{"), r"transforms_train\.json: it is not valid JSON"),
    "no frames": (top(frames=[]), r"transforms_train\.json: it has no frames"),
    "json of another kind": (written("transforms_train.json", "[1]"), r"transforms_train\.json: it has no frames"),
    "frame without file": (frame(file_path=...), r"frame 1 has no file_path"),
    "frame listed twice": (frame(file_path="images/train_0.exr"), r"frame 1 .*is also that of frame 0"),
    "frame with an empty file": (frame(file_path=""), r"frame 1 has no file_path"),
    "frame without name": (frame(file_path="/"), r"its file_path '/' is not the name of a file"),
    "no photograph": (removed("images/train_1.exr"), r"images/train_1\.exr: the photograph is missing"),
    "no held-out photograph": (removed("images/test_1.exr"), r"images/test_1\.exr: the photograph is missing"),
    "no listed map": (frame(albedo_path="albedo/x.exr"), r"albedo/x\.exr: the albedo map is missing"),
    "no matrix": (frame(transform_matrix=...), r"frame 1 \(images/train_1\.exr\): its transform_matrix is missing"),
    "matrix of words": (frame(transform_matrix="abc"), r"frame 1 .*transform_matrix is not 4 x 4 numbers"),
    "small matrix": (frame(transform_matrix=[[1, 0], [0, 1]]), r"frame 1 .*not 4 x 4"),
    "NaN in matrix": (frame(transform_matrix=pose(np.full((3, 3), np.nan))), r"frame 1 .*row 1, column 1 is nan"),
    "scaled matrix": (frame(transform_matrix=pose(np.eye(3) * 1.01)), r"frame 1 .*not rigid"),
    "mirrored matrix": (frame(transform_matrix=pose(np.diag([-1, 1, 1]))), r"frame 1 .*not rigid"),
    "no angle": (top(camera_angle_x=...), r"neither camera_angle_x nor fl_x"),
    "angle in degrees": (top(camera_angle_x=51.5), r"camera_angle_x is 51\.5"),
    "angle of words": (top(camera_angle_x="wide"), r"camera_angle_x is 'wide', not a number"),
    "bad size": (top(w=0), r"w is 0, which has to be a number from 1"),
    "half a size": (frame(w=16, h=None), r"frame 1 .*h is None, not a number"),
    "two focal lengths": (top(fl_x=20.0), r"fl_x is 20, but by camera_angle_x it is 8\.28"),
    "no focal length": (top(camera_angle_x=..., fl_x=0), r"frame 0 .*fl_x is 0"),
    "negative focal length": (top(camera_angle_x=..., fl_x=-5.0), r"frame 0 .*fl_x is -5, which has to be"),
    "negative fl_y": (frame(fl_y=-5.0), r"frame 1 .*fl_y is -5, which has to be a number from 0"),
    "endless focal length": (top(camera_angle_x=..., fl_x=1e300), r"fl_x is 1e\+300"),
    "NaN in a lens": (frame(k1=float("nan")), r"frame 1 .*k1 is nan, which has to be a number"),
    "a word in a lens": (frame(cx="middle"), r"frame 1 .*cx is 'middle', not a number"),
    "picture that folds over": (frame(k1=-3.0), r"frame 1 .*distortion \(k1 -3\) folds over inside the picture"),
    "unknown model": (top(camera_model="EQUIRECTANGULAR"), r"camera_model is 'EQUIRECTANGULAR', which is not one of"),
    "model that is no name": (top(camera_model=3), r"camera_model is 3, not a name"),
    "coefficient of another model": (top(k4=0.1), r"k4 is 0\.1, but a camera of model OPENCV has none"),
    "distorted pinhole": (top(camera_model="PINHOLE", k1=0.1), r"k1 is 0\.1, but a camera of model PINHOLE has none"),
    "fisheye by its angle": (top(camera_model="OPENCV_FISHEYE"), r"neither camera_angle_x nor fl_x says"),
    "no mask": (frame(mask_path="masks/a.png"), r"masks/a\.png: the mask is missing that transforms_train\.json lists"),
    "mask that is no name": (frame(mask_path=3), r"mask_path is 3, not the name of a file"),
    "no mesh": (removed("meshes/floor.ply"), r"meshes/floor\.ply: the mesh of shape floor in scene\.xml is missing"),
    "broken mesh": (written("meshes/floor.ply", "no mesh"), r"floor\.ply: it is not a PLY file"),
    "empty mesh": (written("meshes/floor.ply", PLY.format(faces=0)), r"mesh floor is empty"),
    "NaN vertex": (binary_mesh(np.nan), r"floor\.ply: coordinate x of its vertices is nan, 1, 0"),
    "no texture": (removed("textures/paint.png"), r"paint\.png: there is no such texture file"),
    "broken texture": (written("textures/paint.png", "no picture"), r"paint\.png: it cannot be read"),
    "broken xml": (written("scene.xml", "<scene"), r"scene\.xml: it is not well-formed XML .*line 1"),
    "unknown reference": (replaced("scene.xml", 'ref id="paint"', 'ref id="pain"'), r"unresolved reference to .pain"),
    "hair": (replaced("scene.xml", 'shape type="rectangle"', 'shape type="bsplinecurve"'), r"lamp has type bspline"),
    "rough plastic": (replaced("scene.xml", '"diffuse"', '"roughplastic"'), r"lamp has distribution beckmann"),
    "opacity mask": (inside("mask"), r"bsdf paint of shape floor has type mask, .* lets light through"),
    "transparent": (set_paint('<float name="spec_trans" value="1"/>'), r"bsdf paint of shape floor sets spec_trans"),
    "transparent by a texture": (set_paint(PNG.format("spec_trans")), r"bsdf paint of shape floor sets spec_trans"),
    "glass that is rough": (beside('<bsdf type="roughdielectric"/>'), r"paint of shape floor has type roughdielectric"),
    "a mirror on one side": (
        beside('<bsdf type="conductor"/>'), r"bsdf paint of shape floor is twosided with 2 BSDFs"),
    "three sides": (beside('<bsdf type="diffuse"/>' * 2), r"bsdf paint of shape floor is twosided with 3 BSDFs"),
    "textured mirror": (as_floor(f'<bsdf type="conductor">{PNG.format("eta")}</bsdf>'), r"the eta of .* is textured"),
    "mirror of no metal": (
        as_floor('<bsdf type="twosided"><bsdf type="conductor"><string name="material" value="Xx"/></bsdf></bsdf>'),
        r"parameters that Mitsuba does not accept"),
    "no depth": (replaced("scene.xml", 'value="6"', 'value="0"'), r"scene\.xml: its integrator has max_depth 0"),
    "negative depth": (replaced("scene.xml", 'value="6"', 'value="-2"'), r"its integrator has max_depth -2"),
    "roulette before the first bounce": (
        replaced("scene.xml", '"rr_depth" value="4"', '"rr_depth" value="0"'), r"its integrator has rr_depth 0"),
    "thin glass": (replaced("scene.xml", '"diffuse"', '"thindielectric"'), r"shape lamp has type thindielectric"),
    "bumpy mirror": (
        as_floor(f'<bsdf type="normalmap"><bsdf type="conductor"/>{PNG.format("normalmap")}</bsdf>'),
        r"is a normalmap on a smooth surface"),
    "reflectance above 1": (replaced("scene.xml", "0.1, 0.2, 0.3", "2, 2, 2"), r"reflectance of bsdf .*\[0, 1\]"),
    "textured light": (
        replaced("scene.xml", '<rgb name="radiance" value="1, 2, 3"/>',
                 '<texture type="checkerboard" name="radiance"/>'),
        r"radiance of .*checkerboard"),
    "textured light without a file": (
        replaced("scene.xml", '<rgb name="radiance" value="1, 2, 3"/>',
                 '<texture type="bitmap" name="radiance"><string name="filename" value="a.png"/></texture>'),
        r"a\.png: there is no such texture file"),
    "projector": (
        replaced("scene.xml", "</scene>", '<emitter type="projector"/></scene>'), r"emitter of type projector"),
    "no envmap": (
        replaced("scene.xml", "</scene>",
                 '<emitter type="envmap"><string name="filename" value="a.exr"/></emitter></scene>'),
        r"a\.exr: there is no such texture file"),
    "no attribute": (
        replaced("scene.xml", '<float name="roughness" value="0.4"/>',
                 '<texture type="mesh_attribute" name="roughness"><string name="name" value="vertex_r"/></texture>'),
        r"shape floor has no vertex attribute vertex_r"),
}  # fmt: skip


REPLACED = {
    "clearcoat": (
        set_paint('<float name="clearcoat" value="1"/>'),
        "principled with clearcoat", r"paint of shape floor sets clearcoat"),
    "checkerboard": (
        replaced("scene.xml", '"bitmap"', '"checkerboard"'),
        "principled with checkerboard as base_color", r"base_color of bsdf paint .*checkerboard"),
    "nearest texel": (
        replaced("scene.xml", "</texture>", '<string name="filter_type" value="nearest"/></texture>'),
        "principled with filter_type of base_color", r"bitmap for base_color of bsdf paint .* sets filter_type"),
    "bump map": (
        inside("bumpmap"), "principled, bumpmap ignored", r"bsdf paint of shape floor has type bumpmap"),
    "another BSDF on the back": (
        beside('<bsdf type="diffuse"/>'),
        "twosided with 2 BSDFs", r"bsdf paint of shape floor is twosided with 2 BSDFs"),
    "plastic": (as_floor('<bsdf type="plastic"/>'), "plastic", r"of shape floor has type plastic"),
    "blend": (
        as_floor('<bsdf type="blendbsdf"><float name="weight" value="0.5"/><bsdf type="diffuse"/>'
                 '<bsdf type="plastic"/></bsdf>'),
        "blendbsdf", r"of shape floor has type blendbsdf"),
    "beckmann": (
        as_floor('<bsdf type="roughconductor"/>'),
        "roughconductor with distribution beckmann", r"of shape floor has distribution beckmann"),
    "brushed metal": (
        rough("conductor", '<float name="alpha_u" value="0.1"/><float name="alpha_v" value="0.2"/>'),
        "roughconductor with alpha_u unlike alpha_v", r"of shape floor has alpha_u and alpha_v"),
    "textured index": (
        rough("conductor", PNG.format("eta")), "roughconductor with textured eta", r"the eta of .* floor is textured"),
    "index of 1": (
        rough("conductor", '<rgb name="eta" value="1, 2, 2"/><rgb name="k" value="0, 1, 1"/>'),
        "roughconductor with a refractive index of 1", r"shape floor has a refractive index of 1"),
    "unknown metal": (
        rough("conductor", '<string name="material" value="Xx"/>'),
        "roughconductor with parameters that Mitsuba does not accept", r"parameters that Mitsuba does not accept"),
    "unknown plastic": (
        rough("plastic", '<string name="int_ior" value="Xx"/>'),
        "roughplastic with parameters that Mitsuba does not accept", r"parameters that Mitsuba does not accept"),
}  # fmt: skip
"""What a fit replaces, what it says of it, and what is said to those who want the true material."""


@pytest.mark.parametrize("case", REPLACED)
def test_what_cannot_be_rendered_is_left_to_a_fit(tmp_path, case):
    folder = write_scene(tmp_path / "room")
    spoil, named, said = REPLACED[case]
    spoil(folder)
    scene = load_scene(str(folder), None)
    assert scene.replaced == [f"{scene.materials[0].name} ({named})"]
    assert scene.materials[0].two_sided == (scene.materials[0].name == "paint")
    with pytest.raises(InputError, match=said) as caught:
        TrueMaterials(scene, Geometry(scene))
    assert "\n" not in str(caught.value)


def test_a_scene_may_be_dark_until_its_lamps_are_found(tmp_path):
    folder = write_scene(tmp_path / "room")
    spoil = replaced("scene.xml", XML[XML.index("<emitter") : XML.index("</emitter>") + 10], "")
    spoil(folder)
    scene = load_scene(str(folder), None)
    assert not scene.features.has_light
    with pytest.raises(InputError, match=r"scene room: it has no emitter, .* --model\.lighting\.emitters find"):
        build_world(scene)
    with pytest.raises(InputError, match="no emitter"):
        scene.check()


def test_an_emitter_keeps_what_it_has(tmp_path):
    """Its reflectance is part of the light: it is not replaced, so that of one that is not supported is refused."""
    folder = write_scene(tmp_path / "room")
    assert load_scene(str(folder), None).replaced == []
    replaced("scene.xml", '"diffuse"', '"plastic"')(folder)
    with pytest.raises(InputError, match=r"shape lamp has type plastic.* emitter, lamp"):
        load_scene(str(folder), None)


def test_constants_of_models(tmp_path):
    folder = write_scene(tmp_path / "room")
    set_paint('<float name="metallic" value="0.75"/><float name="specular" value="0.3"/>')(folder)
    paint, lamp = load_scene(str(folder), None).materials
    assert (paint.model.label, lamp.model) == ("principled, eta 1.36664", DiffuseModel())
    assert (paint.metallic.value, lamp.metallic.value) == (0.75, 0.0)
    gold = mi.load_dict({"type": "roughconductor", "material": "Au", "distribution": "ggx"})
    metal = (
        '<bsdf type="roughconductor"><string name="material" value="Au"/><string name="distribution" value="ggx"/>'
        '<float name="alpha" value="0.04"/><rgb name="specular_reflectance" value="0.5, 1, 1"/></bsdf>'
    )
    replaced("scene.xml", '<ref id="paint"/>', metal)(folder)
    material = load_scene(str(folder), None).materials[0]
    np.testing.assert_allclose(material.model.k, list(mi.traverse(gold)["k.value"]), rtol=1e-6)
    normal = np.array(material.model.normal_reflectance)
    np.testing.assert_allclose(material.albedo.value, normal * [0.5, 1, 1], rtol=1e-6)
    assert material.roughness.value == pytest.approx(0.2)


def test_rough_plastic(tmp_path):
    folder = write_scene(tmp_path / "room")
    plastic = (
        '<bsdf type="roughplastic" id="shell"><string name="distribution" value="ggx"/>'
        '<float name="alpha" value="0.09"/><float name="int_ior" value="1.6"/>'
        '<float name="ext_ior" value="1.0"/><boolean name="nonlinear" value="true"/>'
        f'<float name="specular_reflectance" value="0.5"/>{PNG.format("diffuse_reflectance")}</bsdf>'
    )
    replaced("scene.xml", '<ref id="paint"/>', plastic)(folder)
    scene = load_scene(str(folder), None)
    material, paint = scene.materials[0], load_scene(str(write_scene(tmp_path / "other")), None).materials[0]
    assert material.model == RoughPlasticModel(pytest.approx(1.6), pytest.approx(0.09), (0.5, 0.5, 0.5), True)
    assert material.roughness.value == pytest.approx(0.3)
    np.testing.assert_array_equal(material.albedo.pixels, paint.albedo.pixels)
    assert scene.replaced == ["shell (roughplastic)"]


@pytest.mark.parametrize("case", BAD)
def test_bad_folders_get_one_sentence(tmp_path, case):
    folder = write_scene(tmp_path / "room")
    spoil, said = BAD[case]
    spoil(folder)
    with pytest.raises(InputError, match=said) as caught:
        load_scene(str(folder), None)
    assert "\n" not in str(caught.value)


def test_no_folder_and_wrong_arguments(tmp_path):
    with pytest.raises(InputError, match=r"--data\.root: there is no folder"):
        load_scene(str(tmp_path / "none"), None)
    for both in ((None, None), ("a", "kitchen")):
        with pytest.raises(InputError, match="exactly one of"):
            load_scene(*both)
    with pytest.raises(
        InputError, match="there is no built-in scene 'ktchen', choose one of kitchen, patterns, cornell"
    ):
        load_scene(None, "ktchen")


def test_missing_package_is_named(tmp_path, monkeypatch):
    folder = write_scene(tmp_path / "room")
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(InputError, match=r"pip install 'neurad\[mitsuba\]'"):
        read_folder(folder)


def test_the_variant_of_others_is_left_alone(tmp_path):
    mi.set_variant("scalar_spectral")
    try:
        read_folder(write_scene(tmp_path / "room"))
        assert mi.variant() == "scalar_spectral"
    finally:
        mi.set_variant("scalar_rgb")


@pytest.mark.parametrize(
    "name",
    [
        "veach-ajar",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("staircase", "living-room-2", "kitchen", "bunny")),
    ],
)
def test_shared_scenes_load_and_equal_mitsuba(name):
    """Random rays inside the bounds; JPEG decoders may differ by a level or two, hence 0.02 for the textures."""
    folder = ROOMS / name
    if not (folder / "scene.xml").exists():
        pytest.skip(f"the scene {name} is not beside this checkout")
    scene = load_scene(str(folder), None)
    about = json.loads((folder / "transforms_train.json").read_text())
    assert len(scene.train) == len(about["frames"])
    assert all(v.maps.keys() == {"albedo", "roughness"} for v in scene.train + scene.test)
    low, high = scene.bounds
    worst, seen = compare_with_mitsuba(folder / "scene.xml", scene, random_rays(1500, low, high))
    assert len(seen) > 1
    assert worst["valid"] == worst["side"] == 0
    assert worst["emission"] < 1e-4
    assert worst["n"] < 2e-3
    assert worst["p"] < 1e-4 * np.linalg.norm(high - low)
    assert worst["albedo"] < 0.02
    assert worst["roughness"] < 0.02
