"""Pictures and material maps of a scene or of what a run recovered, from any camera and by any method there is."""

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from neurad.core.camera import resized
from neurad.core.errors import InputError
from neurad.core.parameters import split
from neurad.core.protocols import Integrator
from neurad.core.rng import mix
from neurad.core.scene_records import Camera, View
from neurad.formats.axes import axis
from neurad.formats.cameras.nerf import read_cameras
from neurad.formats.cameras.write import transforms
from neurad.formats.edits.edit import Edit
from neurad.formats.edits.edit_file import read_edit
from neurad.formats.edits.placement import Kind, path_of, scene_axis
from neurad.formats.reader import Reader
from neurad.images.image_io import write_exr, write_png
from neurad.images.movie import Format, check_movie, filming, target_of
from neurad.images.picture_notes import say_pictures
from neurad.integrators.film import render
from neurad.integrators.renderer import MaterialMap
from neurad.pages.colours import encode
from neurad.runs.render_subject import SEED, recovered_subject, true_subject
from neurad.runtime.files import check_folder, make_folder, write_text
from neurad.runtime.progress import counted, phase, say
from neurad.scene.description import Scene
from neurad.scene.exposure import exposure
from neurad.scene.origin import camera_in_scene


@dataclass(frozen=True)
class RenderSettings:
    """What to render, and how: the options of ``neurad render``, whose help says what they mean."""

    out: Path
    scene: str | None
    root: str | None
    ckpt_path: str | None
    trust: Sequence[str]
    reader: Reader | None
    camera: str | None
    edit: str | None
    integrator: str | None
    steps: int
    seconds: float | None
    views: str | None
    path: Kind | None
    frames: int
    fps: int
    movie: Format
    exposure: float | None
    spp: int
    map_spp: int
    size: int | None
    max_depth: int | None
    tracer: str
    overwrite: bool

    def __post_init__(self) -> None:
        """Refuse what does not go together."""
        if self.ckpt_path is None and (self.root is None) == (self.scene is None):
            raise InputError("give one of --scene (a built-in scene), --root (a scene folder) and --ckpt_path (a run)")
        if self.ckpt_path is not None and self.scene is not None:
            raise InputError("--scene: a run has its own scene; --root names a folder with another light of it")
        if self.ckpt_path is not None and self.reader is not None:
            raise InputError("--data.reader: a run has the reader that it was fitted with; leave it out")
        if self.camera is not None and self.views is not None:
            raise InputError("--views: the cameras are those of --camera, give one of the two")


def render_views(settings: RenderSettings) -> None:
    """Render views, or a film, of a scene or of what a run recovered.

    The same settings write the same bytes, but for ``seconds``: each view has its own random stream and nothing depends
    on the time.

    Raises:
        InputError: unknown scene, run or method, unreadable files, an edit that does not fit, a bad number, or a file
            that would be overwritten.
    """
    check_folder(settings.out, "--out")
    if settings.path is not None:
        check_movie(settings.movie)
        _refuse([target_of(settings.movie, settings.out)], settings)
    edit = Edit() if settings.edit is None else read_edit(settings.edit)
    wanted = settings.integrator, settings.max_depth
    if settings.ckpt_path is None:
        subject = true_subject(settings.root, settings.scene, edit, *wanted, settings.tracer, settings.reader)
    else:
        subject = recovered_subject(settings.ckpt_path, settings.root, edit, *wanted, settings.trust)
    views = _views(settings, subject.scene)
    kinds = ["images", *(["images_lhs"] if subject.method.needs_field else [])]
    if settings.path is None:
        maps = MaterialMap(subject.parts.world, subject.parts.materials, subject.parameters)
        names = [(kind, "exr") for kind in (*kinds, *(p.name for p in maps.parameters))]
        names += [("png", "png")] if _shows(settings) else []
        _refuse([settings.out / kind / f"{view.name}.{end}" for view in views for kind, end in names], settings)
    say_pictures()
    for change in subject.said:
        say(f"changed: {change}")
    if subject.said:
        how = "its radiance field is learned anew" if subject.method.needs_field else "paths are traced"
        say(f"{how} under this light, with these materials")
    pictures = subject.integrators([view.camera for view in views], settings.steps, settings.seconds)
    if settings.path is not None:
        _film(settings, [resized(view.camera, settings.size) for view in views], pictures["images"])
    else:
        _write(settings, views, pictures, maps, subject.scene)


def _shows(settings: RenderSettings) -> bool:
    """Whether PNG pictures are written, too: of what is not a data set of true maps."""
    return settings.ckpt_path is not None or settings.edit is not None or settings.camera is not None


def _refuse(targets: Sequence[Path], settings: RenderSettings) -> None:
    if not settings.overwrite and (found := [target for target in targets if target.exists()]):
        raise InputError(f"--out: {found[0]} is there already; add --overwrite to write over it")


def _views(settings: RenderSettings, scene: Scene) -> list[View]:
    """The views to render: of the camera file, or of the scene."""
    if settings.camera is not None:
        film = next((view.camera for view in (*scene.test, *scene.train)), None)
        size = (256, 256) if film is None else (film.width, film.height)
        found = read_cameras(settings.camera, size)
        views = [replace(view, camera=camera_in_scene(view.camera, scene)) for view in found]
    else:
        part = settings.views or ("all" if settings.ckpt_path is None else "scored")
        named = {"train": scene.train, "test": scene.test, "all": scene.train + scene.test, "scored": scene.scored}
        views = named[part]
        if not views:
            raise InputError(f"--views {part}: scene {scene.name} has none; name a camera file with --camera")
    if settings.path is None:
        return views
    up, middle = axis(scene_axis(scene)), scene.bounds.mean(0)
    cameras = path_of(settings.path, [view.camera for view in views], settings.frames, up, middle)
    return [View(f"{index:04d}", camera) for index, camera in enumerate(cameras)]


def _write(
    settings: RenderSettings, views: list[View], pictures: dict[str, Integrator], maps: MaterialMap, scene: Scene
) -> None:
    """Pictures and maps of views, and their camera files."""
    out = settings.out
    names = [parameter.name for parameter in maps.parameters]
    for kind in (*pictures, *names, *(["png"] if _shows(settings) else [])):
        make_folder(out / kind, "--out")
    scale = None if settings.exposure is None else 2.0**settings.exposure
    start = time.perf_counter()
    with phase("rendering", len(views) * (len(pictures) + 1)) as rendering:
        for index, view in enumerate(views):
            rendering.detail = view.name
            camera = resized(view.camera, settings.size)
            seed = mix(SEED, *view.name.encode())
            for kind, integrator in pictures.items():
                image = render(camera, integrator, settings.spp, seed).numpy()
                rendering.step(detail=view.name)
                write_exr(out / kind / f"{view.name}.exr", image)
                if kind == "images" and _shows(settings):
                    scale = exposure([image]) if scale is None else scale
                    write_png(out / "png" / f"{view.name}.png", encode(image * np.float32(scale)))
            found = render(camera, maps, settings.map_spp, seed).numpy()
            rendering.step()
            for name, values in split(found, maps.parameters).items():
                write_exr(out / name / f"{view.name}.exr", values)
            _progress(view.name, index, len(views), start)
    parts = {"": views} if settings.camera else {"_train": scene.train, "_test": scene.test}
    for part, of in parts.items():
        chosen = [replace(v, camera=resized(v.camera, settings.size)) for v in views if any(v is w for w in of)]
        if chosen:
            described = transforms(chosen, scene.origin, names)
            write_text(out / f"transforms{part}.json", json.dumps(described, indent=1) + "\n")
    also = f", as PNG in {out / 'png'}" if _shows(settings) else ""
    print(f"neurad: pictures are in {out / 'images'} (EXR){also}")


def _film(settings: RenderSettings, cameras: Sequence[Camera], integrator: Integrator) -> None:
    scale = None if settings.exposure is None else 2.0**settings.exposure
    start = time.perf_counter()
    with filming(settings.movie, settings.out, settings.fps) as add:
        for index, camera in enumerate(counted(cameras, "rendering", len(cameras), "frames")):
            image = render(camera, integrator, settings.spp, mix(SEED, index)).numpy()
            scale = exposure([image]) if scale is None else scale
            add(encode(image * np.float32(scale)))
            _progress(f"frame {index:04d}", index, len(cameras), start)
    print(f"neurad: {target_of(settings.movie, settings.out)}")


def _progress(name: str, index: int, count: int, start: float) -> None:
    done = time.perf_counter() - start
    left = done / (index + 1) * (count - index - 1)
    print(f"{name}: {index + 1} of {count}, {done:.0f} s, {left:.0f} s left", file=sys.stderr)
