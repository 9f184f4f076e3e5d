"""The scene with the lamps and poses of a fit: those of its file, those that photographs ask for, or those that a run
began with.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neurad.assembly.build import build_world
from neurad.assembly.lighting import check_known_beside_flash, lit_scene
from neurad.assembly.model_settings import ModelSettings
from neurad.checkpoints.file import read_checkpoint
from neurad.core.errors import InputError
from neurad.core.protocols import PhotoSource
from neurad.core.records import Float64Array
from neurad.core.scene_records import Camera
from neurad.emitters.lights import NullEmitter
from neurad.lamps.find import Found, find_lamps
from neurad.scene.description import Scene
from neurad.scene.hints import PlaceHint
from neurad.scene.shining import Shining, shining_from_state

Poses = list[list[float]]
"""Of each training view its camera-to-world matrix, row by row, its field of view and its lens's k1 and so on."""


@dataclass(frozen=True)
class PreparedScene:
    """The scene of a fit, and what it has of photographs or of a checkpoint."""

    scene: Scene
    shining: list[Shining] | None
    """What shines; None where the scene says it."""
    poses: Poses | None
    """Refined poses of the training views; None where they are those of the scene's file."""
    said_of_lamps: list[str]
    said_of_poses: list[str]


def prepare_scene(
    scene: Scene,
    photographs: PhotoSource,
    settings: ModelSettings,
    device: torch.device | str = "cpu",
    begins_from: Path | None = None,
) -> PreparedScene:
    """Refine poses and find lamps, as far as the settings ask for it; held-out cameras and true maps stay as they are.

    Poses come first: what a photograph shows half a pixel beside a lamp, darkens that lamp.

    Args:
        photographs: of its training views; not looked at where both are known or where there is a checkpoint.
        begins_from: the checkpoint that the fit goes on from; None in a fit from scratch.

    Raises:
        InputError: nothing shines, the checkpoint does not say what does or has no refined poses, or those of other
            views, or a lamp falls into too many parts.
    """
    refines = scene.photography.poses != "fixed" and photographs.has_photographs
    finds = settings.lighting.emitters == "find"
    shining, poses, said_of_lamps, said_of_poses = None, None, list[str](), list[str]()
    if begins_from is not None and (refines or finds):
        state, source = read_checkpoint(begins_from, f"--ckpt_path {begins_from}")["neurad"], "--ckpt_path"
        if refines:
            poses = state.get("poses")
            scene = with_poses(scene, poses, source)
        if finds:
            shining = shining_from_state(state.get("shining"), scene, source)
    else:
        if refines:
            scene, poses, said_of_poses = refined_poses(scene, photographs, settings.tracer, settings.seed, device)
        if finds:
            lamps = _found_lamps(scene, photographs, settings, device)
            shining, said_of_lamps = lamps.lamps, lamps.lines
    return PreparedScene(lit_scene(scene, settings.lighting, shining), shining, poses, said_of_lamps, said_of_poses)


def refined_poses(
    scene: Scene, photographs: PhotoSource, tracer: str, seed: int, device: torch.device | str = "cpu"
) -> tuple[Scene, Poses, list[str]]:
    """The scene with the poses that the photographs of its training views ask for, these poses, and what was done."""
    from neurad.evidence.pose_fit import fit_poses  # imported where it is needed: scipy loads slowly

    world = build_world(scene, tracer, photographs.has_alpha, lights=NullEmitter()).to(device)
    refined = fit_poses(world, [view.camera for view in scene.train], photographs, seed)
    poses = poses_of(refined.cameras)
    return with_poses(scene, poses, "--data.poses"), poses, refined.sentences([view.name for view in scene.train])


def _found_lamps(scene: Scene, photographs: PhotoSource, settings: ModelSettings, device: torch.device | str) -> Found:
    lighting = settings.lighting
    check_known_beside_flash(scene, lighting)
    hints = [PlaceHint("model.lighting.lamps", tuple(place)) for place in lighting.lamps or []]
    hints += scene.hints.shines
    return find_lamps(
        scene, photographs, settings.tracer, lighting.environment == "fit", settings.seed, device, hints,
        bool(scene.hints.shines),
    )  # fmt: skip


def poses_of(cameras: Sequence[Camera]) -> Poses:
    """What a checkpoint keeps of cameras."""
    return [
        [*np.asarray(camera.to_world, np.float64).ravel().tolist(), camera.fov_x, *camera.lens.numerator]
        for camera in cameras
    ]


def with_poses(scene: Scene, poses: Any, source: str) -> Scene:
    """The scene with other poses of its training views, as :func:`poses_of` gave them.

    Raises:
        InputError: they are none, or of another number of views.
    """
    try:
        rows: Any = [np.asarray(row, np.float64) for row in poses]
        cameras = [_posed(view.camera, row) for view, row in zip(scene.train, rows, strict=True)]
    except (TypeError, ValueError):
        raise InputError(
            f"{source}: it has no refined poses of {len(scene.train)} views; start a new run, or set --data.poses fixed"
        ) from None
    return replace(scene, train=[replace(v, camera=camera) for v, camera in zip(scene.train, cameras, strict=True)])


def _posed(camera: Camera, row: Float64Array) -> Camera:
    """A camera with the pose and lens of its row."""
    pose: Any = row[:16].reshape(4, 4)
    fov_x, *numerator = row[16:].tolist()
    return replace(camera, to_world=pose, fov_x=fov_x, lens=replace(camera.lens, numerator=tuple(numerator)))
