"""Scenes as Mitsuba scenes: for the peer in benchmarks, and for tests that compare the two renderers."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Bitmap, Constant, EnvironmentMap, Material, Mesh, Texture, View
from neurad.scene.description import Scene


def to_mitsuba(
    scene: Scene,
    view: View,
    size: int,
    samples: int = 16,
    integrator: dict[str, Any] | None = None,
    shading: Callable[[Material], Any] | None = None,
) -> Any:
    """``scene`` seen by ``view`` at ``size`` x ``size`` pixels with a box filter. A variant must have been set.

    Args:
        scene: what to build.
        view: the only sensor.
        size: width and height of its film in pixels.
        samples: per pixel.
        integrator: defaults to ``path`` with the scene's ``max_depth`` and ``rr_depth``.
        shading: the Mitsuba BSDF that stands for a material that is not a delta one; None keeps the scene's own.

    Raises:
        InputError: the view's camera distorts, or its pixels are not square.
    """
    import mitsuba as mi

    lens = view.camera.lens
    if lens.bends or lens.aspect != 1.0:
        raise InputError(f"view {view.name}: Mitsuba's cameras have no lens distortion and square pixels only")
    # Mitsuba's camera looks along +Z with +X to the left, ours along -Z with +X to the right
    pose = np.asarray(view.camera.to_world, np.float64) @ np.diag([-1.0, 1.0, -1.0, 1.0])
    described: dict[str, Any] = {
        "type": "scene",
        "integrator": integrator or {"type": "path", "max_depth": scene.max_depth, "rr_depth": scene.rr_depth},
        "sensor": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f(pose.astype(np.float32)),
            "fov": float(np.degrees(view.camera.fov_x)),
            "fov_axis": "x",
            "principal_point_offset_x": 0.5 - lens.centre[0],
            "principal_point_offset_y": 0.5 - lens.centre[1],
            "near_clip": 1e-3,
            "film": {
                "type": "hdrfilm",
                "width": size,
                "height": size,
                "rfilter": {"type": "box"},
                "component_format": "float32",
                "pixel_format": "rgb",
            },
            "sampler": {"type": "independent", "sample_count": samples},
        },
    }
    if scene.environment is not None:
        described["environment"] = _environment(mi, scene.environment)
    bsdfs: list[Any] = []
    for i, material in enumerate(scene.materials):
        name = f"material_{i}"
        if shading is not None and not material.model.is_delta:
            bsdfs.append(shading(material))
        else:
            described[name] = _bsdf(mi, material, name)
            bsdfs.append({"type": "ref", "id": name})
    with tempfile.TemporaryDirectory() as folder:
        for i, mesh in enumerate(scene.meshes):
            path = Path(folder) / f"{i}.ply"
            _write_ply(mi, mesh, path)
            shape: dict[str, Any] = {
                "type": "ply",
                "filename": str(path),
                "face_normals": mesh.normals is None,
                "bsdf": bsdfs[mesh.material],
            }
            if mesh.radiance is not None:
                shape["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": mesh.radiance.tolist()}}
            described[f"mesh_{i}"] = shape
        return mi.load_dict(described)


def _bsdf(mi: Any, material: Material, name: str) -> dict[str, Any]:
    inner = material.model.mitsuba(_texture(mi, material.albedo), _texture(mi, material.roughness))
    if material.two_sided and not (material.model.delta and material.model.delta.transmits):
        return {"type": "twosided", "id": name, "bsdf": inner}
    return {**inner, "id": name}


def _environment(mi: Any, environment: EnvironmentMap) -> dict[str, Any]:
    pose = np.asarray(environment.to_world, np.float64)
    pixels = np.ascontiguousarray(environment.pixels)
    return {"type": "envmap", "bitmap": mi.Bitmap(pixels), "to_world": mi.ScalarTransform4f(pose)}


def _texture(mi: Any, texture: Texture) -> Any:
    if isinstance(texture, Constant):
        value = [float(x) for x in texture.value]
        return {"type": "rgb", "value": value} if len(value) == 3 else value[0]
    assert isinstance(texture, Bitmap)
    pixels = np.ascontiguousarray(texture.pixels)  # the first row lies at v = 0 on both sides
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(pixels),
        "raw": True,
        "to_uv": mi.ScalarTransform3f(np.asarray(texture.to_uv, np.float64)),
    }


def _write_ply(mi: Any, mesh: Mesh, path: Path) -> None:
    out = mi.Mesh(
        mesh.name,
        len(mesh.vertices),
        len(mesh.faces),
        has_vertex_normals=mesh.normals is not None,
        has_vertex_texcoords=mesh.uvs is not None,
    )
    params = mi.traverse(out)
    params["vertex_positions"] = mesh.vertices.ravel()
    params["faces"] = mesh.faces.astype(np.uint32).ravel()
    if mesh.normals is not None:
        params["vertex_normals"] = mesh.normals.ravel()
    if mesh.uvs is not None:
        params["vertex_texcoords"] = mesh.uvs.ravel()
    params.update()
    out.write_ply(str(path))
