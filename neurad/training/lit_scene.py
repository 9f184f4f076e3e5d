"""The scene with the lamps of a fit: those of its file, those that photographs show, or those that a run began with."""

from dataclasses import dataclass
from pathlib import Path

import torch

from neurad.assembly.lighting import check_known_beside_flash, lit_scene
from neurad.assembly.model_settings import ModelSettings
from neurad.checkpoints.file import read_checkpoint
from neurad.core.protocols import PhotoSource
from neurad.lamps.find import Found, find_lamps
from neurad.scene.description import Scene
from neurad.scene.hints import PlaceHint
from neurad.scene.shining import Shining, shining_from_state


@dataclass(frozen=True)
class LitScene:
    """A scene whose meshes shine that do in the fit."""

    scene: Scene
    found: list[Shining] | None = None
    """Meshes that photographs show to shine; None where the scene says it."""
    lines: tuple[str, ...] = ()
    """What is to be said of them."""


def light_scene(
    scene: Scene,
    photographs: PhotoSource,
    settings: ModelSettings,
    device: torch.device | str = "cpu",
    begins_from: Path | None = None,
) -> LitScene:
    """The scene with the lamps of a fit; where they are to be found, by its photographs or by a checkpoint.

    Args:
        photographs: of its training views; not looked at where lamps are known or where there is a checkpoint.
        device: where it is computed.
        begins_from: the checkpoint that the fit goes on from; None in a fit from scratch.

    Raises:
        InputError: nothing shines, the checkpoint does not say what does, or a lamp falls into too many parts.
    """
    if settings.lighting.emitters != "find":
        return LitScene(lit_scene(scene, settings.lighting, None))
    if begins_from is None:
        check_known_beside_flash(scene, settings.lighting)
        unknown_sky = settings.lighting.environment == "fit"
        hints = [PlaceHint("model.lighting.lamps", tuple(place)) for place in settings.lighting.lamps or []]
        hints += scene.hints.shines
        declared = bool(scene.hints.shines)
        found = find_lamps(scene, photographs, settings.tracer, unknown_sky, settings.seed, device, hints, declared)
    else:
        state = read_checkpoint(begins_from, f"--ckpt_path {begins_from}")["neurad"]
        found = Found(shining_from_state(state.get("shining"), scene, "--ckpt_path"))
    return LitScene(lit_scene(scene, settings.lighting, found.lamps), found.lamps, tuple(found.lines))
