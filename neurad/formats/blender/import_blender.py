"""From a Blender file to a scene folder: ``neurad data blender``."""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neurad.core.camera import project, to_camera
from neurad.core.errors import InputError
from neurad.core.records import Bytes
from neurad.core.scene_records import Camera, Development, Mesh, View
from neurad.formats.blender.process import find_blender
from neurad.formats.blender.read import ROOM, TOWARDS_X, BlenderRoom, read_blender, read_world
from neurad.formats.blender.script import WRITE_ROOM
from neurad.formats.cameras.nerf import Split
from neurad.formats.import_room import (
    ImportSettings,
    check_room,
    lamp_names,
    only_file,
    photographed,
    places_of,
    say_scene,
    whole,
)
from neurad.formats.load import CAMERAS
from neurad.formats.mitsuba.write import FOLDERS, describe, write_xml
from neurad.formats.room_folder import write_views
from neurad.images.image_io import write_png
from neurad.runtime.extras import need
from neurad.runtime.files import writing
from neurad.runtime.reading import exists, listed, shown
from neurad.scene.origin import near, origin_of

_BEGINS = (b"BLENDER", b"\x28\xb5\x2f\xfd", b"\x1f\x8b")
"""First bytes of a .blend file: as it is, compressed by Zstandard, and as older versions compressed it."""
_BEFORE = 1e-4  # of the distance: what is nearer to the camera's plane is cut off
_EDGE = 3  # pixels of the line around a triangle: its edge is blurred by the filter of the picture


def import_blender(settings: ImportSettings) -> None:
    """Make the scene folder, whole or not at all, and say what is in it.

    Raises:
        InputError: a file is missing or broken, Blender is, the scene has no camera, surface or light or uses what
            cannot be rendered, photographs and cameras do not fit, or the folder is there already.
    """
    out, images, environment = places_of(settings, "a Blender scene")
    where = shown(settings.source)
    need("mitsuba", "mitsuba", "a scene folder of a Blender scene (scene.xml)")
    with _written(settings) as written:
        room = read_blender(written, where)
    if environment is not None:
        room = replace(
            room, scene=replace(room.scene, environment=read_world(environment, TOWARDS_X, shown(environment)))
        )
    _check(room, where)
    room = replace(room, scene=near(room.scene, origin_of(room.scene.meshes)))
    development = Development() if room.exposure == 1.0 else Development(exposure=room.exposure)
    views = Split([], []) if images is None else photographed(room.cameras, images, development)
    with whole(out) as part:
        with writing(part, "--out"):
            write_xml(describe(room.scene, part), part / "scene.xml")
            for name in FOLDERS:
                if not any((part / name).iterdir()):
                    (part / name).rmdir()
            _write_cameras(room, views, part, settings.copy)
        check_room(part)
    world = ["the world"] if room.scene.features.has_environment else []
    lines = [f"lamps: {listed([*lamp_names(room.scene.meshes, room.scene.punctual), *world])}"]
    if views.train and room.unseen:
        names = listed(mesh.name for mesh in room.unseen)
        lines.append(f"cameras do not see the lamps {names}: where they stand, photographs are masked")
    notes = (*room.scene.notes, *views.notes)
    say_scene(out, room.scene.meshes, len(room.cameras), notes, lines, len(views.train))


@contextmanager
def _written(settings: ImportSettings) -> Iterator[Path]:
    """The folder that ``write_room.py`` has written: the source itself, or of a .blend file a new one for the block."""
    source = settings.source
    if source.is_dir() and exists(source / ROOM):
        if settings.blender is not None:
            raise InputError(f"--blender: {shown(source)} is written already, Blender has nothing to do with it")
        yield source
        return
    blend = blend_file(source)
    blender = find_blender(settings.blender)
    with tempfile.TemporaryDirectory(prefix="neurad-") as made:
        said = blender.run(WRITE_ROOM, [made, str(blend)])
        if not exists(Path(made) / ROOM):
            raise InputError(f"{shown(source)}: Blender {blender.version} cannot read it ({said})")
        yield Path(made)


def blend_file(source: Path) -> Path:
    """The file itself, or the only one of its kind in a folder."""
    file = only_file(source, (".blend",), "Blender")
    with writing(file), file.open("rb") as stream:
        begins = stream.read(8)
    if not begins.startswith(_BEGINS):
        raise InputError(f"{shown(source)}: it is no file that Blender has saved")
    return file


def _check(room: BlenderRoom, where: str) -> None:
    lamps = {mesh.name for mesh in room.scene.meshes if mesh.radiance is not None}
    if len(room.scene.meshes) == 0 or len(lamps) == len(room.scene.meshes):
        raise InputError(f"{where}: its scene shows no mesh when it is rendered (empty, hidden, or of another scene)")
    if not room.cameras:
        said = "has no camera" if not room.scene.notes else "has no perspective camera"
        raise InputError(f"{where}: its scene {said}; add those of the photographs")
    if not room.scene.features.has_light:
        raise InputError(
            f"{where}: nothing in its scene shines (no lamp, no material that emits, a black world); add what lit the "
            "photographs, or give --environment"
        )


def _write_cameras(room: BlenderRoom, views: Split, part: Path, copy: bool) -> None:
    """The camera file with its photographs and masks, or without photographs the one of cameras alone."""
    if not views.train:
        named = [View(camera.names[0], camera.seen(*camera.film)) for camera in room.cameras]
        write_views(Split(named, []), part, copy, CAMERAS)
        return
    train = []
    for view in views.train:
        mask = mask_of(view.camera, room.unseen)
        if mask is not None:
            path = part / "masks" / f"{view.name}.png"
            path.parent.mkdir(exist_ok=True)
            write_png(path, mask)
            view = replace(view, mask=str(path))
        train.append(view)
    write_views(replace(views, train=train, diffuse="lambert"), part, copy)  # of Blender's own materials


def mask_of(camera: Camera, lamps: Sequence[Mesh]) -> Bytes | None:
    """A picture that is black where a lamp may be [h, w], whatever stands before it; None where none is.

    Args:
        camera: without distortion.
        lamps: whose triangles are in world space.
    """
    from PIL import Image, ImageDraw
    from trimesh.intersections import slice_faces_plane

    mask = Image.new("L", (camera.width, camera.height), 255)
    draw = ImageDraw.Draw(mask)
    for lamp in lamps:
        corners: Any = to_camera(camera, torch.from_numpy(lamp.vertices.astype(np.float64))).numpy()
        near = (0.0, 0.0, -_BEFORE * float(np.abs(corners).max()))
        ahead = 0.0, 0.0, -1.0
        places, faces, *_ = slice_faces_plane(corners, lamp.faces, ahead, near)  # type: ignore[no-untyped-call]
        film = project(camera, torch.tensor(places)).numpy().clip(-1e6, 1e6) - 0.5
        for triangle in film[faces]:
            points = [(x, y) for x, y in triangle.tolist()]
            draw.polygon(points, fill=0)
            draw.line([*points, points[0]], fill=0, width=_EDGE)
    kept = np.asarray(mask, np.uint8)
    return None if kept.all() else kept
