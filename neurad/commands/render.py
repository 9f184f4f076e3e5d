"""``neurad render``: pictures and material maps of a scene's views from its own, known materials."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from neurad.core.protocols import Integrator, Materials
    from neurad.core.records import View
    from neurad.integrators.world import World
    from neurad.scene.description import Scene

_SEED = 20230806


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--scene", help="name of a built-in scene: kitchen, cornell, cube, furnace or sphere")
    source.add_argument("--root", help="scene folder with scene.xml and transforms_*.json")
    parser.add_argument("--out", required=True, type=Path, help="folder to write; it gets images/, albedo/, roughness/")
    parser.add_argument(
        "--integrator", choices=("path", "direct", "radiometric"), default="path",
        help="path (default), direct light only, or neural radiosity: a radiance field is trained first, then images/ "
             "shows one bounce and the field behind it, images_lhs/ the field itself",
    )  # fmt: skip
    parser.add_argument("--steps", type=int, default=2000, help="training steps of the radiance field (default: 2000)")
    parser.add_argument("--seconds", type=float, help="longest training of the radiance field (default: no limit)")
    parser.add_argument("--views", choices=("train", "test", "all"), default="all", help="which views (default: all)")
    parser.add_argument("--spp", type=int, default=256, help="samples a pixel of the pictures (default: 256)")
    parser.add_argument("--map-spp", type=int, default=64, help="samples a pixel of the material maps (default: 64)")
    parser.add_argument("--size", type=int, help="width of the pictures in pixels (default: that of the views)")
    parser.add_argument("--max-depth", type=int, help="longest path, 2 is direct light (default: that of the scene)")
    parser.add_argument("--tracer", default="embree", help="embree (default) or open3d")
    parser.add_argument("--overwrite", action="store_true", help="write over files that are there")


def run(options: argparse.Namespace) -> None:
    """Render every view with the scene's true materials.

    The same command writes the same bytes, but for ``--seconds``: each view has its own random stream and nothing
    depends on the time.

    Raises:
        InputError: unknown scene, unreadable files, a bad number, or a file that would be overwritten.
    """
    from dataclasses import replace

    from neurad.assembly.build import build_world
    from neurad.core.camera import resized
    from neurad.core.errors import InputError
    from neurad.core.rng import mix
    from neurad.integrators.aov import MaterialMap
    from neurad.integrators.film import render
    from neurad.scene.image_io import write_exr
    from neurad.scene.load import load_scene
    from neurad.scene.textures import TrueMaterials

    for name in ("spp", "map_spp", "steps"):
        if getattr(options, name) < 1:
            raise InputError(f"--{name.replace('_', '-')}: {getattr(options, name)} is not a positive number")
    if options.seconds is not None and options.seconds <= 0:
        raise InputError(f"--seconds: {options.seconds} is not a positive number")
    if options.max_depth is not None and options.integrator != "path":
        raise InputError(f"--max-depth: only paths have a depth, --integrator {options.integrator} has none to choose")
    scene = load_scene(options.root, options.scene)
    views = {"train": scene.train, "test": scene.test, "all": scene.train + scene.test}[options.views]
    folders = ("images", "albedo", "roughness", *(["images_lhs"] if options.integrator == "radiometric" else []))
    targets = [options.out / kind / f"{v.name}.exr" for v in views for kind in folders]
    if not options.overwrite and (found := [t for t in targets if t.exists()]):
        raise InputError(f"--out: {found[0]} is there already; add --overwrite to write over it")
    world = build_world(scene, options.tracer)
    materials = TrueMaterials(scene, world.geometry)
    pictures = integrators(options, scene, world, materials)
    maps = MaterialMap(world, materials)
    for kind in folders:
        (options.out / kind).mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    for index, view in enumerate(views):
        camera = resized(view.camera, options.size)
        seed = mix(_SEED, *view.name.encode())
        for kind, integrator in pictures.items():
            write_exr(options.out / kind / f"{view.name}.exr", render(camera, integrator, options.spp, seed).numpy())
        both = render(camera, maps, options.map_spp, seed).numpy()
        write_exr(options.out / "albedo" / f"{view.name}.exr", both[..., :3])
        write_exr(options.out / "roughness" / f"{view.name}.exr", both[..., 3:])
        done = time.perf_counter() - start
        left = done / (index + 1) * (len(views) - index - 1)
        print(f"{view.name}: {index + 1} of {len(views)}, {done:.0f} s, {left:.0f} s left", file=sys.stderr)
    for part in ("train", "test"):
        chosen = [replace(v, camera=resized(v.camera, options.size)) for v in views if v in getattr(scene, part)]
        if chosen:
            (options.out / f"transforms_{part}.json").write_text(json.dumps(transforms(chosen), indent=1) + "\n")


def integrators(options: argparse.Namespace, scene: Scene, world: World, materials: Materials) -> dict[str, Integrator]:
    """What renders the pictures, by the folder that they go to; trains the radiance field where one is asked for."""
    from neurad.integrators.path import PathTracer

    if options.integrator == "path":
        return {"images": PathTracer(world, materials, options.max_depth or scene.max_depth, scene.rr_depth)}
    if options.integrator == "direct":
        return {"images": PathTracer(world, materials, 2)}
    from neurad.integrators.radiometric import RadiometricLHS, RadiometricRHS
    from neurad.runs.model_settings import model_settings
    from neurad.training.train_radiance import train_radiance

    cameras = [view.camera for view in scene.train + scene.test]
    start = time.perf_counter()

    def report(step: int, loss: float) -> None:
        print(f"radiance field: step {step}, {time.perf_counter() - start:.0f} s, loss {loss:.4g}", file=sys.stderr)

    settings = model_settings("scene.yaml", _SEED)
    field = train_radiance(scene, world, materials, cameras, settings, options.steps, options.seconds, report)
    parts = (world, materials, field)
    return {"images": RadiometricRHS(*parts), "images_lhs": RadiometricLHS(*parts)}


def transforms(views: list[View]) -> dict[str, object]:
    """The NeRF/Blender camera file of views that share one film."""
    camera = views[0].camera
    focal = 0.5 * camera.width / math.tan(0.5 * camera.fov_x)
    return {
        "camera_angle_x": camera.fov_x,
        "w": camera.width,
        "h": camera.height,
        "fl_x": focal,
        "fl_y": focal,
        "frames": [
            {
                "file_path": f"images/{view.name}.exr",
                "albedo_path": f"albedo/{view.name}.exr",
                "roughness_path": f"roughness/{view.name}.exr",
                "transform_matrix": [[float(x) for x in row] for row in view.camera.to_world],
            }
            for view in views
        ],
    }
