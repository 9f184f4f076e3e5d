"""Scenes for Mitsuba 3 without a file: cameras, and what benchmarks and tests load."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Camera, Material, View
from neurad.formats.cameras.write import clip_planes
from neurad.formats.mitsuba.write import ORIGIN, Matrix, Node, describe
from neurad.runtime.machine import usable_cores
from neurad.scene.description import Scene

COMPILED = "llvm_ad_rgb"
"""The variant that compiles its kernels for the CPU."""
LLVM = 17, 0, 0
"""Oldest version that Mitsuba is given: 16 takes the process down with it (3.9.1)."""


def no_mitsuba() -> str | None:
    """Why Mitsuba cannot render an exported folder here; None where it can."""
    if find_spec("mitsuba") is None:
        return "the package mitsuba is missing (pip install 'neurad[mitsuba]')"
    if usable_cores() == 1:  # IlmThread's pool has no thread then (3.9.1), and its reader waits for one
        return "it waits forever for EXR files where it has a single core"
    return None


@contextmanager
def fastest_mitsuba() -> Iterator[Any]:
    """The package with the fastest of its variants for CPUs set, :data:`COMPILED` where it finds a fitting LLVM and
    ``scalar_rgb`` otherwise, at a fifth of the speed. The variant that was set before is set again afterwards,
    ``scalar_rgb`` where none was.
    """
    import mitsuba as mi

    before = mi.variant()
    try:
        mi.set_variant(COMPILED if no_llvm() is None else "scalar_rgb")
        yield mi
    finally:
        mi.set_variant(before or "scalar_rgb")


def no_llvm() -> str | None:
    """Why :data:`COMPILED` cannot run here; None where it can, and then it has a thread for each usable core."""
    import drjit as dr

    if dr.detail.llvm_version() < LLVM:
        return f"it finds no LLVM of version {LLVM[0]} or newer"
    try:
        dr.set_thread_count(usable_cores())
        dr.eval(dr.llvm.Float(0.0) + dr.opaque(dr.llvm.Float, 1.0))
    except (RuntimeError, ValueError) as error:
        return " ".join(str(error).split()).rstrip(".")
    return None


NOT_ALONE = "Mitsuba hides lamps that are seen together with the environment"


def hides_alone(scene: Scene) -> bool:
    """Whether Mitsuba's ``hide_emitters`` hides the environment and nothing else: it leaves out lamps as well."""
    return scene.environment is not None and not scene.features.has_area_lights


def cannot_hide(scene: Scene, hide_environment: bool) -> bool:
    """Whether photographs leave out an environment that Mitsuba shows, see :data:`NOT_ALONE`."""
    return hide_environment and scene.environment is not None and not hides_alone(scene)


def sensor(scene: Scene, camera: Camera, width: int, height: int, samples: int = 16, alpha: bool = False) -> Node:
    """A camera with a box filter that sees all of a scene; ``width`` and ``height`` are those of its film in pixels.

    Raises:
        InputError: the camera distorts, or its pixels are not square.
    """
    near, far = clip_planes(scene, camera)
    lens = camera.lens
    if lens.bends or lens.aspect != 1.0:
        raise InputError("Mitsuba's cameras have no lens distortion and square pixels only")
    # Mitsuba's camera looks along +Z with +X to the left, ours along -Z with +X to the right
    pose = np.asarray(camera.to_world, np.float64) @ np.diag([-1.0, 1.0, -1.0, 1.0])
    return {
        "type": "perspective",
        "to_world": Matrix(pose.astype(np.float32), any(scene.origin)),
        "fov": float(np.degrees(camera.fov_x)),
        "fov_axis": "x",
        "principal_point_offset_x": 0.5 - lens.centre[0],
        "principal_point_offset_y": 0.5 - lens.centre[1],
        "near_clip": near,
        "far_clip": far,
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "rfilter": {"type": "box"},
            "component_format": "float32",
            "pixel_format": "rgba" if alpha else "rgb",
        },
        "sampler": {"type": "independent", "sample_count": samples},
    }


def to_mitsuba(
    scene: Scene,
    view: View,
    size: int,
    samples: int = 16,
    integrator: Node | None = None,
    shading: Callable[[Material], Any] | None = None,
) -> Any:
    """``scene`` seen by ``view`` at ``size`` x ``size`` pixels with a box filter. A variant must have been set.

    Args:
        scene: what to build.
        view: the only sensor.
        size: width and height of its film in pixels.
        samples: per pixel.
        integrator: defaults to ``path`` with the scene's ``max_depth`` and ``rr_depth``.
        shading: the Mitsuba BSDF that stands for a material that is not a delta one; None keeps the scene's own.
    """
    import mitsuba as mi

    with tempfile.TemporaryDirectory() as folder:
        camera = sensor(scene, view.camera, size, size, samples)
        tree = describe(scene, Path(folder), [camera], integrator, half=False, shading=shading)
        return mi.load_dict(_loadable(mi, tree, Path(folder)))


def _loadable(mi: Any, node: Any, folder: Path) -> Any:
    """A tree as ``mitsuba.load_dict`` takes it."""
    if isinstance(node, Matrix):
        square = np.asarray(node.values)
        return mi.ScalarTransform4f(square) if len(square) == 4 else mi.ScalarTransform3f(square)
    if not isinstance(node, dict):
        return node
    made = {key: _loadable(mi, value, folder) for key, value in node.items() if key not in ORIGIN}
    if "filename" in made:
        made["filename"] = str(folder / made["filename"])
    return made
