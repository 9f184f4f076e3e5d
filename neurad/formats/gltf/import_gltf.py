"""From a glTF scene to a scene folder: ``neurad data gltf``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import View
from neurad.formats.cameras import HOLD_OUT
from neurad.formats.cameras.nerf import Split
from neurad.formats.cameras.photograph_files import Photographs
from neurad.formats.gltf.file import GltfFile
from neurad.formats.gltf.gltf_scene import ENVIRONMENT
from neurad.formats.gltf.nodes import GltfCamera
from neurad.formats.gltf.read import ENDINGS, GltfRoom, read_gltf
from neurad.formats.import_room import (
    ImportSettings,
    check_room,
    free_folder,
    map_of,
    refuse_meshes,
    whole,
)
from neurad.formats.room_folder import RoomParts, write_views
from neurad.images.photographs import check_view, picture_size
from neurad.images.picture_notes import say_pictures
from neurad.runtime.files import place, writing
from neurad.runtime.progress import counted
from neurad.runtime.reading import folder, listed, regular_file, shown
from neurad.scene.description import Scene

_SHAPE = 0.01  # difference of the proportions of a camera and its photograph that is refused


def import_gltf(settings: ImportSettings) -> None:
    """Make the scene folder, whole or not at all, and say what is in it.

    Raises:
        InputError: a file is missing or broken, the scene uses what cannot be rendered, photographs and cameras do not
            fit, an option does not apply, or the folder is there already.
    """
    refuse_meshes(settings, "a glTF scene")
    out = free_folder(settings.out)
    source = _scene_file(settings.source)
    environment = None if settings.environment is None else map_of(settings.environment)
    room = read_gltf(source)
    views = Split([], [])
    if settings.images is not None:
        views = _photographed(room, folder(settings.images, "--images"), source)
    with whole(out) as part:
        with writing(part, "--out"):
            name = f"scene{source.suffix.lower()}"
            place(source, part / name, settings.copy)
            for beside in dict.fromkeys(GltfFile(source).files()):
                (part / beside).parent.mkdir(parents=True, exist_ok=True)
                place(regular_file(source.parent / beside), part / beside, settings.copy)
            if environment is not None:
                place(environment, part / ENVIRONMENT, settings.copy)
            write_views(RoomParts(views, [], np.eye(4), {}, None, settings.copy), part)
        scene = None
        if views.train or room.cameras:
            scene = check_room(part)
    _say(out, room, views, scene, environment is not None)


def _scene_file(source: Path) -> Path:
    """The file itself, or the only one of its kind in a folder."""
    if not source.is_dir():
        file = regular_file(source, "there is no such glTF file")
        if file.suffix.lower() not in ENDINGS:
            raise InputError(f"{shown(source)}: it is no glTF file ({' or '.join(ENDINGS)})")
        return file.resolve()
    found = [file for file in sorted(source.iterdir()) if file.suffix.lower() in ENDINGS]
    if len(found) != 1:
        raise InputError(f"{shown(source)}: it has {len(found)} files of glTF; name the one that is meant")
    return found[0].resolve()


def _photographed(room: GltfRoom, images: Path, source: Path) -> Split:
    """The cameras that have a photograph of their name."""
    find = Photographs(images)
    views, without = [], []
    for camera in room.cameras:
        where = f"{shown(source)}: camera {shown(camera.name)}"
        photograph = find.named(camera.name)
        if photograph is None:
            without.append(camera.name)
            continue
        views.append(_view(camera, photograph, where))
    for view in counted(views, "reading", len(views), "photographs"):
        check_view(view)
    if not room.cameras:
        raise InputError(f"{shown(source)}: it has no perspective camera, so that no photograph can belong to it")
    if not views:
        raise InputError(
            f"--images {shown(images)}: it has no photograph of any camera, such as {shown(without[0])}.exr"
        )
    said = f"{shown(source)}: {len(without)} cameras have no photograph and are left out ({listed(without)})"
    return Split(views, [], (said,) if without else ())


def _view(camera: GltfCamera, photograph: Path, where: str) -> View:
    width, height = picture_size(photograph)
    if camera.aspect is not None and abs(camera.aspect * height / width - 1.0) > _SHAPE:
        raise InputError(
            f"{where} has the aspectRatio {camera.aspect:.4g}, but its photograph {shown(photograph.name)} has "
            f"{width} x {height} pixels"
        )
    return View(camera.name, camera.seen(width, height), str(photograph))


def _say(out: Path, room: GltfRoom, views: Split, scene: Scene | None, has_environment: bool) -> None:
    """What the folder has, and what it lacks."""
    triangles = sum(len(mesh.faces) for mesh in room.meshes)
    shining = [mesh.name for mesh in room.meshes if mesh.radiance is not None]
    shining += [f"{light.name} ({light.kind})" for light in room.lights]
    print(f"{shown(out)}: {len(room.meshes)} meshes, {triangles} triangles, {len(room.cameras)} cameras")
    say_pictures()
    for note in (*room.notes, *views.notes):
        print(f"neurad: {note}", file=sys.stderr)
    if shining:
        print(f"lamps: {listed(shining)}")
    elif not has_environment:
        print(
            "neurad: warning: nothing in the room shines, so it cannot be fitted yet: give materials an emission, or "
            "--environment",
            file=sys.stderr,
        )
    if views.train:
        print(f"{len(views.train)} photographs; a fit holds out every {HOLD_OUT}th by name (--data.hold_out)")
        print(f"neurad fit --config scene.yaml --data.root {shown(out)}")
    elif scene is not None:
        print("no --images were given: it can be rendered, and fitted when it has photographs and a camera file")
        print(f"neurad render --root {shown(out)} --out pictures")
    else:
        print("neither cameras nor --images: put a transforms_train.json and photographs into the folder")
