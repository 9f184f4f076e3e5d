"""What ``write_room.py`` writes of a Blender scene: objects, lamps, materials, world and cameras."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.names import make_unique
from neurad.core.records import FloatArray, IntArray
from neurad.core.reflection import DielectricModel, DiffuseModel
from neurad.core.scene_records import EnvironmentMap, Material, Mesh, PunctualLight
from neurad.formats.blender.cameras_and_lamps import camera_of, lamp_of
from neurad.formats.blender.materials import MaterialReader, Painted, black, file_in
from neurad.formats.cameras.intrinsics import SceneCamera
from neurad.formats.gltf.lamps import backs_of, lit_by
from neurad.formats.meshes.triangles import in_world
from neurad.images.image_io import read_exr
from neurad.runtime.memory import reserve
from neurad.runtime.numbers import LENGTH, RADIANCE, TEXEL, matrix, number, within
from neurad.runtime.reading import listed, native, read_json, shown
from neurad.scene.description import Scene

ROOM = "blender.json"
"""The file that says what a folder has."""
FORMAT = 1
_UNLIMITED, _RR_DEPTH = 2**31 - 1, 5
_SIDE = 65536  # pixels of a film, at most
_MIN_BOUNCES = 8  # bounces below which a closed room gets visibly darker
_TOWARDS_Y = np.array([[-1, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float32)
"""From the frame of an environment map to Blender's, for a picture of all directions with +Y in its middle."""
TOWARDS_X = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float32)
"""From the frame of an environment map to Blender's, for a picture with +X in its middle, as Blender's own Environment
Texture has it."""


@dataclass(frozen=True)
class BlenderRoom:
    """A scene of Blender, in its own frame, +Z up."""

    scene: Scene
    """Without views."""
    cameras: list[SceneCamera]
    unseen: list[Mesh]
    """Lamps that Blender's cameras do not see."""
    exposure: float
    """What Cycles multiplies its pictures by."""


def read_blender(folder: Path, where: str) -> BlenderRoom:
    """The room in a folder of ``write_room.py``.

    Raises:
        InputError: a file is missing or broken, or the scene has what cannot be rendered.
    """
    described = read_json(folder / ROOM, "write_room.py has not written it to its end")
    if not isinstance(described, dict) or "neurad_blender" not in described:
        raise InputError(f"{shown(folder / ROOM)}: write_room.py has not written it")
    if described["neurad_blender"] != FORMAT:
        raise InputError(
            f"{shown(folder / ROOM)}: another version of neurad's write_room.py has written it; run it anew"
        )
    try:
        return _Reader(folder, described, where).room()
    except (LookupError, TypeError, AttributeError, ValueError) as error:
        raise InputError(f"{shown(folder / ROOM)}: it is not as write_room.py writes it ({error})") from error


def read_world(path: Path, to_world: FloatArray, where: str) -> EnvironmentMap:
    """The environment map of a picture of all directions, the centres of whose first pixels are half a pixel below its
    edge, as Blender renders and reads it.

    Raises:
        InputError: it cannot be read, or a value is none to compute with.
    """
    pixels = read_exr(path)[..., :3]
    within(pixels, where, -RADIANCE, RADIANCE)
    pixels = np.broadcast_to(np.maximum(pixels, 0.0), (*pixels.shape[:2], 3))
    row = np.linspace(-0.5, len(pixels) - 0.5, len(pixels)).clip(0, len(pixels) - 1)  # a map's first is straight up
    low = np.floor(row).astype(np.int64)
    part = (row - low)[:, None, None].astype(np.float32)
    below = pixels[np.minimum(low + 1, len(pixels) - 1)]
    return EnvironmentMap(((1 - part) * pixels[low] + part * below).astype(np.float32), to_world)


class _Reader:
    """A folder on its way to a room."""

    def __init__(self, folder: Path, described: Mapping[str, Any], where: str) -> None:
        self.folder = folder
        self.described = described
        self.where = where
        self.reader = MaterialReader(folder, where)
        self.notes: list[str] = []
        self.materials: list[Material] = []
        self.painted: dict[int, tuple[Painted, int]] = {}
        self.black: list[int] = []
        """Materials of what reflects nothing."""
        self.names: set[str] = set()
        """Names that meshes and lamps have by now."""
        self._arrays: dict[str, dict[str, Any]] = {}
        self._welded: dict[Any, tuple[FloatArray, FloatArray | None, FloatArray | None, IntArray]] = {}

    def room(self) -> BlenderRoom:
        meshes = [mesh for thing in self.described["objects"] for mesh in self._object(thing)]
        lamps, punctual, unseen = self._lamps()
        self._blacken()
        scene = Scene(
            "blender",
            [*meshes, *lamps],
            self.materials,
            self._world(),
            max_depth=_UNLIMITED,
            rr_depth=_RR_DEPTH,
            punctual=tuple(punctual),
        )
        cameras = self._cameras()
        self._say()
        exposure = number(self.described["cycles"].get("film_exposure", 1.0), f"{self.where}: its exposure", 1e-9, 1e9)
        return BlenderRoom(replace(scene, notes=tuple(self.notes)), cameras, unseen, exposure)

    def _object(self, thing: Mapping[str, Any]) -> Iterator[Mesh]:
        """The meshes of an object, one for each of its materials; more where it shines unevenly."""
        name, where = str(thing["name"]), f"{self.where}: object {shown(thing['name'])}"
        if others := [*(f"unseen by {ray} rays" for ray in thing["unseen_by"]), *thing["special"]]:
            self.notes.append(f"{where} is special in Blender ({', '.join(map(str, others))}) and like all others here")
        pose = matrix(thing["to_world"], f"{where}: its to_world", -LENGTH, LENGTH)
        lengths = np.linalg.norm(pose[:3, :3], axis=0)
        if abs(np.linalg.det(pose[:3, :3])) <= 1e-12 * lengths.prod() or not lengths.all():
            self.notes.append(f"{where} is flattened by its transform, and left out")
            return
        used = np.unique(self._mesh(str(thing["mesh"]))["material"])
        slots = thing["materials"]
        for slot in used.tolist():
            number_of = slots[min(max(int(slot), 0), len(slots) - 1)]
            painted, index = self._painted(number_of)
            if painted.material is None:
                self.notes.append(f"{where} is a volume alone, and left out")
                continue
            refracts = isinstance(painted.material.model, DielectricModel)
            if refracts and "shadow" in thing["unseen_by"] and self.described["cycles"].get("caustics_refractive"):
                self.notes.append(
                    f"{where} is glass that casts no shadow, so that Cycles counts light behind it twice: render "
                    "photographs with Refractive Caustics off (Light Paths)"
                )
            vertices, normals, uvs, faces = self._weld(thing, int(slot), painted.uv, where)
            vertices, normals, faces = in_world(pose, vertices, normals, faces)
            within(vertices, f"{where}: its coordinates", -LENGTH, LENGTH)
            made = make_unique(name if len(used) == 1 else f"{name} {painted.material.name}", self.names)
            radiance = None if painted.emission is None else painted.emission.radiance
            mesh = Mesh(made, vertices, faces, index, normals, uvs, radiance=radiance)
            yield from [mesh] if painted.emission is None else self._shining(mesh, painted, where)

    def _painted(self, number_of: int) -> tuple[Painted, int]:
        """A material, and its number among those of the scene."""
        if number_of not in self.painted:
            painted = self.reader.paint(self.described["materials"][number_of])
            if painted.material is not None:
                self.materials.append(painted.material)
                if self.described["materials"][number_of]["shader"] in ("NONE", "EMISSION"):
                    self.black.append(len(self.materials) - 1)
            self.painted[number_of] = painted, len(self.materials) - 1
        return self.painted[number_of]

    def _mesh(self, name: str) -> dict[str, Any]:
        """The arrays of a mesh, checked."""
        if name in self._arrays:
            return self._arrays[name]
        path = file_in(self.folder, name)
        with native(path, "it is no mesh that write_room.py has written"), np.load(path, allow_pickle=False) as read:
            found = {key: read[key] for key in read.files}
            faces, count = found["faces"], len(found["vertices"])
            shapes = {"vertices": (count, 3), "faces": (len(faces), 3), "material": (len(faces),)}
            shapes |= {key: (len(faces), 3, 3 if key == "normals" else 2) for key in found if key not in shapes}
            if any(found[key].shape != shape for key, shape in shapes.items()) or len(faces) == 0:
                raise ValueError(path)
            if faces.dtype.kind != "i" or faces.min() < 0 or faces.max() >= count:
                raise ValueError(path)
        reserve(f"{shown(path)}", 400 * len(faces), 200 * len(faces))
        self._arrays[name] = found
        return found

    def _weld(
        self, thing: Mapping[str, Any], slot: int, uv: str, where: str
    ) -> tuple[FloatArray, FloatArray | None, FloatArray | None, IntArray]:
        """Vertices, normals, texture coordinates and triangles of a material's part of a mesh.

        Blender gives normals and texture coordinates to the corners of triangles: corners that agree in both become one
        vertex.
        """
        arrays, names = self._mesh(str(thing["mesh"])), thing["uvs"]
        key = thing["mesh"], slot, uv
        if key in self._welded:
            return self._welded[key]
        part = arrays["material"] == slot
        corner = arrays["faces"][part].reshape(-1, 1).astype(np.int64)
        rows = [corner]
        normals = uvs = None
        if not thing["flat"] and "normals" in arrays:
            normals = np.nan_to_num(arrays["normals"][part].reshape(-1, 3).astype(np.float32), posinf=0, neginf=0)
            rows.append((normals + 0.0).view(np.int32).astype(np.int64))  # 0.0: no two kinds of zero
        layer = names.get(uv, names.get(""))
        if uv and uv not in names:
            self.notes.append(f"{where} has no UV map {shown(uv)}, which its material places pictures by")
        if layer is not None:
            uvs = arrays[str(layer)][part].reshape(-1, 2).astype(np.float32)
            uvs = np.where(np.isfinite(uvs) & (np.abs(uvs) < TEXEL), uvs, np.float32(0.0))
            rows.append((uvs + np.float32(0.0)).view(np.int32).astype(np.int64))
        _, first, same = np.unique(np.concatenate(rows, 1), axis=0, return_index=True, return_inverse=True)
        self._welded[key] = (
            arrays["vertices"][corner[first, 0]].astype(np.float32),
            None if normals is None else normals[first],
            None if uvs is None else uvs[first],
            same.reshape(-1, 3).astype(np.int64),
        )
        return self._welded[key]

    def _shining(self, mesh: Mesh, painted: Painted, where: str) -> Iterator[Mesh]:
        """A surface that emits light: as in Cycles to both sides, unless nothing would see its back."""
        lit, emission = [mesh], painted.emission
        assert emission is not None
        if emission.picture is not None:
            if mesh.uvs is None:
                raise InputError(f"{where} shines by a picture, but has no UV coordinates")
            lit = lit_by(emission.picture, mesh, mesh.uvs, self.names, where, self.notes.append)
        yield from lit
        if sheets := backs_of(mesh, lit, self.names):
            self.notes.append(f"{where} shines from both sides of its surface, as two sheets")
            yield from sheets

    def _lamps(self) -> tuple[list[Mesh], list[PunctualLight], list[Mesh]]:
        """Lamps with an area and those without one, and the former that cameras do not see."""
        meshes: list[Mesh] = []
        punctual: list[PunctualLight] = []
        unseen: list[Mesh] = []
        for described in self.described["lamps"]:
            where = f"{self.where}: lamp {shown(described['name'])}"
            lamp = lamp_of(described, len(self.materials), where, self.notes)
            if isinstance(lamp, Mesh):
                lamp = replace(lamp, name=make_unique(lamp.name, self.names))
                meshes.append(lamp)
                unseen += [lamp] if "camera" in described["unseen_by"] else []
            elif lamp is not None:
                punctual.append(replace(lamp, name=make_unique(lamp.name, self.names)))
        if meshes:
            self.black.append(len(self.materials))
            self.materials.append(black("lamps"))
        return meshes, punctual, unseen

    def _blacken(self) -> None:
        """Give what reflects nothing the model of what does: one of its own would cost time at every reflection."""
        others = [material.model for i, material in enumerate(self.materials) if i not in self.black]
        if others and all(model.is_diffuse or model.is_delta for model in others):
            for index in self.black:
                self.materials[index] = replace(self.materials[index], model=DiffuseModel())

    def _world(self) -> EnvironmentMap | None:
        world, where = self.described["world"], f"{self.where}: its world"
        if world is None:
            return None
        if "color" in world:
            colour = np.array([number(x, where, 0.0, RADIANCE) for x in world["color"]], np.float32)
            return EnvironmentMap(np.broadcast_to(colour, (2, 4, 3)).copy(), _TOWARDS_Y) if colour.any() else None
        return read_world(file_in(self.folder, world["file"]), _TOWARDS_Y, where)

    def _cameras(self) -> list[SceneCamera]:
        width, height = (int(number(x, f"{self.where}: its resolution", 1, _SIDE)) for x in self.described["film"])
        aspect = [number(x, f"{self.where}: its pixel aspect", 1e-3, 1e3) for x in self.described["pixel_aspect"]]
        found, other = [], {}
        for described in self.described["cameras"]:
            name = str(described["names"][0])
            if described["type"] != "PERSP":
                other[name] = str(described["type"])
                continue
            about = f"{self.where}: camera {shown(name)}"
            found.append(camera_of(described, (width, height), (aspect[0], aspect[1]), about))
        if other:
            names = listed(f"{name} ({kind})" for name, kind in other.items())
            self.notes.append(f"{self.where}: cameras that are not perspective are left out: {names}")
        return found

    def _say(self) -> None:
        """What is not as in Blender, a sentence each."""
        for kind, names in self.described["left_out"].items():
            self.notes.append(
                f"{self.where}: {listed(dict.fromkeys(names))}: {kind} cannot be rendered, and is left out"
            )
        for name, all_said in self.reader.anew.items():
            said = ", ".join(all_said)
            self.notes.append(
                f"{self.where}: material {shown(name)} has more than is read ({said}): a fit finds it anew"
            )
        self.notes += [f"{self.where}: {shown(said)}" for said in self.described["notes"]]
        cycles = self.described["cycles"]
        if min(cycles.get("diffuse_bounces", _MIN_BOUNCES), cycles.get("max_bounces", _MIN_BOUNCES)) < _MIN_BOUNCES:
            self.notes.append(
                f"{self.where}: Cycles ends its paths after {cycles['diffuse_bounces']} diffuse bounces, so that its "
                "pictures are too dark for their lamps: render photographs with 16 or more (Light Paths)"
            )
        if cycles.get("sample_clamp_indirect", 0) > 0 or cycles.get("sample_clamp_direct", 0) > 0:
            self.notes.append(f"{self.where}: Cycles clamps light, so that highlights are too dark; set Clamping to 0")
