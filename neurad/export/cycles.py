"""Cycles on ``scene.glb``, in a Python or a Blender of its own: neither is ever imported here."""

from __future__ import annotations

import json
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

from neurad.core.errors import InputError
from neurad.core.records import FloatArray, View
from neurad.export.blender import render_views_path
from neurad.runtime.machine import usable_cores
from neurad.scene.image_io import read_exr

_ASK = "import bpy; print('bpy', bpy.app.version_string)"


@dataclass(frozen=True)
class Blender:
    """How to start a program in Blender's Python."""

    command: list[str]
    """What stands before the program's path."""
    version: str

    def render(self, folder: Path, views: list[View], samples: int, seed: int) -> list[FloatArray]:
        """Views of an exported folder [h, w, 3], linear, premultiplied by alpha.

        Args:
            folder: of the room.
            views: which, of one size.
            samples: per pixel.
            seed: of its random numbers.

        Raises:
            InputError: Blender ended without the pictures.
        """
        with tempfile.TemporaryDirectory() as out:
            job = Path(out) / "job.json"
            camera = views[0].camera
            described = {
                "folder": str(folder), "views": [v.name for v in views], "width": camera.width,
                "height": camera.height, "samples": samples, "seed": seed, "threads": usable_cores(), "out": out,
            }  # fmt: skip
            job.write_text(json.dumps(described), encoding="utf-8")
            ended = subprocess.run(
                [*self.command, str(render_views_path()), "--", str(job)], capture_output=True, text=True, check=False
            )
            files = [Path(out) / f"{view.name}.exr" for view in views]
            if not all(file.is_file() for file in files):
                said = (ended.stderr or ended.stdout).strip().splitlines()
                raise InputError(f"--blender: it rendered nothing of {folder} ({said[-1] if said else 'no message'})")
            return [read_exr(file)[..., :3] for file in files]


def find_blender(program: str) -> Blender:
    """What ``--blender`` names.

    Args:
        program: a Python that can import bpy, or Blender itself.

    Raises:
        InputError: it is neither.
    """
    python = _said([program, "-c", _ASK])
    if python.startswith("bpy "):
        return Blender([program], python.removeprefix("bpy "))
    blender = _said([program, "--version"])
    if blender.startswith("Blender "):
        return Blender([program, "--background", "--factory-startup", "--python"], blender.removeprefix("Blender "))
    raise InputError(f"--blender: {program} is neither a Python with the package bpy nor Blender")


def _said(command: list[str]) -> str:
    """The last line of a program that begins with a known word; empty if it cannot be started or fails."""
    try:
        ended = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=120, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    lines = [line for line in ended.stdout.splitlines() if line.startswith(("bpy ", "Blender "))]
    return lines[0].strip() if lines and ended.returncode == 0 else ""
