"""Scene folders: conventions against Mitsuba itself, and one sentence for everything that can be wrong."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.spoil import PNG, as_floor, beside, inside, set_paint, xml
from helpers.tiny_scene import POSE, SIZE, read_json, write_json, write_scene
from PIL import Image

from benchmarks.loaded import to_mitsuba
from neurad.core.camera import camera_rays
from neurad.core.errors import InputError
from neurad.core.lens import Lens
from neurad.core.records import Rays
from neurad.core.reflection import DiffuseModel, RoughPlasticModel
from neurad.core.scene_records import Bitmap, Camera, View
from neurad.formats.cameras.nerf import read_views
from neurad.formats.cameras.write import transforms
from neurad.formats.load import load_scene
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


def test_delta_materials_and_environments(tmp_path):
    from neurad.formats.mitsuba.read import read_xml

    text = """<scene version="3.0.0">
      <shape type="rectangle"><bsdf type="conductor" id="gold"><string name="material" value="Au"/></bsdf></shape>
      <shape type="rectangle"><bsdf type="dielectric" id="glass"><float name="int_ior" value="1.4"/>
        <float name="ext_ior" value="1.0"/></bsdf></shape>
      <shape type="rectangle"/>
      <shape type="rectangle"><bsdf type="thindielectric" id="pane"><float name="int_ior" value="1.4"/>
        <float name="ext_ior" value="1.0"/></bsdf></shape>
      <emitter type="envmap"><string name="filename" value="sky.exr"/><float name="scale" value="2"/>
        <transform name="to_world"><rotate y="1" angle="90"/></transform></emitter>
    </scene>"""
    (tmp_path / "scene.xml").write_text(text)
    sky = np.random.default_rng(0).random((4, 8, 3), np.float32).astype(np.float16).astype(np.float32)
    write_exr(tmp_path / "sky.exr", sky)
    scene = read_xml(tmp_path / "scene.xml").check()
    assert [m.model.label for m in scene.materials] == ["conductor", "dielectric", "diffuse", "thindielectric"]
    gold = scene.materials[0].albedo.value
    assert gold[0] > 0.9 > gold[1] > 0.7 > 0.5 > gold[2]
    assert [scene.materials[i].model.eta for i in (1, 3)] == pytest.approx([1.4, 1.4])
    assert scene.materials[3].model.thin
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


def rough(kind, parameters):
    """Give the floor a rough BSDF with GGX."""
    ggx = '<string name="distribution" value="ggx"/>'
    return as_floor(f'<bsdf type="rough{kind}">{ggx}{parameters}</bsdf>')


REPLACED = {
    "clearcoat": (
        set_paint('<float name="clearcoat" value="1"/>'),
        "principled with clearcoat", r"paint of shape floor sets clearcoat"),
    "checkerboard": (
        xml('"bitmap"', '"checkerboard"'),
        "principled with checkerboard as base_color", r"base_color of bsdf paint .*checkerboard"),
    "nearest texel": (
        xml("</texture>", '<string name="filter_type" value="nearest"/></texture>'),
        "principled with filter_type of base_color", r"bitmap for base_color of bsdf paint .* sets filter_type"),
    "bump map": (
        inside("bumpmap"), "principled, bumpmap ignored", r"bsdf paint of shape floor has type bumpmap"),
    "another BSDF on the back": (
        beside('<bsdf type="diffuse"/>'),
        "twosided with 2 BSDFs", r"bsdf paint of shape floor is twosided with 2 BSDFs"),
    "phong": (as_floor('<bsdf type="phong"/>'), "phong", r"of shape floor has type phong"),
    "blend": (
        as_floor('<bsdf type="blendbsdf"><float name="weight" value="0.5"/><bsdf type="diffuse"/>'
                 '<bsdf type="plastic"/></bsdf>'),
        "blendbsdf", r"of shape floor has type blendbsdf"),
    "another distribution": (
        as_floor('<bsdf type="roughconductor"><string name="distribution" value="phong"/></bsdf>'),
        "roughconductor with distribution phong", r"of shape floor has distribution phong; there are: ggx, beckmann"),
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


def test_an_emitter_keeps_what_it_has(tmp_path):
    """Its reflectance is part of the light: it is not replaced, so that of one that is not supported is refused."""
    folder = write_scene(tmp_path / "room")
    assert load_scene(str(folder), None).replaced == []
    xml('"diffuse"', '"phong"')(folder)
    with pytest.raises(InputError, match=r"shape lamp has type phong.* emitter, lamp"):
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
    xml('<ref id="paint"/>', metal)(folder)
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
    xml('<ref id="paint"/>', plastic)(folder)
    scene = load_scene(str(folder), None)
    material, paint = scene.materials[0], load_scene(str(write_scene(tmp_path / "other")), None).materials[0]
    assert material.model == RoughPlasticModel(pytest.approx(1.6), pytest.approx(0.09), (0.5, 0.5, 0.5), True)
    assert material.roughness.value == pytest.approx(0.3)
    np.testing.assert_array_equal(material.albedo.pixels, paint.albedo.pixels)
    assert scene.replaced == ["shell (roughplastic)"]


def test_no_folder_and_wrong_arguments(tmp_path):
    with pytest.raises(InputError, match=r"--data\.root: there is no folder"):
        load_scene(str(tmp_path / "none"), None)
    for both in ((None, None), ("a", "kitchen")):
        with pytest.raises(InputError, match="scene folder"):
            load_scene(*both)
    with pytest.raises(
        InputError, match="there is no built-in scene 'ktchen', choose one of kitchen, patterns, cornell"
    ):
        load_scene(None, "ktchen")


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
