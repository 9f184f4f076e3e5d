"""Cameras by the numbers that files give: focal lengths, centre and distortion, whatever the file calls its model."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from neurad.core.camera import fov_of, pixel_side
from neurad.core.errors import InputError
from neurad.core.lens import Lens, fold, folded
from neurad.core.records import BoolArray, FloatArray
from neurad.core.scene_records import Camera, PunctualLight
from neurad.runtime.numbers import LENGTH, RADIANCE, matrix, number
from neurad.runtime.reading import shown
from neurad.scene.punctual import check_punctual

ANGLES = 1e-4, 3.1
"""Smallest and largest angle of view in radians: beyond them neighbouring pixels see the same in float32."""
_RIGID = 1e-4  # largest deviation from orthonormal axes; the cameras of Blender have about 1e-6
FAR = 1e12
"""Largest other number of a camera: none has any near it."""
SHAPE = 0.01
"""Difference of the proportions of a camera's film and its photograph that is refused."""
_BENT = 1e4  # largest coefficient of a distortion: with it a picture folds over next to its middle
_SQUARE = 1e-9  # what rounding leaves of a difference between the sides of a pixel

FULL = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2", "k3"),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "SIMPLE_RADIAL_FISHEYE": ("k1",),
    "RADIAL_FISHEYE": ("k1", "k2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
"""Coefficients of the distortion that a camera model has, by the names of COLMAP and nerfstudio, in COLMAP's order but
for the k3 that nerfstudio's OPENCV has behind them."""

FLASHES = {
    "point": ("type", "intensity", "position"),
    "spot": ("type", "intensity", "position", "direction", "cutoff_angle", "beam_width"),
}
"""What each kind of a light that moves with the camera may have (``flash``): Mitsuba's ``point`` or ``spot``."""
AHEAD = (0.0, 0.0, -1.0)

Size = tuple[int, int]
Kept = Callable[[Camera], BoolArray]
"""Gives what a mask keeps of the picture of a camera [h, w]."""


def make_camera(
    pose: FloatArray,
    size: Size,
    model: str,
    values: Mapping[str, float],
    where: str,
    fov: float | None = None,
    kept: Kept | None = None,
) -> Camera:
    """A camera.

    Args:
        pose: camera to world [4, 4], OpenGL axes.
        size: width and height of its film in pixels.
        model: one of :data:`MODELS`.
        values: ``fl_x`` and, where they are not what is usual, ``fl_y``, ``cx``, ``cy`` and coefficients.
        fov: the horizontal angle that ``fl_x`` was made of, whose digits are kept.
        kept: reads the mask of the photograph; None where all of it is used.

    Raises:
        InputError: the model is not known or lacks a coefficient that is given, a number is out of range, or the
            distortion folds over inside the picture where its mask keeps it.
    """
    if model not in MODELS:
        known = ", ".join(MODELS)
        raise InputError(f"{where}: its camera_model is {shown(repr(model))}, which is not one of {known}")
    width, height = size
    if foreign := [key for key in FULL if values.get(key) and key not in MODELS[model]]:
        raise InputError(f"{where}: {foreign[0]} is {values[foreign[0]]:g}, but a camera of model {model} has none")
    if fov is None:
        focal = number(values["fl_x"], f"{where}: fl_x", 0.0, FAR)
        if focal == 0:
            raise InputError(f"{where}: fl_x is 0")
        fov = number(fov_of(focal, width), f"{where}: the angle of view by fl_x {focal:g}", *ANGLES)
    focal = 0.5 * width / math.tan(0.5 * fov)
    aspect = number(values.get("fl_y", focal), f"{where}: fl_y", 0.0, FAR) / values.get("fl_x", focal)
    number(fov_of(max(aspect, 1e-30) * focal, height), f"{where}: the angle of view by fl_y", *ANGLES)
    centre = (
        number(values.get("cx", 0.5 * width), f"{where}: cx", -FAR, FAR) / width,
        number(values.get("cy", 0.5 * height), f"{where}: cy", -FAR, FAR) / height,
    )
    k = {key: number(values.get(key, 0.0), f"{where}: {key}", -_BENT, _BENT) for key in FULL}
    fisheye = model.endswith("FISHEYE")
    last = ("k4",) if fisheye else ()
    lens = Lens(
        1.0 if abs(aspect - 1.0) < _SQUARE else aspect,
        centre,
        tuple(np.trim_zeros([k[key] for key in ("k1", "k2", "k3", *last)], "b")),
        () if fisheye else tuple(np.trim_zeros([k["k4"], k["k5"], k["k6"]], "b")),
        (k["p1"], k["p2"]),
        fisheye,
    )
    camera = Camera(pose, fov, width, height, lens)
    place = fold(lens, pixel_side(camera), width, height)
    if place is not None and kept is not None:
        rows, columns = (folded(lens, pixel_side(camera), width, height) & kept(camera)).nonzero()
        place = (float(columns[0]), float(rows[0])) if len(rows) else None
    if place is not None:
        given = ", ".join(f"{key} {k[key]:g}" for key in MODELS[model] if k[key]) or "no coefficients"
        raise InputError(
            f"{where}: its lens distortion ({given}) folds over inside the picture: no direction belongs to pixel "
            f"({place[0]:.0f}, {place[1]:.0f}); crop the photographs to what the lens shows, leave that out by a mask "
            "(mask_path), or calibrate anew"
        )
    return camera


@dataclass(frozen=True)
class SceneCamera:
    """A camera of a scene file, which may see with a film of any number of pixels."""

    names: tuple[str, ...]
    """Its own name, and others that its photograph may have: the number of a frame."""
    to_world: FloatArray
    """Camera to world [4, 4], OpenGL axes, rigid, float64."""
    focal: float
    """Focal length along y, over the height of the film."""
    film: Size
    """Width and height of its pictures where no photograph says them."""
    aspect: float | None
    """Width of the film over its height, if the file says it."""
    where: str
    """File and camera, for sentences."""
    tall: float = 1.0
    """Height of a pixel over its width."""
    centre: tuple[float, float] = (0.5, 0.5)
    """Where its axis meets the film, over width and height, from the upper left corner."""

    def seen(self, width: int, height: int, what: str = "") -> Camera:
        """The camera with a film of so many pixels, which ``what`` has.

        Raises:
            InputError: the file says other proportions, or it sees an angle that is none of a pinhole.
        """
        if self.aspect is not None and what and abs(self.aspect * height / width - 1.0) > SHAPE:
            said = f"{self.where} has a film {self.aspect:.4g} times as wide as high"
            raise InputError(f"{said}, but {what} has {width} x {height} pixels")
        values = {"fl_x": self.focal * height * self.tall, "fl_y": self.focal * height}
        values |= {"cx": self.centre[0] * width, "cy": self.centre[1] * height}
        return make_camera(self.to_world, (width, height), "PINHOLE", values, self.where)


def described(camera: Camera) -> dict[str, Any]:
    """The keys of a ``transforms.json`` from which :func:`camera_of` makes the camera again, all but its pose."""
    lens = camera.lens
    keys: dict[str, Any] = {
        "camera_angle_x": camera.fov_x, "w": camera.width, "h": camera.height,
        "fl_x": camera.fl_x, "fl_y": camera.fl_y,
    }  # fmt: skip
    if lens.fisheye:
        del keys["camera_angle_x"]
    if lens.centre != (0.5, 0.5):
        keys |= {"cx": camera.cx, "cy": camera.cy}
    if lens.bends:
        model = "OPENCV_FISHEYE" if lens.fisheye else "FULL_OPENCV" if lens.denominator else "OPENCV"
        k = {f"k{i + 1}": x for i, x in enumerate(lens.numerator)}
        k |= {f"k{i + 4}": x for i, x in enumerate(lens.denominator)}
        k |= dict(zip(("p1", "p2"), lens.tangential, strict=True))
        keys |= {"camera_model": model, **{key: x for key, x in k.items() if x}}
    return keys if camera.flash is None else keys | {"flash": described_flash(camera.flash)}


def camera_of(
    levels: tuple[Mapping[str, Any], Mapping[str, Any]],
    size: Size,
    pose: FloatArray,
    where: str,
    kept: Kept | None = None,
) -> Camera:
    """The camera of a frame of a ``transforms.json``.

    Args:
        levels: the frame and the file; what the frame says goes first.
        size: width and height of its film in pixels.

    Raises:
        InputError: the frame says not how wide it sees, or two things that differ; or as :func:`make_camera`.
    """
    settings = {**levels[1], **{key: value for key, value in levels[0].items() if value is not None}}
    model = settings.get("camera_model")
    if model is None:
        model = "OPENCV_FISHEYE" if settings.get("is_fisheye") is True else "OPENCV"
    if not isinstance(model, str):
        raise InputError(f"{where}: its camera_model is {shown(repr(model))}, not a name")
    fisheye = model.endswith("FISHEYE")
    values = {key: x for key in (*FULL, "cx", "cy") if (x := _number(settings, key, where, -FAR, FAR)) is not None}
    fl_x, fov = _focal(levels, "x", size[0], where, fisheye)
    if fl_x is None:
        raise InputError(f"{where}: neither camera_angle_x nor fl_x says how wide it sees")
    fl_y, _ = _focal(levels, "y", size[1], where, fisheye)
    values["fl_x"], values["fl_y"] = fl_x, fl_x if fl_y is None else fl_y
    camera = make_camera(pose, size, model, values, where, fov, kept)
    return replace(camera, flash=read_flash(settings.get("flash"), where))


def _focal(
    levels: tuple[Mapping[str, Any], ...], axis: str, side: int, where: str, fisheye: bool
) -> tuple[float | None, float | None]:
    """Focal length in pixels and angle of view of the first level that has one of them."""
    for level in levels:
        focal = _number(level, f"fl_{axis}", where, 0.0, FAR)
        angle = _number(level, f"camera_angle_{axis}", where, *ANGLES)
        if focal is None and (angle is None or fisheye):  # a fisheye's angle says nothing without its distortion
            continue
        if focal == 0:
            raise InputError(f"{where}: fl_{axis} is 0")
        if angle is None or fisheye:
            return focal, None
        by_angle = 0.5 * side / math.tan(0.5 * angle)
        if focal is not None and abs(by_angle / focal - 1.0) > 1e-3:
            raise InputError(
                f"{where}: fl_{axis} is {focal:g}, but by camera_angle_{axis} it is {by_angle:g}; leave one of them out"
            )
        return by_angle if focal is None else focal, angle
    return None, None


def _number(settings: Mapping[str, Any], key: str, where: str, low: float, high: float) -> float | None:
    value = settings.get(key)
    return None if value is None else number(value, f"{where}: {key}", low, high)


def rigid(value: Any, where: str) -> FloatArray:
    """A rigid camera-to-world matrix [4, 4], float64.

    Raises:
        InputError: it is missing, has another form, or is no rotation and translation.
    """
    if value is None:
        raise InputError(f"{where} is missing")
    pose: FloatArray = matrix(value, where, -LENGTH, LENGTH)  # a pose keeps its digits
    axes = pose[:3, :3]
    straight = np.abs(axes.T @ axes - np.eye(3)).max() <= _RIGID and np.linalg.det(axes) > 0
    if not straight or np.abs(pose[3] - (0, 0, 0, 1)).max() > _RIGID:
        raise InputError(f"{where} is not rigid (a rotation and a translation)")
    return pose


# ---- the light that moves with the camera


def read_flash(given: Any, where: str) -> PunctualLight | None:
    """The flash of a photograph, in the space of its camera; None where it has none.

    Args:
        given: the value of the key ``flash``.

    Raises:
        InputError: its kind is not known, it has no power, it sets what it has not, or a number is out of its range.
    """
    if given is None or given is False:
        return None
    where = f"{where}: its flash"
    if not isinstance(given, dict):
        raise InputError(f"{where} is {shown(repr(given))}, not an object with a type and an intensity")
    kind = given.get("type", "point")
    if kind not in FLASHES:
        raise InputError(f"{where}: its type is {shown(repr(kind))}; there are: {', '.join(FLASHES)}")
    if foreign := [key for key in given if key not in FLASHES[kind]]:
        raise InputError(f"{where}: a {kind} has no {shown(foreign[0])}, only {', '.join(FLASHES[kind][1:])}")
    if given.get("intensity") is None:
        raise InputError(
            f"{where} has no intensity: give its power per solid angle, a number or three; where it is not known say "
            "about how much, and let --model.lighting.flash fit find it"
        )
    cutoff = number(given.get("cutoff_angle", 20.0), f"{where}: its cutoff_angle", -RADIANCE, RADIANCE)
    light = PunctualLight(
        "flash", kind, _three(given["intensity"], f"{where}: its intensity", RADIANCE),
        _three(given.get("position", (0.0, 0.0, 0.0)), f"{where}: its position", LENGTH),
        _three(given.get("direction", AHEAD), f"{where}: its direction", LENGTH),
        cutoff, number(given.get("beam_width", 0.75 * cutoff), f"{where}: its beam_width", -RADIANCE, RADIANCE),
    )  # fmt: skip
    return check_punctual(light, where)


def described_flash(light: PunctualLight) -> dict[str, Any]:
    """The value of the key ``flash`` from which :func:`read_flash` makes it again."""
    values: dict[str, Any] = {"type": light.kind}
    for key in FLASHES[light.kind][1:]:
        value = getattr(light, key)
        values[key] = float(value) if isinstance(value, float) else [float(x) for x in value]
    return values


def _three(value: Any, where: str, largest: float) -> FloatArray:
    """Three numbers [3]; of one number three times that."""
    values = value if isinstance(value, list | tuple) else [value] * 3
    if len(values) != 3:
        raise InputError(f"{where} is {shown(repr(value))}, not three numbers")
    return np.array([number(x, where, -largest, largest) for x in values], np.float32)
