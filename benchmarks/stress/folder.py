"""Scenes in memory written as scene folders, for rows that enter by the command line."""

import json
from pathlib import Path

import numpy as np

from neurad.assembly.build import build_world
from neurad.core.protocols import Integrator
from neurad.core.records import Constant, FloatArray, Material, Mesh, Texture
from neurad.core.reflection import DiffuseModel
from neurad.images.image_io import write_exr
from neurad.integrators.film import render
from neurad.integrators.renderer import path_tracer
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials

Photographs = dict[str, dict[str, FloatArray]]
"""Pictures [h, w, c] by the name of the view, of each kind: images, albedo and, in a glossy scene, roughness."""


def photograph(scene: Scene, spp: int) -> Photographs:
    """Path-traced photographs of all views, and true maps.

    Args:
        scene: what is seen.
        spp: samples per pixel of the photographs; maps have four.
    """
    world = build_world(scene)
    materials = TrueMaterials(scene, world.geometry)
    kinds: dict[str, tuple[Integrator, int]] = {
        "images": (path_tracer(world, materials, scene.max_depth, scene.rr_depth), spp),
        "albedo": (lambda rays, seed: materials(world.intersect(rays)).albedo, 4),
    }
    if not scene.features.is_diffuse:
        kinds["roughness"] = (lambda rays, seed: materials(world.intersect(rays)).roughness, 4)
    return {
        kind: {
            view.name: render(view.camera, integrator, samples, 7 + index).numpy()
            for index, view in enumerate([*scene.train, *scene.test])
        }
        for kind, (integrator, samples) in kinds.items()
    }


def write_folder(scene: Scene, folder: Path, photographs: Photographs, light: float = 1.0) -> None:
    """Write a scene of constant materials and area lights.

    Args:
        scene: what ``scene.xml`` and the camera files describe.
        folder: to be made.
        photographs: of its views.
        light: factor on them.
    """
    (folder / "meshes").mkdir(parents=True)
    parts = [
        '<scene version="3.0.0">',
        f'<integrator type="path"><integer name="max_depth" value="{scene.max_depth}"/>',
        f'<integer name="rr_depth" value="{scene.rr_depth}"/></integrator>',
    ]
    parts += [_bsdf(index, material) for index, material in enumerate(scene.materials)]
    for index, mesh in enumerate(scene.meshes):
        _write_ply(mesh, folder / f"meshes/{index}.ply")
        parts.append(_shape(index, mesh))
    (folder / "scene.xml").write_text("\n".join([*parts, "</scene>"]) + "\n")
    for name, views in (("train", scene.train), ("test", scene.test)):
        camera = views[0].camera
        frames = [{"file_path": f"images/{v.name}.exr", "transform_matrix": v.camera.to_world.tolist()} for v in views]
        described = {"camera_angle_x": camera.fov_x, "w": camera.width, "h": camera.height, "frames": frames}
        (folder / f"transforms_{name}.json").write_text(json.dumps(described))
    for kind, pictures in photographs.items():
        (folder / kind).mkdir()
        for name, pixels in pictures.items():
            factor = np.float32(light if kind == "images" else 1.0)
            write_exr(folder / kind / f"{name}.exr", pixels * factor, half=False)


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{float(x):.9g}" for x in values)


def _shape(index: int, mesh: Mesh) -> str:
    light = ""
    if mesh.radiance is not None:
        light = f'<emitter type="area"><rgb name="radiance" value="{_numbers(mesh.radiance)}"/></emitter>'
    return (
        f'<shape type="ply" id="mesh_{index}"><string name="filename" value="meshes/{index}.ply"/>'
        f'<boolean name="face_normals" value="true"/><ref id="material_{mesh.material}"/>{light}</shape>'
    )


def _bsdf(index: int, material: Material) -> str:
    albedo = _numbers(_value(material.albedo))
    if isinstance(material.model, DiffuseModel):
        inner = f'<bsdf type="diffuse"><rgb name="reflectance" value="{albedo}"/></bsdf>'
    else:
        roughness = _numbers(_value(material.roughness))
        inner = (
            f'<bsdf type="principled"><rgb name="base_color" value="{albedo}"/>'
            f'<float name="roughness" value="{roughness}"/></bsdf>'
        )
    return f'<bsdf type="twosided" id="material_{index}">{inner}</bsdf>'


def _value(texture: Texture) -> np.ndarray:
    assert isinstance(texture, Constant)
    return texture.value


def _write_ply(mesh: Mesh, path: Path) -> None:
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(mesh.vertices)}\nproperty float x\n"
        f"property float y\nproperty float z\nelement face {len(mesh.faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(mesh.faces), np.dtype([("count", "u1"), ("corner", "<i4", 3)]))
    faces["count"], faces["corner"] = 3, mesh.faces
    path.write_bytes(header.encode() + mesh.vertices.astype("<f4").tobytes() + faces.tobytes())
