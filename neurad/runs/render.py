"""Pictures and material maps of a scene's views from its own, known materials, by any method there is."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jsonargparse import ArgumentParser
from omegaconf import OmegaConf

from neurad.assembly.build import build_world
from neurad.core.camera import resized
from neurad.core.errors import InputError
from neurad.core.protocols import Integrator
from neurad.core.ranges import Count, Positive, checked
from neurad.core.rng import mix
from neurad.core.suggest import did_you_mean
from neurad.integrators.aov import MaterialMap
from neurad.integrators.film import render
from neurad.integrators.method import Method, SceneModel
from neurad.integrators.path import PathTracing
from neurad.integrators.renderer import FieldRenderer, MethodRenderer
from neurad.integrators.world import World
from neurad.runs.configs import load_config, shipped_folders
from neurad.runs.model_settings import model_settings
from neurad.runtime.files import check_folder, make_folder, write_text
from neurad.runtime.progress import phase
from neurad.scene.description import Scene
from neurad.scene.image_io import write_exr
from neurad.scene.load import load_scene
from neurad.scene.textures import TrueMaterials
from neurad.scene.transforms import transforms
from neurad.training.train_radiance import train_radiance

SEED = 20230806


@dataclass(frozen=True)
class RenderSettings:
    """What to render, and how."""

    out: Path
    """Folder to write."""
    scene: str | None = None
    """Name of a built-in scene."""
    root: str | None = None
    """Scene folder."""
    integrator: str = "path"
    """Name of a method, see :func:`method_names`."""
    steps: Count = 2000
    """Training steps of the radiance field, for methods that read one."""
    seconds: Positive | None = None
    """Longest training of the radiance field."""
    views: str = "all"
    """'train', 'test' or 'all'."""
    spp: Count = 256
    """Samples a pixel of the pictures."""
    map_spp: Count = 64
    """Samples a pixel of the material maps."""
    size: Count | None = None
    """Width of the pictures in pixels; None: that of the views."""
    max_depth: Count | None = None
    """Longest path; None: that of the scene."""
    tracer: str = "embree"
    overwrite: bool = False

    def __post_init__(self) -> None:
        """Refuse numbers outside their ranges."""
        checked(self)


def render_views(settings: RenderSettings) -> None:
    """Render every view with the scene's true materials.

    The same settings write the same bytes, but for ``seconds``: each view has its own random stream and nothing depends
    on the time.

    Raises:
        InputError: unknown scene or method, unreadable files, a bad number, or a file that would be overwritten.
    """
    out = settings.out
    check_folder(out, "--out")
    method, paths = find_method(settings.integrator)
    if settings.max_depth is not None and not paths:
        raise InputError(f"--max-depth: only paths have a depth, --integrator {settings.integrator} has none to choose")
    scene = load_scene(settings.root, settings.scene)
    if paths:
        assert isinstance(method, PathTracing)
        method = type(method)(settings.max_depth or scene.max_depth, scene.rr_depth)
    views = {"train": scene.train, "test": scene.test, "all": scene.train + scene.test}[settings.views]
    folders = ("images", "albedo", "roughness", *(["images_lhs"] if method.needs_field else []))
    targets = [out / kind / f"{v.name}.exr" for v in views for kind in folders]
    if not settings.overwrite and (found := [t for t in targets if t.exists()]):
        raise InputError(f"--out: {found[0]} is there already; add --overwrite to write over it")
    world = build_world(scene, settings.tracer)
    materials = TrueMaterials(scene, world.geometry)
    pictures = _pictures(settings, method, scene, world, materials)
    maps = MaterialMap(world, materials)
    for kind in folders:
        make_folder(out / kind, "--out")
    start, begin = time.perf_counter(), time.monotonic()
    for index, view in enumerate(views):
        camera = resized(view.camera, settings.size)
        seed = mix(SEED, *view.name.encode())
        with phase("rendering", len(views) * (len(pictures) + 1)) as rendering:
            rendering.begin, rendering.detail = begin, view.name
            rendering.done = index * (len(pictures) + 1)
            for kind, integrator in pictures.items():
                write_exr(out / kind / f"{view.name}.exr", render(camera, integrator, settings.spp, seed).numpy())
                rendering.step(detail=view.name)
            both = render(camera, maps, settings.map_spp, seed).numpy()
        write_exr(out / "albedo" / f"{view.name}.exr", both[..., :3])
        write_exr(out / "roughness" / f"{view.name}.exr", both[..., 3:])
        done = time.perf_counter() - start
        left = done / (index + 1) * (len(views) - index - 1)
        print(f"{view.name}: {index + 1} of {len(views)}, {done:.0f} s, {left:.0f} s left", file=sys.stderr)
    for part in ("train", "test"):
        chosen = [replace(v, camera=resized(v.camera, settings.size)) for v in views if v in getattr(scene, part)]
        if chosen:
            write_text(out / f"transforms_{part}.json", json.dumps(transforms(chosen), indent=1) + "\n")


def find_method(name: str) -> tuple[Method, bool]:
    """A method by its name, with the settings of its overlay, and whether it is one of paths.

    Raises:
        InputError: there is none of this name.
    """
    found = _methods()
    if name not in found:
        raise InputError(
            f"--integrator: there is no method {name} ({', '.join(sorted(found))}){did_you_mean(name, found)}"
        )
    parser = ArgumentParser(exit_on_error=False)  # the parser of ``neurad fit`` makes the class that a config names
    parser.add_subclass_arguments(Method, "method")
    method: Method = parser.instantiate(parser.parse_object({"method": found[name]})).method
    return method, isinstance(method, PathTracing)


def _methods() -> dict[str, dict[str, Any]]:
    """Class and settings of every method in ``configs/methods``, by the name of its module: path, prb, ..."""
    found: dict[str, dict[str, Any]] = {}
    for folder in shipped_folders():
        for file in sorted((folder / "methods").glob("*.yaml")):
            method: Any = OmegaConf.to_container(OmegaConf.merge(*load_config(str(file))).model.method)
            found.setdefault(method["class_path"].split(".")[-2], method)
    return found


def _pictures(
    settings: RenderSettings, method: Method, scene: Scene, world: World, materials: TrueMaterials
) -> dict[str, Integrator]:
    """What renders the pictures, by the folder that they go to; trains the radiance field where one is read."""
    if not method.needs_field:
        return {"images": MethodRenderer(method, SceneModel(world, materials))}
    cameras = [view.camera for view in scene.train + scene.test]
    start = time.perf_counter()

    def report(step: int, loss: float) -> None:
        training.step(100, f"loss {loss:.3g}")
        print(f"radiance field: step {step}, {time.perf_counter() - start:.0f} s, loss {loss:.4g}", file=sys.stderr)

    model = model_settings("scene.yaml", SEED)
    with phase("training", None if settings.seconds else settings.steps, settings.seconds) as training:
        field = train_radiance(scene, world, materials, cameras, model, settings.steps, settings.seconds, report)
    parts = SceneModel(world, materials, field)
    return {"images": MethodRenderer(method, parts), "images_lhs": FieldRenderer(parts)}
