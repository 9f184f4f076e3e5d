"""The light of a scene as a checkpoint keeps it, and how the light of another scene differs."""

import hashlib
from typing import Any

import numpy as np

from neurad.core.scene_records import EnvironmentMap, PunctualLight
from neurad.scene.description import Scene

SAME = 1e-6
"""Largest relative difference of a radiance that is no difference: what another way to write it leaves."""


def light_of(scene: Scene) -> dict[str, Any]:
    """The light of a scene in plain types: ``lamps`` has the number of a mesh, its name and its radiance,
    ``environment`` a hash of its pixels, their mean and its pose, or is None, and ``punctual`` of lights without extent
    their number, name, kind, intensity, position, direction and angles. A light that moves with the camera is one of
    these, as the first photograph with a flash has it, with the number -1.
    """
    lamps = [
        [i, mesh.name, *(float(x) for x in mesh.radiance)]
        for i, mesh in enumerate(scene.meshes)
        if mesh.radiance is not None and mesh.radiance.any()
    ]
    punctual = [_punctual(i, light) for i, light in enumerate(scene.punctual) if light.intensity.any()]
    if scene.flash is not None:
        punctual.append(_punctual(-1, scene.flash))
    return {"lamps": lamps, "environment": _environment(scene.environment), "punctual": punctual}


def _punctual(index: int, light: PunctualLight) -> list[Any]:
    numbers = (*light.intensity, *light.position, *light.direction, light.cutoff_angle, light.beam_width)
    return [index, light.name, light.kind, *(float(x) for x in numbers)]


def _environment(environment: EnvironmentMap | None) -> dict[str, Any] | None:
    if environment is None:
        return None
    pixels = np.ascontiguousarray(environment.pixels, np.float32)
    return {
        "pixels": hashlib.sha256(pixels.tobytes()).hexdigest()[:16],
        "mean": [float(x) for x in pixels.reshape(-1, 3).mean(0, dtype=np.float64)],
        "to_world": [float(x) for x in np.asarray(environment.to_world, np.float64).ravel()],
    }


def light_changes(before: dict[str, Any], scene: Scene, environment: bool = True, lamps: bool = True) -> list[str]:
    """What differs between a light that :func:`light_of` kept and that of a scene of the same geometry, a few words
    each; none where the light is the same.

    Args:
        before: as it was kept.
        environment: compare the environment, too: False where it is recovered, and the scene's own is no light.
        lamps: compare the lamps' radiance, likewise; which meshes shine counts in any case.
    """
    now = light_of(scene)
    old, new = ({lamp[0]: lamp for lamp in light["lamps"]} for light in (before, now))
    changes = []
    for index in sorted(old.keys() | new.keys()):
        name = (new.get(index) or old[index])[1]
        was, is_ = (None if index not in lamps else lamps[index][2:] for lamps in (old, new))
        if was is None or is_ is None or (lamps and not np.allclose(was, is_, SAME, 0.0)):
            changes.append(f"lamp {name} {_radiance(is_)} instead of {_radiance(was)}")
    changes += _punctual_changes(before["punctual"], now["punctual"])
    if environment:
        changes += _environment_changes(before["environment"], now["environment"])
    return changes


def _punctual_changes(was: list[list[Any]], are: list[list[Any]]) -> list[str]:
    changes = []
    old, new = ({light[0]: light for light in lights} for lights in (was, are))
    for index in sorted(old.keys() | new.keys()):
        name = (new.get(index) or old[index])[1]
        before, now = (lights[index][2:] if index in lights else [] for lights in (old, new))
        shone, shines = (light[1:4] if light else None for light in (before, now))
        if shone is None or shines is None or not np.allclose(shone, shines, SAME, 0.0):
            changes.append(f"light {name} {_radiance(shines)} instead of {_radiance(shone)}")
        elif before[0] != now[0] or not np.allclose(before[4:], now[4:], 1e-5, 1e-5):
            changes.append(f"light {name} moved or turned")
    return changes


def _environment_changes(was: dict[str, Any] | None, is_: dict[str, Any] | None) -> list[str]:
    if was is None or is_ is None:
        return [] if was is is_ else ["no environment"] if is_ is None else ["an environment where there was none"]
    if was["pixels"] != is_["pixels"]:
        return [f"environment of mean radiance {_radiance(is_['mean'])} instead of {_radiance(was['mean'])}"]
    return [] if np.allclose(was["to_world"], is_["to_world"], atol=1e-5) else ["environment turned"]


def _radiance(values: list[float] | None) -> str:
    return "off" if values is None else ", ".join(f"{x:.4g}" for x in values)
