"""Which meshes shine in a run that has to find them: those that photographs show, or those that it began with."""

from __future__ import annotations

from pathlib import Path

import torch

from neurad.assembly.find_lamps import Found, find_lamps
from neurad.assembly.settings import ModelSettings
from neurad.core.protocols import PhotoSource
from neurad.scene.description import Scene
from neurad.scene.shining import from_kept
from neurad.training.checkpoint_file import read_checkpoint


def shining_meshes(
    scene: Scene,
    photographs: PhotoSource,
    settings: ModelSettings,
    device: torch.device | str = "cpu",
    begins_from: Path | None = None,
) -> Found:
    """Find the lamps of a fit, or read them from the checkpoint that it goes on from.

    Args:
        scene: whose lamps are not known.
        photographs: of its training views; not looked at where there is a checkpoint.
        settings: of the model.
        device: where it is computed.
        begins_from: the checkpoint; None in a fit from scratch.

    Raises:
        InputError: nothing shines, or the checkpoint does not say what does.
    """
    if begins_from is None:
        unknown_sky = settings.lighting.environment == "fit"
        return find_lamps(scene, photographs, settings.tracer, unknown_sky, settings.seed, device)
    state = read_checkpoint(begins_from, f"--ckpt_path {begins_from}")["neurad"]
    return Found(from_kept(state.get("shining"), scene, "--ckpt_path"))
