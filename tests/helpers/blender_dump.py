"""What Blender's side of ``neurad data blender`` writes, without Blender; and programs that pass for Blender."""

import copy
import json
import os
from pathlib import Path

import numpy as np

EYE = np.eye(4).tolist()
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
TWO = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
GREY = {"name": "grey", "shader": "BSDF_PRINCIPLED", "color": [0.4, 0.3, 0.2], "roughness": 0.6, "metallic": 0.0,
        "ior": 1.5, "alpha": 1.0, "transmission": 0.0, "specular": 0.5, "strength": 0.0}  # fmt: skip
AREA = {"type": "AREA", "name": "Area", "shape": "RECTANGLE", "size": 1.0, "size_y": 0.5, "spread": 3.1415927,
        "watts": [60.0, 50.0, 40.0], "unread": "", "to_world": EYE, "normalize": True, "unseen_by": ["camera"],
        "shadow": True}  # fmt: skip
CAMERA = {"type": "PERSP", "lens": 36.0, "sensor_width": 36.0, "sensor_height": 24.0, "sensor_fit": "AUTO",
          "shift_x": 0.0, "shift_y": 0.0, "to_world": EYE, "names": ["Camera"]}  # fmt: skip


def moved(x, y, z, turn=None):
    """A transform of a turn and a step."""
    made = np.eye(4) if turn is None else np.asarray(turn, np.float64).copy()
    made[:3, 3] = x, y, z
    return made.tolist()


def square(name="floor", **other):
    """An object: a square of two triangles, side 2."""
    return {"name": name, "mesh": "square.npz", "flat": True, "uvs": {"": "uv0", "Map": "uv0"}, "materials": [0],
            "to_world": EYE, "unseen_by": [], "special": [], **other}  # fmt: skip


def lamp(kind="AREA", **other):
    """A lamp above the floor, or a point, spot or sun."""
    own = {"shadow_soft_size": 0.0, "angle": 0.01, "spot_size": 1.2, "spot_blend": 0.15}
    return {**copy.deepcopy(AREA), **own, "type": kind, "to_world": moved(0, 0, 2), **other}


def room(**other):
    """A floor, a lamp and a camera that looks straight down from the height 3."""
    return {
        "neurad_blender": 1, "blender": "4.5.0", "scene": "Scene", "frame": 1, "film": [12, 9],
        "pixel_aspect": [1.0, 1.0], "objects": [square()], "lamps": [lamp()], "materials": [copy.deepcopy(GREY)],
        "world": None, "cameras": [{**CAMERA, "to_world": moved(0, 0, 3)}], "left_out": {}, "notes": [],
        "cycles": {"diffuse_bounces": 16, "max_bounces": 16, "film_exposure": 1.0}, **other,
    }  # fmt: skip


def write_dump(folder, described=None, **arrays):
    """A folder as ``write_room.py`` writes it."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    uv = (SQUARE[TWO][..., :2] + 1.0) / 2.0
    mesh = {"vertices": SQUARE, "faces": TWO, "material": np.zeros(2, np.int32), "uv0": uv.astype(np.float32)}
    np.savez(folder / "square.npz", **{**mesh, **arrays})
    (folder / "blender.json").write_text(json.dumps(room() if described is None else described))
    return folder


def write_blender(path, dump, version="4.5.0", python=True, said=""):
    """A program that passes for Blender, or for a Python with bpy, and writes what is in ``dump``; None writes nothing
    and fails as Blender does.
    """
    path = Path(path)
    says = f"bpy {version}" if python else f"Blender {version} LTS"
    asked = "-c" if python else "--version"
    act = f'cp "{Path(dump).resolve()}"/* "$out"/' if dump else f'echo "{said}" >&2'
    path.write_text(
        f'#!/bin/sh\nif [ "$1" = {asked} ]; then echo "{says}"; exit 0; fi\n'
        'if [ "$1" = -c ] || [ "$1" = --version ]; then exit 1; fi\n'
        f'while [ "$1" != -- ]; do shift; done\nout="$2"\n[ -f "$3" ] || exit 1\n{act}\n'
    )
    os.chmod(path, 0o755)
    return path
