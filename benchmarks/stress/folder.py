"""Scenes in memory written as scene folders, for rows that enter by the command line."""

import json
from pathlib import Path

import numpy as np

from neurad.assembly.build import build_world
from neurad.core.protocols import Integrator
from neurad.core.records import FloatArray
from neurad.formats.mitsuba.write import describe, write_xml
from neurad.images.image_io import write_exr
from neurad.integrators.film import render
from neurad.integrators.renderer import path_tracer
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials

Photographs = dict[str, dict[str, FloatArray]]
"""Pictures [h, w, c] by the name of the view, of each kind: images, albedo and, in a glossy scene, roughness."""


def photograph(scene: Scene, spp: int) -> Photographs:
    """Path-traced photographs of all views, ``spp`` samples a pixel, and true maps of four."""
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
    """Write a scene and the pictures of its views into a folder to be made; ``light`` is a factor on photographs."""
    folder.mkdir(parents=True)
    write_xml(describe(scene, folder), folder / "scene.xml")
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
