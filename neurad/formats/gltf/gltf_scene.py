"""A scene folder's ``scene.glb`` or ``scene.gltf``, with the environment map beside it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.scene_records import EnvironmentMap, View
from neurad.formats.gltf.read import read_gltf
from neurad.images.lat_long import read_map
from neurad.runtime.numbers import number
from neurad.runtime.reading import exists, shown
from neurad.scene.description import Scene

ENVIRONMENT = "environment.exr"
"""Map beside a scene file of glTF that lights it, +Y up."""
_UNLIMITED, _RR_DEPTH = 2**31 - 1, 5


def read_scene(path: str | Path) -> Scene:
    """The scene of a file, lit also by :data:`ENVIRONMENT` beside it; its cameras are held-out, without pictures."""
    path = Path(path)
    room = read_gltf(path)
    environment, to_world = None, room.own.get("environment_to_world")
    if exists(path.parent / ENVIRONMENT):
        pose = np.eye(4, dtype=np.float32)
        if to_world is not None:
            where = f"{shown(path)}: environment_to_world"
            if not isinstance(to_world, list) or len(to_world) != 9:
                raise InputError(f"{where} is not 9 numbers")
            pose[:3, :3] = np.reshape([number(x, where, -1.0 - 1e-6, 1.0 + 1e-6) for x in to_world], (3, 3))
        environment = EnvironmentMap(read_map(path.parent / ENVIRONMENT), pose)
    depths = [room.own.get(key, default) for key, default in (("max_depth", _UNLIMITED), ("rr_depth", _RR_DEPTH))]
    max_depth, rr_depth = (x if type(x) is int and 1 <= x <= _UNLIMITED else _UNLIMITED for x in depths)
    views = [View(camera.names[0], camera.seen(*camera.film)) for camera in room.cameras]
    limits: Any = {"max_depth": max_depth, "rr_depth": rr_depth}
    return Scene(
        path.stem,
        room.meshes,
        list(room.materials),
        environment,
        test=_named_apart(views),
        notes=room.notes,
        punctual=room.lights,
        **limits,
    )


def _named_apart(views: list[View]) -> list[View]:
    """Views whose names serve as those of files; numbers where they do not."""
    names = [view.name for view in views]
    if len(set(names)) == len(names) and all(name.isprintable() and not set(name) & set("/\\:") for name in names):
        return views
    return [replace(view, name=f"{index:04d}") for index, view in enumerate(views)]
