"""The scene with the poses of a fit: those of its file, or those that photographs or a run's beginning ask for."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neurad.assembly.build import build_world
from neurad.checkpoints.file import read_checkpoint
from neurad.core.errors import InputError
from neurad.core.protocols import PhotoSource
from neurad.core.scene_records import Camera
from neurad.emitters.lights import NullEmitter
from neurad.scene.description import Scene

Poses = list[list[float]]
"""Camera-to-world matrices of the training views, row by row [views, 16]."""


def pose_scene(
    scene: Scene,
    photographs: PhotoSource,
    seed: int,
    tracer: str = "embree",
    device: torch.device | str = "cpu",
    begins_from: Path | None = None,
) -> tuple[Scene, Poses | None, list[str]]:
    """The scene with the poses of a fit, where they are refined by its photographs or by a checkpoint; these poses, or
    None where they are those of the scene's file; and what is to be said of them.

    Held-out cameras, and true maps, stay as they are.

    Args:
        photographs: of its training views; not looked at where poses are fixed or where there is a checkpoint.
        device: where it is computed.
        begins_from: the checkpoint that the fit goes on from, or that is looked at; None in a fit from scratch.

    Raises:
        InputError: the checkpoint has no refined poses, or those of other views.
    """
    if scene.photography.poses == "fixed" or not photographs.has_photographs:
        return scene, None, []
    if begins_from is not None:
        state = read_checkpoint(begins_from, f"--ckpt_path {begins_from}")["neurad"]
        poses = state.get("poses")
        return with_poses(scene, poses, "--ckpt_path"), poses, []
    from neurad.evidence.pose_fit import fit_poses  # imported where it is needed: scipy loads slowly

    world = build_world(scene, tracer, photographs.has_alpha, lights=NullEmitter()).to(device)
    found = fit_poses(world, [view.camera for view in scene.train], photographs, seed)
    poses = poses_of(found.cameras)
    lines = found.sentences([view.name for view in scene.train])
    return with_poses(scene, poses, "--data.poses"), poses, lines


def poses_of(cameras: Sequence[Camera]) -> Poses:
    """What a checkpoint keeps of cameras."""
    return [[float(x) for x in np.asarray(camera.to_world, np.float64).ravel()] for camera in cameras]


def with_poses(scene: Scene, poses: Any, source: str) -> Scene:
    """The scene with other poses of its training views.

    Args:
        poses: what :func:`poses_of` gave.

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
