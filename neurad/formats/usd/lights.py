"""Lights of UsdLux: those with an area as meshes that shine, others as lights without extent or as the environment.

By the specification of UsdLux a light has the radiance color * intensity * 2^exposure, which ``normalize`` divides by
the area of its surface in the world; of a distant light this is an irradiance if it is normalised or has no angle.
"""

import math
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from pxr import UsdGeom, UsdLux

from neurad.core.errors import InputError
from neurad.core.records import Array, FloatArray, IntArray
from neurad.core.scene_records import EnvironmentMap, Mesh, PunctualLight
from neurad.formats.gltf.lamps import areas
from neurad.formats.meshes.triangles import in_world
from neurad.formats.mitsuba.shapes import triangulated
from neurad.images.image_io import read_bitmap
from neurad.runtime.numbers import LENGTH, RADIANCE, within
from neurad.runtime.reading import exists, native, shown
from neurad.scene.punctual import check_punctual

SHAPES = {"RectLight": "rectangle", "DiskLight": "disk", "SphereLight": "sphere", "CylinderLight": "cylinder"}
DOMES = ("DomeLight", "DomeLight_1")
MAX_TRIANGLES = 1 << 15
"""Triangles of one light."""
_SHARP = 2.0  # degrees of a distant light up to which its shadows count as sharp
_Z_TO_Y = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
"""Takes +Y to +Z."""


class LightReader:
    """Reads the lights of a stage at a time, and says what is not as in USD, a sentence each."""

    def __init__(self, stage: Any, time: Any, material: int, say: Callable[[str], None]) -> None:
        self.stage = stage
        self.time = time
        self.material = material
        self.say = say

    def read(self, prim: Any, to_world: Array, where: str) -> Mesh | PunctualLight | EnvironmentMap | None:
        """A light in the unit of the stage; None of one that is dark.

        Raises:
            InputError: a number is none to compute with, or it is of a kind that is not read.
        """
        kind = str(prim.GetTypeName())
        if kind == "PortalLight":  # it says where a dome is seen through, and sends nothing
            return None
        emitted = self.emitted(prim, where)
        if not emitted.any():
            return None
        if kind in DOMES:
            return self._dome(prim, kind, emitted, to_world, where)
        if kind == "DistantLight":
            return self._distant(prim, emitted, to_world, where)
        if kind not in SHAPES:
            raise InputError(f"{where} is a {kind}, which is not read; there are: {', '.join((*SHAPES, *DOMES))}")
        if kind == "RectLight" and str(self._get(prim, "inputs:texture:file", "") or "").strip("@"):
            raise InputError(f"{where} shines by a picture, which is not read from USD; export glTF instead")
        return self._shaped(prim, kind, emitted, to_world, where)

    def emitted(self, prim: Any, where: str) -> FloatArray:
        """Radiance of a light [3] before it is normalised."""
        light = UsdLux.LightAPI(prim)
        colour = np.array(light.GetColorAttr().Get(self.time), np.float64)
        if light.GetEnableColorTemperatureAttr().Get(self.time):
            kelvin = float(light.GetColorTemperatureAttr().Get(self.time))
            colour = colour * np.array(UsdLux.BlackbodyTemperatureAsRgb(kelvin), np.float64)
        with np.errstate(over="ignore"):
            exposure = np.exp2(float(light.GetExposureAttr().Get(self.time)))
            radiance = colour * float(light.GetIntensityAttr().Get(self.time)) * exposure
        within(radiance, f"{where}: its color * intensity * 2^exposure", 0.0, RADIANCE)
        self._say_unheld(prim, light, where)
        found: FloatArray = radiance.astype(np.float32)
        return found

    def shining(self, prim: Any, mesh: Mesh, emitted: FloatArray, where: str) -> Mesh:
        """A mesh that sends what a light does."""
        area = float(areas(mesh).sum())
        if area <= 0.0:
            raise InputError(f"{where} has no extent; give it a size")
        radiance = emitted / area if self._get(prim, "inputs:normalize", False) else emitted
        within(radiance, f"{where}: its radiance", 0.0, RADIANCE)
        return Mesh(mesh.name, mesh.vertices, mesh.faces, mesh.material, radiance=np.asarray(radiance, np.float32))

    def _get(self, prim: Any, name: str, default: Any) -> Any:
        attribute = prim.GetAttribute(name)
        value = attribute.Get(self.time) if attribute else None
        return default if value is None else value

    def _length(self, prim: Any, name: str, where: str) -> float:
        value = float(self._get(prim, f"inputs:{name}", 1.0))
        within(value, f"{where}: its {name}", 0.0, LENGTH)
        return value

    def _cone(self, prim: Any) -> float:
        """Degrees from its axis to which a light shines; those of a whole sphere where nothing limits it."""
        return float(self._get(prim, "inputs:shaping:cone:angle", 180.0))

    def _say_unheld(self, prim: Any, light: Any, where: str) -> None:
        """Say what of a light is not read."""
        full = 180.0 if prim.GetTypeName() == "SphereLight" else 90.0
        links = light.GetLightLinkCollectionAPI()
        listed = (links.GetIncludesRel(), links.GetExcludesRel())
        linked = self._get(prim, "collection:lightLink:includeRoot", True) is False
        factors = {self._get(prim, f"inputs:{part}", 1.0) for part in ("diffuse", "specular")}
        found = {
            "its IES profile": str(self._get(prim, "inputs:shaping:ies:file", "") or "").strip("@"),
            "its focus": self._get(prim, "inputs:shaping:focus", 0.0) != 0.0,
            "its cone": self._cone(prim) < full and not self._is_spot(prim),
            "its factors for diffuse and specular light": factors != {1.0},
            "that it casts no shadows": not self._get(prim, "inputs:shadow:enable", True),
            "the things that it is linked to": linked or any(rel.HasAuthoredTargets() for rel in listed),
            "its filters": light.GetFiltersRel().HasAuthoredTargets(),
        }
        if said := [what for what, is_there in found.items() if is_there]:
            self.say(f"{where}: {', '.join(said)}: this is not read, it shines evenly on all there is")

    def _is_spot(self, prim: Any) -> bool:
        return prim.GetTypeName() == "SphereLight" and 0.0 < self._cone(prim) < 90.0

    def _shaped(
        self, prim: Any, kind: str, emitted: FloatArray, to_world: Array, where: str
    ) -> Mesh | PunctualLight | None:
        """A light with an area, or one that stands for a point."""
        name, local = str(prim.GetName()), np.eye(4)
        if kind == "RectLight":
            local[:3, :3] = np.diag([0.5 * self._length(prim, x, where) for x in ("width", "height")] + [1.0])
        elif kind == "CylinderLight":  # along X, where Mitsuba's goes along Z from 0 to 1
            radius, length = (self._length(prim, x, where) for x in ("radius", "length"))
            local[:3, :3] = ((0, 0, length), (radius, 0, 0), (0, radius, 0))
            local[0, 3] = -0.5 * length
        else:
            radius = self._length(prim, "radius", where)
            local[:3, :3] = np.diag((radius, -radius, -radius) if kind == "DiskLight" else (radius, radius, radius))
        if kind == "SphereLight" and (self._get(prim, "treatAsPoint", False) or radius == 0.0 or self._is_spot(prim)):
            return self._point(prim, emitted, radius, to_world, where)
        pose = to_world @ local
        if abs(np.linalg.det(pose[:3, :3])) <= 1e-30:
            raise InputError(f"{where} has no extent; give it a size")
        vertices, faces = _surface(SHAPES[kind], pose)
        within(vertices, f"{where}: its coordinates", -LENGTH, LENGTH)
        return self.shining(prim, Mesh(name, vertices, faces, self.material), emitted, where)

    def _point(
        self, prim: Any, emitted: FloatArray, radius: float, to_world: Array, where: str
    ) -> PunctualLight | None:
        """A point or spot with the intensity of a sphere; a quarter of its area faces each direction."""
        linear = to_world[:3, :3]
        squared = (radius**2) * abs(float(np.linalg.det(linear))) ** (2.0 / 3.0)
        normalised = self._get(prim, "inputs:normalize", False)
        intensity = emitted / np.float32(4.0) if normalised else emitted * np.float32(math.pi * squared)
        if not intensity.any():
            self.say(f"{where} has a radius of 0 and is not normalised: it sends nothing, and is left out")
            return None
        name, place = str(prim.GetName()), to_world[:3, 3]
        axis = -linear[:, 2] / max(float(np.linalg.norm(linear[:, 2])), 1e-300)
        if not self._is_spot(prim):
            return check_punctual(PunctualLight(name, "point", intensity, place), where)
        if radius > 0.0 and not self._get(prim, "treatAsPoint", False):
            self.say(f"{where} is a spot with a radius of {radius:.3g}: its shadows are sharp here")
        cone, soft = self._cone(prim), float(self._get(prim, "inputs:shaping:cone:softness", 0.0))
        beam = cone * (1.0 - min(max(soft, 0.0), 1.0))
        return check_punctual(PunctualLight(name, "spot", intensity, place, axis.astype(np.float32), cone, beam), where)

    def _distant(self, prim: Any, emitted: FloatArray, to_world: Array, where: str) -> PunctualLight:
        angle = float(self._get(prim, "inputs:angle", 0.53))
        within(angle, f"{where}: its angle", 0.0, 360.0)
        half = math.radians(0.5 * angle)
        seen = math.pi * (math.sin(half) ** 2 if half <= 0.5 * math.pi else 2.0 - math.sin(half) ** 2)
        plain = self._get(prim, "inputs:normalize", False) or angle == 0.0
        if angle > _SHARP:
            self.say(f"{where} is {angle:.3g} degrees wide: its shadows are sharp here")
        axis = -to_world[:3, 2] / max(float(np.linalg.norm(to_world[:3, 2])), 1e-300)
        irradiance = emitted if plain else emitted * np.float32(seen)
        light = PunctualLight(str(prim.GetName()), "directional", irradiance, direction=axis.astype(np.float32))
        return check_punctual(light, where)

    def _dome(self, prim: Any, kind: str, emitted: FloatArray, to_world: Array, where: str) -> EnvironmentMap:
        """The environment; its map lies as in the specification of OpenEXR, which is how ours does."""
        pole = str(self._get(prim, "poleAxis", "Y")) if kind == "DomeLight_1" else "Y"
        up = str(UsdGeom.GetStageUpAxis(self.stage)) if pole == "scene" else pole
        pose = to_world @ _Z_TO_Y if up == "Z" else to_world.copy()
        axes = pose[:3, :3] / np.maximum(np.linalg.norm(pose[:3, :3], axis=0), 1e-300)
        if np.abs(axes.T @ axes - np.eye(3)).max() > 1e-4:
            raise InputError(f"{where}: its transform is no rotation")
        pose[:3, :3], pose[:3, 3] = axes, 0.0
        pixels = self._picture(prim, where)
        values = np.broadcast_to(pixels, (*pixels.shape[:2], 3)) * emitted
        within(values, f"{where}: its radiance", 0.0, RADIANCE)
        return EnvironmentMap(np.ascontiguousarray(values, np.float32), pose.astype(np.float32))

    def _picture(self, prim: Any, where: str) -> FloatArray:
        """The map of a dome, ones where it has none."""
        given = self._get(prim, "inputs:texture:file", None)
        name = "" if given is None else str(given.path)
        if not name:
            return np.ones((2, 4, 3), np.float32)
        layout = str(self._get(prim, "inputs:texture:format", "automatic"))
        if layout not in ("automatic", "latlong") or not name.lower().endswith((".exr", ".png", ".jpg", ".jpeg")):
            raise InputError(
                f"{where}: its picture {shown(name)} ({layout}) is not read; make it a lat-long EXR map, and give "
                "--environment"
            )
        path = str(given.resolvedPath or "")
        if path.endswith("]") and "[" in path:  # in a package
            package, _, inside = path[:-1].rpartition("[")
            with tempfile.TemporaryDirectory(prefix="neurad-") as folder:
                with native(package, f"{shown(inside)} in it cannot be read"), zipfile.ZipFile(package) as opened:
                    (Path(folder) / Path(inside).name).write_bytes(opened.read(inside))
                return read_bitmap(Path(folder) / Path(inside).name)
        if not path or not exists(path):
            raise InputError(f"{where}: its picture {shown(name)} is missing")
        return read_bitmap(path)


def _surface(shape: str, pose: Array) -> tuple[Array, IntArray]:
    """Vertices [v, 3], float64, and triangles of a light: a square from -1 to 1 facing -Z or one of Mitsuba's."""
    if shape == "rectangle":
        corners = np.array([[-1, -1, 0], [-1, 1, 0], [1, 1, 0], [1, -1, 0]], np.float64)
        vertices, _, faces = in_world(pose, corners, None, np.array([[0, 1, 2], [0, 2, 3]], np.int64))
        return np.asarray(vertices, np.float64), faces
    turned = pose.copy()
    turned[:3, 3] = 0.0
    made = triangulated(shape, turned)
    return made.vertices.astype(np.float64) + pose[:3, 3], made.faces
