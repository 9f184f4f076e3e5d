"""Whether a checkpoint belongs to what is being built."""

from typing import Any

import torch
from torch import Tensor

from neurad.assembly.lighting import lamps_of_scene
from neurad.core.errors import InputError
from neurad.emitters.fitted_lamps import PER_LAMP
from neurad.runtime.progress import say
from neurad.scene.description import Scene
from neurad.scene.light import light_changes, light_of

FOCUS = "focus."
DEVELOPMENT = "development."
FLASH = "world.flash."
"""Prefixes of state that belongs to the photographs of the fit: with others its result can be looked at without it."""
HIERARCHY = "materials.fields.roughness.hierarchy."
"""Prefix of what a roughness refinement has found; a fit that has none yet makes it later."""
_OF_LIGHTS = "tabulated", "scale_seen"
"""Names by which the state of a recovered environment and of recovered lamps is known."""
_OF_ANY_SIZE = f"{HIERARCHY}keys", f"{HIERARCHY}values"
DDP_IGNORED = "world.guide.", "average.", FOCUS
"""Prefixes of state that only takes noise away: no weights, and alike in all processes."""
_WITHOUT = {
    FOCUS: "the checkpoint does not say which pixels tell of roughness (model.sampling.focus); the run finds out anew",
    HIERARCHY: "the checkpoint is of a fit without roughness refinement (model.roughness.structure); this one has it",
}


def fitting(
    checkpoint: dict[str, Any],
    own: dict[str, Tensor],
    scene: Scene,
    inputs: list[str] | None,
    source: str = "--ckpt_path",
    continues: bool = False,
    other_light: bool = True,
) -> dict[str, Any]:
    """What a run wrote about itself into its checkpoint, if the weights fit.

    A guide, averages and scores of pixels only take noise away: where the checkpoint has none, or others, it is given
    the fresh ones of ``own``.

    Args:
        checkpoint: as :func:`neurad.checkpoints.file.read_checkpoint` reads it; its ``state_dict`` may be replaced.
        inputs: what the module's radiance field reads; None without one.
        continues: a fit goes on from it: that checks its own numbers, and ``bad.ckpt`` is there to repeat what it
            found; its light must be that of the scene.
        other_light: whether the light of the scene may be another than in the fit, see :func:`changed_light`.

    Raises:
        InputError: it belongs to another scene or to fields of other sizes, or its weights are no numbers.
    """
    state: dict[str, Any] = checkpoint["neurad"]
    light = _kept_light(state, source)
    if state["geometry"] != scene.geometry_fingerprint:
        raise InputError(f"{source}: the checkpoint is of scene {state['scene']}, not of {scene.name} as given")
    if (continues or not other_light) and (changes := light_changes(light, scene)):
        raise InputError(
            f"{source}: the light of scene {scene.name} is not that of the fit ({'; '.join(changes)}); put it back, or "
            "start a new run"
        )
    weights = checkpoint["state_dict"]
    if not continues:
        weights = _lamps_by_mesh(_lights_of_scene(weights, own), own, state, scene)
    for prefix in (*DDP_IGNORED, HIERARCHY) if continues else (*DDP_IGNORED, HIERARCHY, DEVELOPMENT, FLASH):
        mine = {name: value for name, value in own.items() if name.startswith(prefix)}
        theirs = {name: value for name, value in weights.items() if name.startswith(prefix)}
        if prefix == HIERARCHY and theirs.get(f"{HIERARCHY}made", 0):  # nothing found is dropped
            if not mine:
                raise InputError(f"{source}: its roughness has been refined; set model.roughness.structure auto")
            continue
        if {name: value.shape for name, value in mine.items()} == {name: value.shape for name, value in theirs.items()}:
            continue
        if prefix in _WITHOUT and mine and continues:
            say(f"{source}: {_WITHOUT[prefix]}")
        weights = {name: value for name, value in weights.items() if name not in theirs} | mine
    checkpoint["state_dict"] = weights
    for name, value in weights.items():
        if name not in own or (own[name].shape != value.shape and name not in _OF_ANY_SIZE):
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
    reads = state.get("radiance_inputs")
    if reads != inputs:  # of the same size they would load, and mean something else
        raise InputError(
            f"{source}: the checkpoint's radiance field reads {reads}, that of the config {inputs}; set "
            "model.radiance.inputs"
        )
    return state


def scene_state(scene: Scene) -> dict[str, Any]:
    """What a checkpoint keeps of the scene of its fit."""
    return {"scene": scene.name, "geometry": scene.geometry_fingerprint, "light": light_of(scene)}


def check_photographs(before: int, now: int) -> None:
    """Refuse other photographs than a fit began with, by their checksums: that kept, 0 where none was, and that now."""
    if before not in (0, now):
        raise InputError(
            "--ckpt_path: the training photographs are not those that the run began with; put them back, or start a "
            "new run"
        )


def changed_light(state: dict[str, Any], scene: Scene, environment: bool = True, lamps: bool = True) -> list[str]:
    """What differs between the light of a fit and a scene's, as :func:`neurad.scene.light.light_changes` says."""
    return light_changes(_kept_light(state, "--ckpt_path"), scene, environment, lamps)


def _lights_of_scene(weights: dict[str, Any], own: dict[str, Tensor]) -> dict[str, Any]:
    """Weights without those of recovered lights that ``own`` lacks, and those of others by their names there, which say
    what other kinds of light there are.
    """
    found = dict(weights)
    for mark in _OF_LIGHTS:
        theirs, mine = (
            next((name.removesuffix(mark) for name in state if name.endswith(f".{mark}")), None)
            for state in (weights, own)
        )
        if theirs is not None and theirs != mine:
            names = [name for name in weights if name.startswith(theirs)]
            moved = {} if mine is None else {mine + name.removeprefix(theirs): weights[name] for name in names}
            found = {name: value for name, value in found.items() if name not in names} | moved
    return found


def _lamps_by_mesh(weights: dict[str, Any], own: dict[str, Any], state: dict[str, Any], scene: Scene) -> dict[str, Any]:
    """Weights in which what belongs to lamps is that of the lamps of ``scene``: of those that did not shine in the fit
    it stays as in ``own``.
    """
    lights = [name.removesuffix("scale_seen") for name in own if name.endswith(".scale_seen")]
    if not lights:
        return weights
    before, now = sorted(fitted_lamps(state)), lamps_of_scene(scene)
    if before == now:
        return weights
    found = dict(weights)
    for name in (part + tensor for part in lights for tensor in PER_LAMP):
        if name in weights and len(weights[name]) == len(before):
            found[name] = own[name].clone()
            for row, mesh in enumerate(now):
                if mesh in before:
                    found[name][row] = weights[name][before.index(mesh)]
    return found


def fitted_lamps(state: dict[str, Any]) -> frozenset[int]:
    """Meshes that shone in a fit."""
    return frozenset(lamp[0] for lamp in _kept_light(state, "--ckpt_path")["lamps"])


def _kept_light(state: dict[str, Any], source: str) -> dict[str, Any]:
    light: dict[str, Any] = state["light"]
    try:
        lamps, sky = light["lamps"], light["environment"]
        whole = all(isinstance(i, int) and isinstance(name, str) and len(rgb) == 3 for i, name, *rgb in lamps)
        numbers = [x for lamp in lamps for x in lamp[2:]]
        for index, name, kind, *rest in light["punctual"]:
            whole &= isinstance(index, int) and isinstance(name, str) and isinstance(kind, str) and len(rest) == 11
            numbers += rest
        if sky is not None:
            whole &= isinstance(sky["pixels"], str) and (len(sky["mean"]), len(sky["to_world"])) == (3, 16)
            numbers += [*sky["mean"], *sky["to_world"]]
        whole &= all(isinstance(x, float) for x in numbers)
    except (KeyError, TypeError, ValueError):
        whole = False
    if not whole:
        raise InputError(f"{source}: the checkpoint's light is none that a run writes")
    return light
