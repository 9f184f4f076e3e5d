"""Whether a checkpoint belongs to what is being built."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from neurad.core.errors import InputError
from neurad.scene.description import Scene

DDP_IGNORED = "world.guide.", "average."
"""What names of state begin with that only takes noise away: no weights, and alike in all processes."""


def fitting(
    checkpoint: dict[str, Any],
    own: dict[str, Tensor],
    scene: Scene,
    inputs: list[str] | None,
    source: str = "--ckpt_path",
    continues: bool = False,
) -> dict[str, Any]:
    """What a run wrote about itself into its checkpoint, if the weights fit.

    A guide and averages only take noise away: where the checkpoint has none, or others, it is given the fresh ones of
    ``own``.

    Args:
        checkpoint: as Lightning loads it; its ``state_dict`` may be replaced.
        own: state of the module that is to take it over.
        scene: that the module is for.
        inputs: what the module's radiance field reads; None without one.
        source: begins the error messages.
        continues: a fit goes on from it: that checks its own numbers, and ``bad.ckpt`` is there to repeat what it
            found.

    Raises:
        InputError: it belongs to another scene or to fields of other sizes, it is none of neurad's, or its weights are
            no numbers.
    """
    state: dict[str, Any] | None = checkpoint.get("neurad")
    if state is None:
        raise InputError(f"{source}: the file is no checkpoint of neurad")
    if state["fingerprint"] != scene.fingerprint:
        renamed = state["scene"] == scene.name == "kitchen"
        hint = "; the built-in kitchen of older versions is now called patterns: --data.scene patterns" if renamed else ""
        raise InputError(f"{source}: the checkpoint is of scene {state['scene']}, not of {scene.name} as given{hint}")
    weights = checkpoint["state_dict"]
    for prefix in DDP_IGNORED:
        mine = {name: value for name, value in own.items() if name.startswith(prefix)}
        if {n: w.shape for n, w in weights.items() if n.startswith(prefix)} != {n: w.shape for n, w in mine.items()}:
            weights = {name: value for name, value in weights.items() if not name.startswith(prefix)} | mine
    checkpoint["state_dict"] = weights
    for name, value in weights.items():
        if name not in own or own[name].shape != value.shape:
            raise InputError(
                f"{source}: the checkpoint has other field sizes than the config ({name} differs); where "
                "grid.finest is null they follow the training views"
            )
        if own[name].is_floating_point() != value.is_floating_point():
            raise InputError(f"{source}: {name} of the checkpoint is of another type ({value.dtype})")
        if not continues and value.is_floating_point() and not torch.isfinite(value).all():
            raise InputError(f"{source}: {name} of the checkpoint has values that are NaN or infinite")
    if missing := own.keys() - weights.keys():
        raise InputError(f"{source}: the checkpoint has other fields than the config ({min(missing)} is missing)")
    if state.get("radiance_inputs", inputs) != inputs:  # of the same size they would load, and mean something else
        raise InputError(
            f"{source}: the checkpoint's radiance field reads {state['radiance_inputs']}, that of the config "
            f"{inputs}; set model.radiance.inputs"
        )
    return state
