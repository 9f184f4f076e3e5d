"""The scene with the lamps and poses of a fit: those of its file, those that photographs ask for, or those that a run
began with.
"""

from collections.abc import Sequence
from dataclasses import replace
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
from neurad.core.scene_records import Camera
from neurad.emitters.lights import NullEmitter
from neurad.lamps.find import find_lamps
from neurad.scene.description import Scene
from neurad.scene.hints import PlaceHint
from neurad.scene.shining import Shining, shining_from_state

Poses = list[list[float]]
"""Camera-to-world matrices of the training views, row by row [views, 16]."""


def light_scene(
    scene: Scene,
    photographs: PhotoSource,
    settings: ModelSettings,
    device: torch.device | str = "cpu",
    begins_from: Path | None = None,
) -> tuple[Scene, list[Shining] | None, list[str]]:
    """The scene whose meshes shine that do in the fit; those that its photographs or a checkpoint show to shine, None
    where the scene says it; and what is to be said of them.

    Args:
        photographs: of its training views; not looked at where lamps are known or where there is a checkpoint.
        begins_from: the checkpoint that the fit goes on from; None in a fit from scratch.

    Raises:
        InputError: nothing shines, the checkpoint does not say what does, or a lamp falls into too many parts.
    """
    lighting = settings.lighting
    if lighting.emitters != "find":
        return lit_scene(scene, lighting, None), None, []
    if begins_from is None:
        check_known_beside_flash(scene, lighting)
        hints = [PlaceHint("model.lighting.lamps", tuple(place)) for place in lighting.lamps or []]
        hints += scene.hints.shines
        found = find_lamps(
            scene, photographs, settings.tracer, lighting.environment == "fit", settings.seed, device, hints,
            bool(scene.hints.shines),
        )  # fmt: skip
        lamps, lines = found.lamps, found.lines
    else:
        state = read_checkpoint(begins_from, f"--ckpt_path {begins_from}")["neurad"]
        lamps, lines = shining_from_state(state.get("shining"), scene, "--ckpt_path"), []
    return lit_scene(scene, lighting, lamps), lamps, lines


def pose_scene(
    scene: Scene,
    photographs: PhotoSource,
    settings: ModelSettings,
    device: torch.device | str = "cpu",
    begins_from: Path | None = None,
) -> tuple[Scene, Poses | None, list[str]]:
    """The scene with the poses of a fit, where they are refined by its photographs or by a checkpoint; these poses, or
    None where they are those of the scene's file; and what is to be said of them.

    Held-out cameras, and true maps, stay as they are. The arguments are those of :func:`light_scene`.

    Raises:
        InputError: the checkpoint has no refined poses, or those of other views.
    """
    if scene.photography.poses == "fixed" or not photographs.has_photographs:
        return scene, None, []
    if begins_from is not None:
        poses = read_checkpoint(begins_from, f"--ckpt_path {begins_from}")["neurad"].get("poses")
        return with_poses(scene, poses, "--ckpt_path"), poses, []
    from neurad.evidence.pose_fit import fit_poses  # imported where it is needed: scipy loads slowly

    world = build_world(scene, settings.tracer, photographs.has_alpha, lights=NullEmitter()).to(device)
    found = fit_poses(world, [view.camera for view in scene.train], photographs, settings.seed)
    poses = poses_of(found.cameras)
    lines = found.sentences([view.name for view in scene.train])
    return with_poses(scene, poses, "--data.poses"), poses, lines


def poses_of(cameras: Sequence[Camera]) -> Poses:
    """What a checkpoint keeps of cameras."""
    return [[float(x) for x in np.asarray(camera.to_world, np.float64).ravel()] for camera in cameras]


def with_poses(scene: Scene, poses: Any, source: str) -> Scene:
    """The scene with other poses of its training views, as :func:`poses_of` gave them.

    Raises:
        InputError: they are none, or of another number of views.
    """
    try:
        matrices: Any = np.asarray(poses, np.float64).reshape(len(scene.train), 4, 4)
    except (TypeError, ValueError):
        raise InputError(
            f"{source}: it has no refined poses of {len(scene.train)} views; start a new run, or set --data.poses fixed"
        ) from None
    train = [
        replace(view, camera=replace(view.camera, to_world=pose))
        for view, pose in zip(scene.train, matrices, strict=True)
    ]
    return replace(scene, train=train)
