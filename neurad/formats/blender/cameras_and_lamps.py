"""Blender's cameras, and its lamps: areas and balls as meshes that shine, others as lights without extent.

Measured against Cycles 4.5: a lamp of P watts has the radiance P / (pi A) where it has an area A, whatever its shape
and scale, and the intensity P / (4 pi) where it has none, a spot's whatever its cone; a sun of E has the irradiance E.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Float64Array, FloatArray, IntArray
from neurad.core.scene_records import Mesh, PunctualLight
from neurad.formats.cameras.intrinsics import FAR, SceneCamera, rigid
from neurad.formats.gltf.lamps import areas
from neurad.formats.meshes.triangles import in_world
from neurad.runtime.numbers import LENGTH, RADIANCE, matrix, number, within
from neurad.runtime.reading import shown
from neurad.scene.punctual import check_punctual

_CORNERS = 64  # of a disk
_SPREAD = math.pi - 1e-3  # from which on an area shines as a surface does
_SHARP = math.radians(2.0)  # angle of a sun up to which its shadows count as sharp
_SPHERE = 3  # times that the sides of an icosahedron are halved


def camera_of(
    described: Mapping[str, Any], film: tuple[int, int], pixel_aspect: tuple[float, float], where: str
) -> SceneCamera:
    """A perspective camera from Blender's numbers.

    The film is ``sensor`` mm wide along the side that the fit says, for AUTO the longer one; shifts are in units of
    that side.

    Args:
        described: ``names``, ``to_world``, ``lens``, ``sensor_width``, ``sensor_height``, ``sensor_fit``, ``shift_x``
            and ``shift_y``.
        film: width and height in pixels.
        pixel_aspect: width and height of a pixel.

    Raises:
        InputError: a number is out of range, or its transform shears it.
    """
    lens = number(described.get("lens"), f"{where}: its lens", 1e-6, FAR)
    sides = [number(described.get(f"sensor_{side}"), f"{where}: its sensor", 1e-6, FAR) for side in ("width", "height")]
    shift = [number(described.get(f"shift_{axis}"), f"{where}: its shift", -FAR, FAR) for axis in "xy"]
    tall = pixel_aspect[1] / pixel_aspect[0]  # of a pixel, over its width
    fit = described.get("sensor_fit")
    if fit not in ("AUTO", "HORIZONTAL", "VERTICAL"):
        raise InputError(f"{where}: its sensor_fit is {shown(repr(fit))}")
    wide = film[0] >= tall * film[1] if fit == "AUTO" else fit == "HORIZONTAL"
    across = film[0] if wide else tall * film[1]  # the side that the sensor lies along, in widths of a pixel
    focal = lens / sides[1 if fit == "VERTICAL" else 0] * across
    pose = matrix(described.get("to_world"), f"{where}: its to_world", -LENGTH, LENGTH)
    length = np.linalg.norm(pose[:3, :3], axis=0)
    if not length.all():
        raise InputError(f"{where}: its transform has a scale of 0")
    pose[:3, :3] /= length  # Blender's cameras have no scale
    if np.linalg.det(pose[:3, :3]) < 0:
        raise InputError(f"{where}: its transform mirrors it, which is not supported")
    centre = 0.5 - shift[0] * across / film[0], 0.5 + shift[1] * across / tall / film[1]
    return SceneCamera(
        tuple(described["names"]),
        rigid(pose.tolist(), f"{where}: its transform"),
        focal / tall / film[1],
        film,
        film[0] / film[1],
        where,
        tall,
        centre,
    )


def lamp_of(described: Mapping[str, Any], material: int, where: str, notes: list[str]) -> Mesh | PunctualLight | None:
    """A lamp, None of one that is dark.

    Args:
        described: Blender's numbers, with ``watts``, its energy times its colour [3].
        notes: gets what is not as in Blender.

    Raises:
        InputError: a number is out of range, or its light is one that cannot be rendered here.
    """
    kind, name = described.get("type"), str(described.get("name"))
    watts = _colour(described, where)
    pose = matrix(described.get("to_world"), f"{where}: its to_world", -LENGTH, LENGTH)
    if not watts.any():
        return None
    _check(described, kind, where)
    if others := [ray for ray in described.get("unseen_by", []) if ray != "camera"]:
        notes.append(f"{where} is not seen by {' and '.join(map(str, others))} rays, and lights all alike here")
    radius = _number(described, "shadow_soft_size", where) if kind in ("POINT", "SPOT") else 0.0
    if kind == "AREA":
        return _area(described, name, watts, pose, material, where)
    if kind == "POINT" and radius > 0.0:
        corners, faces = _ball()
        return _shining(Mesh(name, corners * radius + pose[:3, 3], faces, material), watts, where)
    axes = pose[:3, :3]
    direction = -axes[:, 2] / max(float(np.linalg.norm(axes[:, 2])), 1e-300)
    place = pose[:3, 3], direction.astype(np.float32)
    if kind == "SUN":
        if _number(described, "angle", where) > _SHARP:
            notes.append(f"{where} is {math.degrees(described['angle']):.3g} degrees wide: its shadows are sharp here")
        return check_punctual(PunctualLight(name, "directional", watts, *place), where)
    intensity = watts / np.float32(4.0 * math.pi)
    if kind == "POINT":
        return check_punctual(PunctualLight(name, "point", intensity, *place), where)
    if radius > 0.0:
        notes.append(f"{where} is a spot with a radius of {radius:.3g}: its shadows are sharp here")
    half = 0.5 * _number(described, "spot_size", where)
    if not 0.0 < half < 0.5 * math.pi - 1e-4:
        raise InputError(
            f"{where}: its cone has {math.degrees(2 * half):.4g} degrees; a spot has to have less than 180"
        )
    beam = beam_width(half, _number(described, "spot_blend", where))
    cone = math.degrees(half), math.degrees(beam)
    return check_punctual(PunctualLight(name, "spot", intensity, *place, *cone), where)


def beam_width(half: float, blend: float) -> float:
    """The angle from which on a spot falls linearly with the angle, so that it has the power of Blender's.

    There the intensity is a smoothstep of the cosine, from the edge over a part ``blend`` of the way to the axis. Its
    power is 2 pi (1 - cos H)(1 - blend / 2); that of a linear fall from b to H is 2 pi (1 - (sin H - sin b)/(H - b)).

    Args:
        half: angle H from the axis to the edge, in radians.
        blend: in [0, 1].
    """
    wanted = (1.0 - math.cos(half)) * (1.0 - 0.5 * min(max(blend, 0.0), 1.0))
    low, high = 0.0, half * (1.0 - 1e-9)
    for _ in range(60):
        middle = 0.5 * (low + high)
        power = 1.0 - (math.sin(half) - math.sin(middle)) / (half - middle)
        low, high = (middle, high) if power < wanted else (low, middle)
    return 0.5 * (low + high) if blend > 1e-6 else half


def _check(described: Mapping[str, Any], kind: object, where: str) -> None:
    """Refuse light that is another one than is computed here."""
    if kind not in ("AREA", "POINT", "SPOT", "SUN"):
        raise InputError(f"{where} is a lamp of the type {shown(repr(kind))}, which is not supported")
    if described.get("unread"):
        raise InputError(
            f"{where}: {shown(described['unread'])}, which is not supported: set its energy and colour alone"
        )
    if kind == "AREA" and _number(described, "spread", where) < _SPREAD:
        raise InputError(f"{where} has a spread of {math.degrees(described['spread']):.3g} degrees, which is not "
                         "supported; set it to 180")  # fmt: skip
    if kind != "AREA" and described.get("normalize") is False:
        raise InputError(f"{where} has Normalize off, which is supported for areas only")
    if described.get("shadow") is False:
        raise InputError(f"{where} casts no shadow, which is not supported")


def _area(
    described: Mapping[str, Any], name: str, watts: FloatArray, pose: Float64Array, material: int, where: str
) -> Mesh:
    """A rectangle or ellipse that shines along its -Z."""
    shape, size = described.get("shape"), _number(described, "size", where)
    other = _number(described, "size_y", where) if shape in ("RECTANGLE", "ELLIPSE") else size
    if shape in ("SQUARE", "RECTANGLE"):
        corners = np.array([[-1, -1, 0], [-1, 1, 0], [1, 1, 0], [1, -1, 0]], np.float64)
    elif shape in ("DISK", "ELLIPSE"):
        phi = -2.0 * math.pi * np.arange(_CORNERS) / _CORNERS
        grown = math.sqrt(2.0 * math.pi / (_CORNERS * math.sin(2.0 * math.pi / _CORNERS)))  # to the area of the disk
        corners = grown * np.stack((np.cos(phi), np.sin(phi), 0 * phi), -1)
    else:
        raise InputError(f"{where} is an area of the shape {shown(repr(shape))}, which is not supported")
    corners = corners * (0.5 * size, 0.5 * other, 0.0)
    fan = np.arange(1, len(corners) - 1)
    faces = np.stack((np.zeros_like(fan), fan, fan + 1), -1).astype(np.int64)
    if abs(np.linalg.det(pose[:3, :3])) <= 1e-30:  # the third axis does not matter, but has to be there
        pose = pose.copy()
        pose[:3, 2] = np.cross(pose[:3, 0], pose[:3, 1])
    if size <= 0 or other <= 0 or abs(np.linalg.det(pose[:3, :3])) <= 1e-30:
        raise InputError(f"{where} has no extent; give it a size")
    vertices, _, faces = in_world(pose, corners, None, faces)
    mesh = Mesh(name, vertices, faces, material)
    return _shining(mesh, watts if described.get("normalize", True) else watts * np.float32(areas(mesh).sum()), where)


def _shining(mesh: Mesh, watts: FloatArray, where: str) -> Mesh:
    """A mesh that sends so much light in all."""
    within(mesh.vertices, f"{where}: its coordinates", -LENGTH, LENGTH)
    radiance = watts.astype(np.float64) / (math.pi * max(float(areas(mesh).sum()), 1e-300))
    within(radiance, f"{where}: its radiance", 0.0, RADIANCE)
    return Mesh(mesh.name, mesh.vertices, mesh.faces, mesh.material, radiance=radiance.astype(np.float32))


def _ball() -> tuple[Float64Array, IntArray]:
    """A ball of radius 1: corners [v, 3] and triangles that look outwards [f, 3]."""
    import trimesh

    ball: Any = trimesh.creation.icosphere(subdivisions=_SPHERE)
    return np.asarray(ball.vertices, np.float64), np.asarray(ball.faces, np.int64)


def _colour(described: Mapping[str, Any], where: str) -> FloatArray:
    values = described.get("watts")
    if not isinstance(values, list) or len(values) != 3:
        raise InputError(f"{where}: its watts are not three numbers")
    if min(number(x, f"{where}: its power", -RADIANCE, RADIANCE) for x in values) < 0:
        raise InputError(f"{where} takes light away (its power is negative), which is not supported")
    return np.array(values, np.float32)


def _number(described: Mapping[str, Any], key: str, where: str) -> float:
    return number(described.get(key), f"{where}: its {key}", 0.0, LENGTH)
