"""The light of a scene as a checkpoint keeps it, and how the light of another scene differs."""

import hashlib
from collections.abc import Iterator
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
    now, changes = light_of(scene), list[str]()
    for name, was, is_ in _paired(before["lamps"], now["lamps"]):
        if lamps or was is None or is_ is None:
            changes += _radiance_change(f"lamp {name}", was, is_)
    for name, was, is_ in _paired(before["punctual"], now["punctual"]):
        brightness = _radiance_change(f"light {name}", was and was[1:4], is_ and is_[1:4])
        changes += brightness
        if not brightness and (was[0] != is_[0] or not np.allclose(was[4:], is_[4:], 1e-5, 1e-5)):
            changes.append(f"light {name} moved or turned")
    if environment:
        changes += _environment_changes(before["environment"], now["environment"])
    return changes


def _paired(was: list[list[Any]], are: list[list[Any]]) -> Iterator[tuple[str, Any, Any]]:
    """Name of each light of two lists, and what follows it in both, None where one has no such light."""
    old, new = ({number: values for number, *values in rows} for rows in (was, are))
    for number in sorted(old.keys() | new.keys()):
        before, now = old.get(number), new.get(number)
        yield (new.get(number) or old[number])[0], before and before[1:], now and now[1:]


def _radiance_change(name: str, was: list[float] | None, is_: list[float] | None) -> list[str]:
    if was is not None and is_ is not None and np.allclose(was, is_, SAME, 0.0):
        return []
    return [f"{name} {_radiance(is_)} instead of {_radiance(was)}"]


def _environment_changes(was: dict[str, Any] | None, is_: dict[str, Any] | None) -> list[str]:
    if was is None or is_ is None:
        return [] if was is is_ else ["no environment"] if is_ is None else ["an environment where there was none"]
    if was["pixels"] != is_["pixels"]:
        return [f"environment of mean radiance {_radiance(is_['mean'])} instead of {_radiance(was['mean'])}"]
    return [] if np.allclose(was["to_world"], is_["to_world"], atol=1e-5) else ["environment turned"]


def _radiance(values: list[float] | None) -> str:
    return "off" if values is None else ", ".join(f"{x:.4g}" for x in values)
