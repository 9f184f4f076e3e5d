"""Emitters of a Mitsuba scene file that have no surface: ``point``, ``spot`` and ``directional``, and daylight, which
Mitsuba's ``sunsky`` bakes into an environment map.

Files of Mitsuba 0.6 have ``sky`` and ``sun`` beside that. There all three have +Y up and the sun by the compass, other
names for some parameters, and a ground albedo of 0.2.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Float64Array, FloatArray
from neurad.core.scene_records import EnvironmentMap, PunctualLight
from neurad.images.lat_long import add_points, texel_directions
from neurad.runtime.numbers import RADIANCE, number, within
from neurad.scene.origin import ZERO
from neurad.scene.punctual import check_punctual

PUNCTUAL = {
    "point": ("intensity", "position", "to_world"),
    "spot": ("intensity", "to_world", "cutoff_angle", "beam_width"),
    "directional": ("irradiance", "direction", "to_world"),
}
"""What each light without extent may set, the light that it sends first."""
_ROUND = 1e-4  # largest relative deviation of a spot's axes from orthogonal ones of one length
SOURCES = {"sunsky": ("sun", "sky"), "sky": ("sky",), "sun": ("sun",)}
"""What of daylight each emitter has."""
PLACE = ("latitude", "longitude", "timezone", "year", "month", "day", "hour", "minute", "second")
OWN = (*PLACE, "sun_direction", "turbidity", "albedo", "sun_scale", "sky_scale", "sun_aperture", "complex_sun")
"""Parameters of Mitsuba's ``sunsky``."""
OLD = ("scale", "sun_radius_scale", "resolution")
"""Those that Mitsuba 0.6 has beside them."""
OLD_ALBEDO, APERTURE = 0.2, 0.5358
"""Reflectance of the ground where a file of Mitsuba 0.6 has none, and degrees across the sun."""
HEIGHT, WIDTH = 512, 1024
"""Texels of the map: the sun is one and a half across."""
_RINGS = 32  # of points on the sun, of equal area
_UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From the frame of a map, +Y up, to that of ``sunsky``, +Z up."""


def read_punctual(
    props: Any, name: str, intensity: FloatArray, to_world: FloatArray, where: str, origin: Float64Array
) -> PunctualLight:
    """A light from the properties of its element.

    Args:
        intensity: what it sends [3].
        to_world: its transform [4, 4] after ``origin`` was subtracted, the identity where it has none.
        origin: subtracted from its position [3].

    Raises:
        InputError: its place or direction is given twice, its cone is not round, or a number is out of its range.
    """
    kind = props.plugin_name()
    own = {"point": "position", "directional": "direction"}.get(kind)
    if own is not None and own in props and "to_world" in props:
        raise InputError(f"{where}: it has both {own} and to_world; give one of them")
    position, direction = to_world[:3, 3], to_world[:3, 2]
    if kind == "point" and "position" in props:
        position = _vector(props["position"], f"{where}: its position", origin)
    if kind == "directional" and "direction" in props:
        direction = _vector(props["direction"], f"{where}: its direction")
    angles = {}
    if kind == "spot":
        axes = to_world[:3, :3].astype(np.float64)
        axes /= np.linalg.norm(axes, axis=0).mean()
        if not np.abs(axes.T @ axes - np.eye(3)).max() <= _ROUND:
            raise InputError(f"{where}: its to_world stretches it, and its cone would not be round")
        cutoff = _degrees(props, "cutoff_angle", 20.0, where)
        angles = {"cutoff_angle": cutoff, "beam_width": _degrees(props, "beam_width", 0.75 * cutoff, where)}
    return check_punctual(PunctualLight(name, kind, intensity, position, direction, **angles), where)


def _vector(value: Any, where: str, origin: Float64Array = ZERO) -> FloatArray:
    """Three numbers [3]; those that float32 cannot hold are infinite."""
    with np.errstate(over="ignore"):
        made = np.array(value, np.float64).reshape(-1)
        if made.shape != (3,):
            raise InputError(f"{where} is not three numbers")
        return np.asarray(made - origin, np.float32)


def _degrees(props: Any, key: str, default: float, where: str) -> float:
    value = props.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: its {key} is not a number")
    return float(value)


def bake(
    load: Callable[[Mapping[str, Any]], Any], where: str, plugin: str, given: Mapping[str, Any],
    albedo: FloatArray | None, to_world: FloatArray, is_old: bool,
) -> tuple[EnvironmentMap, float]:  # fmt: skip
    """The map of an emitter, and the height of its sun above the horizon in degrees.

    The sun's power is exact; its edge is blurred by a texel.

    Args:
        load: makes Mitsuba's emitter of its description; the variant that is set is a scalar one.
        plugin: one of :data:`SOURCES`.
        given: the emitter's parameters, of :data:`OWN` and :data:`OLD`, without the albedo.
        albedo: of the ground [3], None for the default.
        to_world: of the emitter, a rotation [4, 4].
        is_old: whether it is an emitter of Mitsuba 0.6.

    Raises:
        InputError: Mitsuba does not accept the parameters, or the sun is below the horizon.
    """
    described = {key: given[key] for key in OWN if key in given}
    scale = number(given.get("scale", 1.0), f"{where}: its scale", 0.0, RADIANCE)
    for source in ("sun", "sky"):
        key = f"{source}_scale"
        own = number(given.get(key, scale), f"{where}: its {key}", 0.0, RADIANCE)
        described[key] = own if source in SOURCES[plugin] else 0.0
    if radius := number(given.get("sun_radius_scale", 1.0), f"{where}: its sun_radius_scale", 0.0, 100.0):
        described.setdefault("sun_aperture", APERTURE * radius)  # 0 is no disk: as sharp as the map can have it
    if albedo is None and is_old:
        albedo = np.full(3, OLD_ALBEDO, np.float32)
    if albedo is not None:
        described["albedo"] = {"type": "rgb", "value": albedo.tolist()}
    axes = to_world[:3, :3].astype(np.float64)
    axes /= np.linalg.norm(axes, axis=0)
    pose = axes @ _UPRIGHT.T if is_old else axes  # of Mitsuba's emitter
    described = {"type": "sunsky", **described}
    sun = _sun(load, where, described, pose, is_old)
    described = {key: value for key, value in described.items() if key not in PLACE} | {"sun_direction": sun.tolist()}
    pixels = np.zeros((HEIGHT, WIDTH, 3))
    if described["sky_scale"] > 0:
        above = texel_directions(HEIGHT, WIDTH)[: HEIGHT // 2] @ _UPRIGHT.T
        pixels[: HEIGHT // 2] = _values(load(described | {"sun_scale": 0.0}), above)
    if described["sun_scale"] > 0:
        disk = load(described | {"sky_scale": 0.0})
        _add_sun(pixels, disk, sun, math.radians(0.5 * described.get("sun_aperture", APERTURE)))
    within(pixels, f"{where}: its radiance", 0.0, RADIANCE)
    turned = np.eye(4, dtype=np.float32)
    turned[:3, :3] = pose @ _UPRIGHT
    return EnvironmentMap(pixels.astype(np.float32), turned), math.degrees(
        math.asin(min(max(float(sun[2]), -1.0), 1.0))
    )


def _sun(
    load: Callable[[Mapping[str, Any]], Any], where: str, described: Mapping[str, Any], pose: Float64Array, is_old: bool
) -> Float64Array:
    """Where the sun is in the frame of Mitsuba's emitter [3]."""
    import mitsuba as mi

    if "sun_direction" in described:
        try:
            direction = np.array(described["sun_direction"], np.float64).reshape(3)
        except (TypeError, ValueError):
            direction = np.full(3, np.nan)
        length = float(np.linalg.norm(direction))
        if not 0.0 < length < math.inf:
            raise InputError(f"{where}: its sun_direction is not three numbers that point anywhere")
        if both := [key for key in PLACE if key in described]:
            raise InputError(f"{where}: it has both sun_direction and {both[0]}; give one of them")
        sun = pose.T @ (direction / length)
    else:
        sun = np.array(mi.traverse(load(described))["sun_direction"], np.float64).reshape(3)
        if is_old:  # south is +X and west +Y in the one, south +Z and east +X in the other
            sun = _UPRIGHT @ np.array([-sun[1], sun[2], sun[0]])
    if sun[2] <= 0.0:
        raise InputError(
            f"{where}: its sun is {math.degrees(math.asin(-min(sun[2], 0.0))):.1f} degrees below the horizon, where it "
            "sends no light; change its time and place, or its sun_direction"
        )
    return sun


def _values(emitter: Any, directions: Float64Array) -> Float64Array:
    """Radiance [..., 3] from directions [..., 3]."""
    import mitsuba as mi

    si, made = mi.SurfaceInteraction3f(), np.empty(directions.shape)
    for row, towards in zip(made.reshape(-1, 3), (-directions).reshape(-1, 3).tolist(), strict=True):
        si.wi = mi.Vector3f(towards)
        row[:] = emitter.eval(si)
    return made


def _add_sun(pixels: Float64Array, disk: Any, sun: Float64Array, radius: float) -> None:
    """Share the sun among texels so that the map, which is linear between them, sends as much light from there."""
    ring, turn = np.meshgrid(np.arange(_RINGS) + 0.5, 2.0 * math.pi * np.arange(4 * _RINGS) / (4 * _RINGS))
    cosine = 1.0 - (1.0 - math.cos(radius)) * (ring / _RINGS)
    sine = np.sqrt(1.0 - cosine**2)
    across = np.cross(sun, np.eye(3)[np.argmin(np.abs(sun))])
    across /= np.linalg.norm(across)
    parts = (sine * np.cos(turn), sine * np.sin(turn), cosine)
    points = sum(part[..., None] * axis for part, axis in zip(parts, (across, np.cross(sun, across), sun), strict=True))
    points = np.asarray(points).reshape(-1, 3)
    power = _values(disk, points) * (2.0 * math.pi * (1.0 - math.cos(radius)) / len(points))
    add_points(pixels, points @ _UPRIGHT, power)
