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
    from neurad.core.records import View

_SEED = 20230806


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--scene", help="name of a built-in scene: kitchen, cornell, cube, furnace or sphere")
    source.add_argument("--root", help="scene folder with scene.xml and transforms_*.json")
    parser.add_argument("--out", required=True, type=Path, help="folder to write; it gets images/, albedo/, roughness/")
    parser.add_argument("--views", choices=("train", "test", "all"), default="all", help="which views (default: all)")
    parser.add_argument("--spp", type=int, default=256, help="samples a pixel of the pictures (default: 256)")
    parser.add_argument("--map-spp", type=int, default=64, help="samples a pixel of the material maps (default: 64)")
    parser.add_argument("--size", type=int, help="width of the pictures in pixels (default: that of the views)")
    parser.add_argument("--max-depth", type=int, help="longest path, 2 is direct light (default: that of the scene)")
    parser.add_argument("--tracer", default="embree", help="embree (default) or open3d")
    parser.add_argument("--overwrite", action="store_true", help="write over files that are there")


def run(options: argparse.Namespace) -> None:
    """Render every view with the path tracer and the scene's true materials.

    The same command writes the same bytes: each view has its own random stream and nothing depends on the time.

    Raises:
        InputError: unknown scene, unreadable files, a bad number, or a file that would be overwritten.
    """
    from neurad.core.errors import InputError
    from neurad.core.rng import mix
    from neurad.integrators.aov import MaterialMap
    from neurad.integrators.film import render
    from neurad.integrators.path import PathTracer
    from neurad.module.assemble import build_world
    from neurad.scene.image_io import write_exr
    from neurad.scene.load import load_scene
    from neurad.scene.textures import TrueMaterials

    for name in ("spp", "map_spp"):
        if getattr(options, name) < 1:
            raise InputError(
                f"--{name.replace('_', '-')}: {getattr(options, name)} is not a positive number of samples"
            )
    scene = load_scene(options.root, options.scene)
    views = {"train": scene.train, "test": scene.test, "all": scene.train + scene.test}[options.views]
    targets = [options.out / kind / f"{v.name}.exr" for v in views for kind in ("images", "albedo", "roughness")]
    if not options.overwrite and (found := [t for t in targets if t.exists()]):
        raise InputError(f"--out: {found[0]} is there already; add --overwrite to write over it")
    world = build_world(scene, options.tracer)
    materials = TrueMaterials(scene, world.geometry)
    path = PathTracer(world, materials, options.max_depth or scene.max_depth, scene.rr_depth)
    maps = MaterialMap(world, materials)
    for kind in ("images", "albedo", "roughness"):
        (options.out / kind).mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    for index, view in enumerate(views):
        camera = resized(view, options.size).camera
        seed = mix(_SEED, *view.name.encode())
        write_exr(options.out / "images" / f"{view.name}.exr", render(camera, path, options.spp, seed).numpy())
        both = render(camera, maps, options.map_spp, seed).numpy()
        write_exr(options.out / "albedo" / f"{view.name}.exr", both[..., :3])
        write_exr(options.out / "roughness" / f"{view.name}.exr", both[..., 3:])
        done = time.perf_counter() - start
        left = done / (index + 1) * (len(views) - index - 1)
        print(f"{view.name}: {index + 1} of {len(views)}, {done:.0f} s, {left:.0f} s left", file=sys.stderr)
    for part in ("train", "test"):
        chosen = [resized(v, options.size) for v in views if v in getattr(scene, part)]
        if chosen:
            (options.out / f"transforms_{part}.json").write_text(json.dumps(transforms(chosen), indent=1) + "\n")


def resized(view: View, width: int | None) -> View:
    """The view with its film scaled to ``width`` pixels; the same view for None."""
    from dataclasses import replace

    if width is None:
        return view
    height = round(view.camera.height * width / view.camera.width)
    return replace(view, camera=replace(view.camera, width=width, height=height))


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
