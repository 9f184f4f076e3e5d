"""Mitsuba 3 beside neurad: whether it is there, its cameras, and what it cannot hide."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.scene_records import Camera
from neurad.formats.cameras.write import clip_planes
from neurad.formats.mitsuba.write import Matrix, Node
from neurad.runtime.machine import usable_cores
from neurad.scene.description import Scene

COMPILED, SCALAR = "llvm_ad_rgb", "scalar_rgb"
"""The variant that compiles its kernels for the CPU, and the one that needs no compiler."""
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
def mitsuba_as(variant: str) -> Iterator[Any]:
    """The package with a variant set; the one that was set before is set again afterwards, :data:`SCALAR` where none
    was.
    """
    import mitsuba as mi

    before = mi.variant()
    try:
        mi.set_variant(variant)
        yield mi
    finally:
        mi.set_variant(before or SCALAR)


def fastest() -> str:
    """The fastest variant for CPUs: :data:`SCALAR`, a fifth as fast as :data:`COMPILED`, without a fitting LLVM."""
    return COMPILED if no_llvm() is None else SCALAR


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
