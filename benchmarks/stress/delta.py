"""Glass and mirrors: chains of delta surfaces, of bounded length."""

import time
from dataclasses import replace

import numpy as np
import torch

from benchmarks.stress.case import Case, Outcome
from benchmarks.stress.fit import Fit, Plan, photographs, resized
from benchmarks.stress.scenes import mean_difference, picture, small_cube, with_panel
from neurad.core.reflection import ConductorModel, DielectricModel
from neurad.core.scene_records import Constant, Material, Mesh
from neurad.integrators.delta import MAX_CHAIN
from neurad.scene.builtin.shapes import look_at, quad


def _behind_glass() -> Case:
    """A light behind two panes; the second reverses the refraction of the first."""

    def measure(quick: bool) -> Outcome:
        scene = small_cube(12)
        glazed = with_panel(scene, DielectricModel(), (-1.0, 0.9, -1.0), 2.0)
        lift = np.array([0.0, 0.01, 0.0], np.float32)
        pane = replace(glazed.meshes[-1], name="upper", vertices=glazed.meshes[-1].vertices + lift)
        glazed = replace(glazed, meshes=[*glazed.meshes[:-1], _oriented(glazed.meshes[-1], -1.0), _oriented(pane, 1.0)])
        view = replace(scene.train[0], camera=look_at((0.0, -0.5, 0.0), (0.0, -1.0, 0.01), 60.0, 12))
        spp = 4096 if quick else 16384
        found = picture(replace(glazed, train=[view], max_depth=2), spp)
        unglazed = picture(replace(scene, train=[view], max_depth=2), 256)
        ratio = float(found.mean() / unglazed.mean())
        # a pane of index 1.5 transmits 0.923 at normal incidence, less at the angles of this room
        return Outcome(max(0.0, ratio - 0.94) + max(0.0, 0.75 - ratio), 0.0, f"{ratio:.3f} of the light without glass")

    return Case("delta", "a light behind glass", "transmitted fraction: 0.75 to 0.94", measure)


def _oriented(mesh: Mesh, up: float) -> Mesh:
    """The pane with its normal up or down."""
    a, b, c = mesh.vertices[mesh.faces[0]]
    if np.cross(b - a, c - a)[1] * up < 0:
        return replace(mesh, faces=mesh.faces[:, ::-1].copy())
    return mesh


def _two_mirrors() -> Case:
    def measure(quick: bool) -> Outcome:
        scene = small_cube(12)
        mirror = Material(
            "mirror", ConductorModel(), Constant(np.ones(3, np.float32)), Constant(np.ones(1, np.float32))
        )
        left = quad((-0.9, -0.9, -0.9), (0.0, 1.5, 0.0), (0.0, 0.0, 1.8)).mesh("left", 2, smooth_shading=False)
        right = quad((0.9, -0.9, -0.9), (0.0, 1.5, 0.0), (0.0, 0.0, 1.8)).mesh("right", 2, smooth_shading=False)
        scene = replace(scene, meshes=[*scene.meshes, left, right], materials=[*scene.materials, mirror])
        view = replace(scene.train[0], camera=look_at((0.0, 0.0, 0.0), (1.0, 0.0, 0.001), 40.0, 12))
        begin = time.perf_counter()
        image = picture(replace(scene, train=[view]), 16)
        bad = float((~torch.isfinite(image)).sum())
        return Outcome(
            bad, 0.0, f"chains end after {MAX_CHAIN}; {time.perf_counter() - begin:.2f} s, mean {image.mean():.4f}"
        )

    return Case("delta", "a mirror facing a mirror", "finite, and it ends", measure)


def _mirror_floor() -> Case:
    """What a mirror shows is what a camera behind it would see."""

    def measure(quick: bool) -> Outcome:
        scene = small_cube(16)
        mirror = with_panel(scene, ConductorModel(), (-1.0, 0.0, -1.0), 2.0)
        down = look_at((0.1, 0.5, 0.1), (0.1, 0.0, 0.11), 40.0, 16)
        up = look_at((0.1, -0.5, 0.1), (0.1, 0.0, 0.11), 40.0, 16)
        cut = [m for m in scene.meshes]
        low = replace(mirror, train=[replace(scene.train[0], camera=down)], max_depth=1)
        high = replace(scene, meshes=cut, train=[replace(scene.train[0], camera=up)], max_depth=1)
        return Outcome(mean_difference(picture(low, 64), picture(high, 64)), 0.02, "emission seen, means")

    return Case("delta", "a perfect mirror", "the mirrored camera", measure)


def _fitted() -> Case:
    def measure(quick: bool) -> Outcome:
        scene = resized(with_panel(small_cube(12), ConductorModel(), (-0.5, -0.9, -0.5), 1.0), 12, 4)
        fit = Fit(scene, photographs(scene, 32), Plan(steps=60 if quick else 300)).run()
        error, mean = fit.albedo_error()
        return Outcome(error, 0.25, f"albedo found {mean:.3f}")

    return Case("delta", "a fit with a mirror in the room", "true albedo, RMS", measure)


def cases() -> list[Case]:
    """Glass, mirrors, and both at once."""
    return [_behind_glass(), _two_mirrors(), _mirror_floor(), _fitted()]
