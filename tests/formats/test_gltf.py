"""glTF scenes: every layout of vertices, what materials and lamps say, and nodes against trimesh."""

import math

import numpy as np
import pytest
import torch
import trimesh
from helpers.gltf_writer import FACES, QUAD, UVS, Document

from neurad.core.errors import InputError
from neurad.core.reflection import ConductorModel, DielectricModel, DiffuseModel, PrincipledModel
from neurad.core.scene_records import Bitmap, Constant, EnvironmentMap, VertexAttribute
from neurad.formats.gltf.read import read_gltf, read_scene
from neurad.formats.load import read_folder
from neurad.images.image_io import from_srgb
from neurad.scene.description import Scene, is_dielectric
from neurad.scene.geometry import Geometry
from neurad.scene.textures import TrueMaterials

REPEAT, CLAMP, MIRROR = 10497, 33071, 33648
PBR = "pbrMetallicRoughness"


def corners(mesh):
    return mesh.vertices[mesh.faces]


def one(document, tmp_path):
    """The only mesh of a file and its material."""
    room = read_gltf(document.glb(tmp_path / "a.glb"))
    (mesh,) = room.meshes
    return mesh, room.materials[mesh.material]


# ---- vertices

LINE = [3, 0, 2, 1]
"""The square as a strip."""


def _by_indices(kind):
    return lambda d: ({"POSITION": d.accessor(QUAD)}, d.accessor(FACES.ravel(), kind), {})


LAYOUTS = {
    **{f"indices {kind}": _by_indices(kind) for kind in ("u1", "u2", "u4")},
    "no indices": lambda d: ({"POSITION": d.accessor(QUAD[FACES.ravel()])}, None, {}),
    "strip": lambda d: ({"POSITION": d.accessor(QUAD)}, d.accessor(LINE, "u1"), {"mode": 5}),
    "fan": lambda d: ({"POSITION": d.accessor(QUAD)}, None, {"mode": 6}),
    "interleaved": lambda d: (
        dict(zip(("NORMAL", "POSITION", "TEXCOORD_0"), d.interleaved([QUAD * 0 + (0, 1, 0), QUAD, UVS]), strict=True)),
        d.accessor(FACES.ravel(), "u2"), {},
    ),
    "sparse": lambda d: ({"POSITION": d.sparse(QUAD)}, d.accessor(FACES.ravel(), "u2"), {}),
    "sparse on top": lambda d: ({"POSITION": _on_top(d)}, d.accessor(FACES.ravel(), "u2"), {}),
    "bytes": lambda d: ({"POSITION": d.accessor(QUAD, "i1")}, d.accessor(FACES.ravel(), "u2"), {}),
    "normalised": lambda d: (
        {"POSITION": d.accessor(QUAD * 32767, "i2", normalized=True)}, d.accessor(FACES.ravel(), "u2"), {}),
    "a vertex that nothing uses": lambda d: (
        {"POSITION": d.accessor(np.concatenate((QUAD, [[9, 9, 9]])))}, d.accessor(FACES.ravel(), "u2"), {}),
}  # fmt: skip


def _on_top(document):
    """A view whose second vertex is wrong, which the exceptions put right."""
    wrong = QUAD.copy()
    wrong[1] = 7.0
    index = document.accessor(wrong)
    where = document.view(np.array([1], "<u2").tobytes())
    document.json["accessors"][index]["sparse"] = {
        "count": 1, "indices": {"bufferView": where, "componentType": 5123},
        "values": {"bufferView": document.view(QUAD[1].astype("<f4").tobytes())},
    }  # fmt: skip
    return index


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_of_vertices(layout, tmp_path):
    document = Document()
    attributes, indices, more = LAYOUTS[layout](document)
    document.node(mesh=document.mesh(attributes, indices, **more))
    mesh, _ = one(document, tmp_path)
    assert len(mesh.vertices) == len(np.unique(mesh.faces))
    triangles = [np.roll(t, -int(np.lexsort(t.T[::-1])[0]), 0) for t in corners(mesh)]  # first corner first, same turn
    area = np.cross(*(np.stack(triangles)[:, i] - np.stack(triangles)[:, 0] for i in (1, 2)))
    np.testing.assert_allclose(area, [[0, 4, 0]] * 2, atol=1e-5)
    np.testing.assert_allclose(np.unique(np.concatenate(triangles), axis=0), np.unique(QUAD, axis=0), atol=1e-6)


def test_long_strips_keep_their_side(tmp_path):
    """A band of ten triangles, and two bands joined by triangles without area."""
    band = np.stack((np.repeat(np.arange(6), 2), np.zeros(12), -np.tile((0, 1), 6)), -1).astype(np.float32)
    for order in (range(12), [*range(6), 5, 6, *range(6, 12)]):
        document = Document()
        indices = document.accessor(list(order), "u2")
        document.node(mesh=document.mesh({"POSITION": document.accessor(band)}, indices, mode=5))
        p = corners(one(document, tmp_path)[0])
        up = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])[:, 1]
        assert (np.abs(up) == 1).all()
        assert (up == -1).all()  # as its first triangle


def test_normals_that_are_quantised(tmp_path):
    document = Document()
    normals = np.tile([0.0, 0.6, 0.8], (4, 1))
    attributes = {"POSITION": document.accessor(QUAD)}
    attributes["NORMAL"] = document.accessor(np.round(normals * 127), "i1", normalized=True)
    document.node(mesh=document.mesh(attributes, document.accessor(FACES.ravel(), "u1")))
    mesh, _ = one(document, tmp_path)
    np.testing.assert_allclose(mesh.normals, normals, atol=5e-3)


# ---- nodes


def test_a_hierarchy_as_trimesh_places_it(tmp_path):
    """Turned, unevenly scaled, sheared by a parent, mirrored, instanced: an independent writer and reader."""
    rng = np.random.default_rng(5)
    solid = trimesh.creation.box((1, 2, 3))
    scene = trimesh.Scene()
    scene.graph.update(
        "group", matrix=np.diag([2.0, 0.5, 1.0, 1.0]) @ trimesh.transformations.random_rotation_matrix(rng.random(3))
    )
    for index in range(6):
        matrix = trimesh.transformations.random_rotation_matrix(rng.random(3))
        matrix[:3, :3] *= rng.uniform(0.5, 2.0, 3) * (1, 1, -1 if index % 2 else 1)
        matrix[:3, 3] = rng.normal(size=3)
        scene.add_geometry(solid, f"box {index}", parent_node_name="group", transform=matrix, geom_name="solid")
    path = tmp_path / "a.glb"
    path.write_bytes(scene.export(file_type="glb"))
    found = {mesh.name: mesh for mesh in read_gltf(path).meshes}
    assert len(found) == 6
    for name in scene.graph.nodes_geometry:
        matrix, _ = scene.graph[name]
        expected = (solid.vertices @ matrix[:3, :3].T + matrix[:3, 3])[solid.faces]
        mesh = found[name]
        order = np.lexsort(expected.mean(1).round(4).T), np.lexsort(corners(mesh).mean(1).round(4).T)
        np.testing.assert_allclose(corners(mesh).mean(1)[order[1]], expected.mean(1)[order[0]], atol=1e-5)
        p = corners(mesh).astype(np.float64)
        assert (
            np.einsum("fx,fx->", p[:, 0] - p.mean((0, 1)), np.cross(p[:, 1] - p.mean((0, 1)), p[:, 2] - p.mean((0, 1))))
            > 0
        )


def test_normals_go_with_uneven_scales(tmp_path):
    document = Document()
    slope = np.array([[0, 0, 0], [1, 1, 0], [0, 0, -1]], np.float32)
    normal = np.cross(slope[1] - slope[0], slope[2] - slope[0])
    attributes = {
        "POSITION": document.accessor(slope),
        "NORMAL": document.accessor([normal / np.linalg.norm(normal)] * 3),
    }
    document.node(mesh=document.mesh(attributes), scale=[3.0, 1.0, -1.0], rotation=[0.5, 0.5, 0.5, 0.5])
    mesh, _ = one(document, tmp_path)
    p = corners(mesh)[0]
    across = np.cross(p[1] - p[0], p[2] - p[0])
    np.testing.assert_allclose(mesh.normals, [across / np.linalg.norm(across)] * 3, atol=1e-6)


def test_what_is_hidden_is_left_out(tmp_path):
    document = Document()
    below = document.quad(root=False)
    document.node(children=[below], extensions={"KHR_node_visibility": {"visible": False}})
    document.quad(scale=[0, 0, 0])
    document.quad(name="seen")
    document.json["nodes"][below]["name"] = "below"
    room = read_gltf(document.glb(tmp_path / "a.glb"))
    assert [mesh.name for mesh in room.meshes] == ["seen"]
    assert "scale of 0" in room.notes[0]


def test_cameras(tmp_path):
    document = Document()
    lens = {"type": "perspective", "perspective": {"yfov": 0.7, "aspectRatio": 1.5, "znear": 0.1}}
    turn = [0.0, math.sin(0.3), 0.0, math.cos(0.3)]
    held = document.node(root=False, camera=document.add("cameras", lens), name="eye", rotation=turn)
    document.node(children=[held], translation=[1, 2, 3], scale=[2, 2, 2])
    document.quad()
    (camera,) = read_gltf(document.glb(tmp_path / "a.glb")).cameras
    seen = camera.seen(300, 200)
    assert 2 * math.atan(math.tan(seen.fov_x / 2) / 1.5) == pytest.approx(0.7)
    c, s = math.cos(0.6), math.sin(0.6)
    np.testing.assert_allclose(seen.to_world, [[c, 0, s, 1], [0, 1, 0, 2], [-s, 0, c, 3], [0, 0, 0, 1]], atol=1e-12)
    (view,) = read_scene(tmp_path / "a.glb").test
    assert (view.name, view.camera.width, view.camera.height, view.image) == ("eye", 512, 341, None)


def test_lights_without_extent(tmp_path):
    """They shine along -Z of their nodes, whatever the nodes' scale; candela over 683; the angles become degrees."""
    document = Document()
    document.quad()
    spot = {
        "type": "spot",
        "color": [1, 0.5, 0],
        "intensity": 683.0,
        "spot": {"innerConeAngle": 0.1, "outerConeAngle": 0.5},
    }
    document.json["extensions"] = {"KHR_lights_punctual": {"lights": [spot, {"type": "directional"}]}}
    for index in (0, 1):
        turn = [0.5**0.5, 0, 0, 0.5**0.5]
        light = {"KHR_lights_punctual": {"light": index}}
        document.node(name=f"l{index}", translation=[0, 2, 0], rotation=turn, scale=[2, 2, 2], extensions=light)
    first, second = read_scene(document.glb(tmp_path / "a.glb")).punctual
    assert (first.name, first.kind) == ("l0", "spot")
    assert (first.beam_width, first.cutoff_angle) == pytest.approx((math.degrees(0.1), math.degrees(0.5)))
    np.testing.assert_allclose(first.intensity, [1, 0.5, 0], rtol=1e-6)
    np.testing.assert_allclose(first.position, [0, 2, 0])
    np.testing.assert_allclose(first.direction, [0, 1, 0], atol=1e-6)
    assert second.kind == "directional"
    np.testing.assert_allclose(second.intensity, [1 / 683] * 3, rtol=1e-6)
    document.node(name="flat", scale=[0, 0, 0], extensions=light)
    with pytest.raises(InputError, match=r"a\.glb: light flat: its direction is .*, which points nowhere"):
        read_scene(document.glb(tmp_path / "a.glb"))


# ---- textures


def texel(pixels, i, j, wrap):
    """A texel as OpenGL wraps it: column i, row j."""
    place = []
    for k, n, mode in ((i, pixels.shape[1], wrap[0]), (j, pixels.shape[0], wrap[1])):
        k = np.mod(k, n) if mode == REPEAT else np.clip(k, 0, n - 1) if mode == CLAMP else np.mod(k, 2 * n)
        place.append(np.where(k >= n, 2 * n - 1 - k, k))
    return pixels[place[1], place[0]]


def sampled(pixels, uv, wrap):
    """Bilinear values of a picture by the specification."""
    x, y = uv[:, 0] * pixels.shape[1] - 0.5, uv[:, 1] * pixels.shape[0] - 0.5
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - i)[:, None], (y - j)[:, None]
    top = texel(pixels, i, j, wrap) * (1 - fx) + texel(pixels, i + 1, j, wrap) * fx
    return top * (1 - fy) + (texel(pixels, i, j + 1, wrap) * (1 - fx) + texel(pixels, i + 1, j + 1, wrap) * fx) * fy


def looked_up(room, count=400):
    """Albedo and roughness at random points of the first triangle, with their barycentrics [n, 3]."""
    scene = Scene("a", room.meshes, room.materials, EnvironmentMap(np.ones((2, 4, 3), np.float32)))
    geometry = Geometry(scene)
    u = torch.rand(count, 2, generator=torch.Generator().manual_seed(3))
    u = torch.where((u.sum(1) > 1)[:, None], 1 - u, u)
    wo = torch.tensor([[0.0, 1.0, 0.0]]).expand(count, 3)
    si = geometry.interact_at(
        torch.zeros(count, dtype=torch.int64), *u.unbind(1), wo, torch.ones(count, dtype=torch.bool)
    )
    surface = TrueMaterials(scene, geometry)(si)
    bary = torch.stack((1 - u.sum(1), *u.unbind(1)), 1).numpy()
    return surface.albedo.numpy(), surface.roughness.numpy(), bary


@pytest.mark.parametrize("wrap", [(REPEAT, REPEAT), (CLAMP, MIRROR), (MIRROR, CLAMP), (CLAMP, CLAMP), (MIRROR, MIRROR)])
@pytest.mark.parametrize("moved", [{}, {"offset": [0.3, -0.2], "rotation": 0.4, "scale": [1.5, 0.7]}])
def test_textures_are_looked_up_as_the_specification_says(wrap, moved, tmp_path):
    pixels = np.random.default_rng(1).integers(0, 256, (5, 7, 3), np.uint8)
    document = Document()
    info = document.texture(pixels, {"wrapS": wrap[0], "wrapT": wrap[1]}, extensions={"KHR_texture_transform": moved})
    surface = {"baseColorTexture": info, "metallicRoughnessTexture": info, "baseColorFactor": [1, 0.5, 0.25, 1],
               "roughnessFactor": 0.5, "metallicFactor": 0}  # fmt: skip
    document.quad(UVS * 1.6 - 0.4, {PBR: surface})
    albedo, roughness, bary = looked_up(read_gltf(document.glb(tmp_path / "a.glb")))
    uv = bary @ (UVS * 1.6 - 0.4)[FACES[0]]
    if moved:  # scaled, then turned as a picture seen from above turns clockwise, then moved
        c, s = math.cos(0.4), math.sin(0.4)
        x, y = uv[:, 0] * 1.5, uv[:, 1] * 0.7
        uv = np.stack((c * x + s * y + 0.3, -s * x + c * y - 0.2), -1)
    linear = sampled(from_srgb(pixels / 255.0).astype(np.float64), uv, wrap)
    np.testing.assert_allclose(albedo, linear * (1, 0.5, 0.25), atol=2e-5)
    np.testing.assert_allclose(roughness, sampled(pixels[..., 1:2] / 255.0, uv, wrap) * 0.5, atol=2e-5)


def test_metalness_is_the_blue_channel_of_the_roughness_and_none_without_a_material(tmp_path):
    pixels = np.random.default_rng(3).integers(0, 256, (5, 7, 3), np.uint8)
    document = Document()
    surface = {"metallicRoughnessTexture": document.texture(pixels), "metallicFactor": 0.5}
    document.quad(UVS, {PBR: surface})
    scene = read_gltf(document.glb(tmp_path / "a.glb"))
    assert scene.materials[0].model == PrincipledModel()
    bitmap = scene.materials[0].metallic
    np.testing.assert_allclose(bitmap.pixels, pixels[..., 2:] * np.float32(0.5 / 255.0), rtol=1e-6)

    document = Document()
    document.quad(UVS)
    assert float(read_gltf(document.glb(tmp_path / "a.glb")).materials[0].metallic.value[0]) == 0.0


@pytest.mark.parametrize("kind", ["f4", "u1", "u2"])
def test_sets_of_texture_coordinates(kind, tmp_path):
    """Colour and roughness on two sets, one of which is the other moved and scaled; or unrelated, which is said."""
    pixels = np.random.default_rng(2).integers(0, 256, (4, 4, 3), np.uint8)
    for related in (True, False):
        document = Document()
        first = UVS * 0.8
        second = (
            first * (0.5, -1.0) + (0.25, 0.9)
            if related
            else first * [[1.0, 1.0]] * 3 + [[0.1, 0], [0, 0], [0, 0.1], [0, 0]]
        )
        most = {"f4": 1, "u1": 255, "u2": 65535}[kind]
        texcoords = {}
        for number, uvs in ((0, UVS), (2, first), (3, second)):
            exact = kind == "f4" or number < 3
            form = kind if exact else "f4"
            scaled = uvs * most if exact else uvs
            texcoords[f"TEXCOORD_{number}"] = document.accessor(
                np.round(scaled) if form != "f4" else scaled, form, normalized=form != "f4"
            )
        surface = {"baseColorTexture": document.texture(pixels, texCoord=2), "metallicFactor": 0.0}
        moved = {"KHR_texture_transform": {"texCoord": 3}}
        surface["metallicRoughnessTexture"] = document.texture(pixels, texCoord=0, extensions=moved)
        mesh = document.mesh({"POSITION": document.accessor(QUAD), **texcoords}, document.accessor(FACES.ravel(), "u1"),
                             material=document.add("materials", {PBR: surface}))  # fmt: skip
        document.node(mesh=mesh)
        room = read_gltf(document.glb(tmp_path / "a.glb"))
        if not related or kind != "f4":  # rounding to bytes leaves no exact relation
            assert kind != "f4" or "two sets of texture coordinates" in room.materials[0].model.unsupported
            continue
        albedo, roughness, bary = looked_up(room)
        wrap = (REPEAT, REPEAT)
        colour = sampled(from_srgb(pixels / 255.0).astype(np.float64), bary @ first[FACES[0]], wrap)
        np.testing.assert_allclose(albedo, colour, atol=2e-5)
        rough = sampled(pixels[..., 1:2] / 255.0, bary @ second[FACES[0]], wrap)
        np.testing.assert_allclose(roughness, rough, atol=2e-5)


def test_colours_of_vertices(tmp_path):
    document = Document()
    colours = np.random.default_rng(3).random((4, 3))
    attributes = {"POSITION": document.accessor(QUAD)}
    attributes["COLOR_0"] = document.accessor(np.round(colours * 65535), "u2", normalized=True)
    material = document.add("materials", {PBR: {"baseColorFactor": [0.5, 1, 1, 1], "metallicFactor": 0.0}})
    document.node(mesh=document.mesh(attributes, document.accessor(FACES.ravel(), "u1"), material=material))
    room = read_gltf(document.glb(tmp_path / "a.glb"))
    assert isinstance(room.materials[0].albedo, VertexAttribute)
    albedo, _, bary = looked_up(room)
    np.testing.assert_allclose(albedo, bary @ (colours * (0.5, 1, 1))[FACES[0]], atol=2e-5)


# ---- materials


def extended(name, **values):
    return {"extensions": {name: values}}


GLASS = {PBR: {"roughnessFactor": 0.0, "metallicFactor": 0.0}}
MODELS = {
    "default": ({}, PrincipledModel()),
    "plain": ({PBR: {"metallicFactor": 0}}, PrincipledModel()),
    "index": ({PBR: {"metallicFactor": 0}, **extended("KHR_materials_ior", ior=1.8)}, PrincipledModel(1.8)),
    "diffuse": ({PBR: {"metallicFactor": 0}, **extended("KHR_materials_specular", specularFactor=0)}, DiffuseModel()),
    "mirror": ({PBR: {"roughnessFactor": 0, "baseColorFactor": [0.9, 0.8, 0.7, 1]}}, ConductorModel()),
    "glass": ({**GLASS, "extensions": {"KHR_materials_transmission": {"transmissionFactor": 1},
                                       "KHR_materials_ior": {"ior": 1.4}}}, DielectricModel(1.4, thin=True)),
    "glass with a volume": ({**GLASS, "extensions": {"KHR_materials_transmission": {"transmissionFactor": 1},
                             "KHR_materials_volume": {"thicknessFactor": 0.01}}}, DielectricModel()),
}  # fmt: skip


@pytest.mark.parametrize("kind", MODELS)
def test_models(kind, tmp_path):
    document = Document()
    document.quad(material=MODELS[kind][0])
    _, material = one(document, tmp_path)
    assert material.model == MODELS[kind][1]
    assert isinstance(material.albedo, Constant)
    assert isinstance(material.roughness, Constant)
    assert float(material.metallic.value[0]) == (kind in ("default", "mirror"))
    assert material.two_sided
    if kind == "mirror":
        np.testing.assert_allclose(material.albedo.value, [0.9, 0.8, 0.7])


@pytest.mark.parametrize("name", ["scene.GLB", "Scene.gltf"])
def test_the_case_of_a_scene_file_does_not_matter(name, tmp_path):
    document = Document()
    document.quad(name="floor")
    lens = {"type": "perspective", "perspective": {"yfov": 0.5, "znear": 0.1}}
    document.node(camera=document.add("cameras", lens), name="eye")
    getattr(document, name[-4:].lower().strip("."))(tmp_path / name)
    room = read_folder(tmp_path)
    assert [mesh.name for mesh in room.meshes] == ["floor"]
    assert is_dielectric(room.materials[0].metallic)  # nobody has chosen the format's metal


OPAQUE = {
    "clearcoat": extended("KHR_materials_clearcoat", clearcoatFactor=0.5),
    "sheen": extended("KHR_materials_sheen", sheenColorFactor=[0.1, 0, 0]),
    "unlit": extended("KHR_materials_unlit"),
    "pbrSpecularGlossiness": extended("KHR_materials_pbrSpecularGlossiness"),
    "KHR_materials_specular": extended("KHR_materials_specular", specularFactor=0.5),
    "map of normals": "normalTexture",
}


@pytest.mark.parametrize("kind", OPAQUE)
def test_opaque_surfaces_that_a_fit_recovers_anew(kind, tmp_path):
    document, described = Document(), OPAQUE[kind]
    if isinstance(described, str):
        described = {described: document.texture(np.random.default_rng(4).integers(0, 256, (4, 4, 3)))}
    document.quad(material={PBR: {"metallicFactor": 0.0}, **described})
    _, material = one(document, tmp_path)
    assert kind in material.model.unsupported
    assert str(tmp_path / "a.glb") in material.model.unsupported
    document.json["materials"][0]["emissiveFactor"] = [1, 1, 1]
    with pytest.raises(InputError, match="what a lamp reflects has to be known"):
        one(document, tmp_path)


@pytest.mark.parametrize(
    ("mode", "alpha", "fine"),
    [("MASK", 0, False), ("BLEND", 128, False), ("BLEND", 254, True), ("MASK", 200, True), ("OPAQUE", 0, True)],
)
def test_alpha(mode, alpha, fine, tmp_path):
    document = Document()
    pixels = np.full((2, 2, 4), 255, np.uint8)
    pixels[0, 0, 3] = alpha
    document.quad(material={"name": "leaf", "alphaMode": mode, PBR: {"baseColorTexture": document.texture(pixels)}})
    if fine:
        assert isinstance(one(document, tmp_path)[1].albedo, Bitmap)
        return
    with pytest.raises(InputError, match=rf"material leaf has the alphaMode {mode} and is transparent"):
        one(document, tmp_path)


# ---- lamps


def power(meshes):
    total = np.zeros(3)
    for mesh in meshes:
        area = trimesh.triangles.area(corners(mesh).astype(np.float64)).sum()
        total += area * (0 if mesh.radiance is None else mesh.radiance.astype(np.float64))
    return total


def test_a_lamp_by_its_strength_or_by_a_picture_of_one_colour(tmp_path):
    document = Document()
    strong = extended("KHR_materials_emissive_strength", emissiveStrength=40.0)
    document.quad(material={"emissiveFactor": [1, 0.5, 0.25], PBR: {"metallicFactor": 0}, **strong})
    np.testing.assert_array_equal(one(document, tmp_path)[0].radiance, [40, 20, 10])
    document = Document()
    info = document.texture(np.full((64, 64, 3), 255, np.uint8))
    shining = {"emissiveFactor": [3 / 4, 1 / 2, 1 / 4], "emissiveTexture": info}
    document.quad(material={**shining, PBR: {"metallicFactor": 0}})
    mesh, _ = one(document, tmp_path)
    assert len(mesh.faces) == 2
    np.testing.assert_allclose(mesh.radiance, [0.75, 0.5, 0.25])


@pytest.mark.parametrize("smooth", [False, True])
def test_a_picture_that_shines(tmp_path, smooth):
    """The power is that of the picture, also by halves; what is dark is no lamp; normals and coordinates stay."""
    rng = np.random.default_rng(6)
    pixels = np.zeros((16, 16, 3), np.uint8)
    pixels[:, 8:] = (250, 120, 10)
    if smooth:
        pixels = rng.integers(0, 256, (16, 16, 3), np.uint8)
    document = Document()
    info = document.texture(pixels, {"wrapS": CLAMP, "wrapT": CLAMP})
    document.quad(material={"emissiveFactor": [1, 1, 0.5], "emissiveTexture": info, PBR: {"metallicFactor": 0},
                            **extended("KHR_materials_emissive_strength", emissiveStrength=10.0)})  # fmt: skip
    room = read_gltf(document.glb(tmp_path / "a.glb"))
    linear = from_srgb(pixels / 255.0).astype(np.float64)
    expected = 4.0 * linear.mean((0, 1)) * (10, 10, 5)
    np.testing.assert_allclose(power(room.meshes), expected, rtol=2e-3)
    areas = [Geometry(Scene("a", [m], room.materials)).face_area.sum() for m in room.meshes]
    assert float(sum(areas)) == pytest.approx(4.0, rel=1e-5)
    assert "shines by a picture" in room.notes[0]
    assert len(room.meshes) <= 66
    assert len({mesh.name for mesh in room.meshes}) == len(room.meshes)
    for mesh in room.meshes:
        np.testing.assert_allclose(mesh.vertices[:, [0, 2]], mesh.uvs * 2 - 1, atol=1e-5)
    if not smooth:  # half is dark but for the texels between
        dark = sum(a for a, m in zip(areas, room.meshes, strict=True) if m.radiance is None)
        assert 1.7 < float(dark) < 2.0
        full = max((m for m in room.meshes if m.radiance is not None), key=lambda m: len(m.faces))
        np.testing.assert_allclose(full.radiance, linear[0, 8] * (10, 10, 5), rtol=1e-3)


def test_lamps_that_shine_from_both_sides(tmp_path):
    document = Document()
    lamp = {"emissiveFactor": [1, 1, 1], "doubleSided": True, PBR: {"metallicFactor": 0}}
    document.quad(material=lamp, name="pane")
    ball = trimesh.creation.icosphere(1)
    material = document.add("materials", lamp)
    attributes = {"POSITION": document.accessor(ball.vertices)}
    document.node(
        mesh=document.mesh(attributes, document.accessor(ball.faces.ravel(), "u2"), material=material), name="ball"
    )
    room = read_gltf(document.glb(tmp_path / "a.glb"))
    assert [mesh.name for mesh in room.meshes] == ["pane", "pane (back)", "ball"]
    front, back, _ = (Geometry(Scene("a", [m], room.materials)) for m in room.meshes)
    torch.testing.assert_close(front.face_normal, -back.face_normal)
    assert -1e-3 < float(back.vertices[:, 1].max()) < 0 == float(front.vertices[:, 1].min())
    assert "shines from both sides" in room.notes[0]
