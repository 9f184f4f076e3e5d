"""Scenes of USD files, packages (.usdz) as well, read by the optional ``usd-core``."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom, UsdLux

from neurad.core.errors import InputError, Refusals
from neurad.core.names import make_unique
from neurad.core.records import Array
from neurad.core.reflection import PrincipledModel
from neurad.core.scene_records import METAL, EnvironmentMap, Material, Mesh, PunctualLight, constant
from neurad.formats.meshes.triangles import MeshFile, in_world
from neurad.formats.usd.lights import MAX_TRIANGLES, LightReader
from neurad.formats.usd.meshes import Look, Part, children_of, face_count, look_of, parts_of
from neurad.runtime.numbers import LENGTH, within
from neurad.runtime.reading import listed, native, shown
from neurad.scene.polygons import check_triangle_count
from neurad.scene.punctual import moved_light

_SURFACES = ("Sphere", "Cube", "Cylinder", "Cone", "Capsule", "Plane", "NurbsPatch", "TetMesh")
"""Kinds of prims that have a surface and are no meshes."""
_LEFT_OUT = ("BasisCurves", "NurbsCurves", "HermiteCurves", "Points", "Volume", "ParticleField")
"""Kinds of prims that are seen and have no surface."""
_PAINT, _BLACK, _METAL = range(3)
_MATERIALS = (
    Material("paint", PrincipledModel(), constant(0.5, 3), constant(0.5)),
    Material("lamps", PrincipledModel(), constant(0.0, 3), constant(1.0)),
    Material("metal", PrincipledModel(), constant(0.5, 3), constant(0.5), metallic=METAL),
)


def read_usd(path: Path) -> MeshFile:
    """The visible meshes and lights of a file, instances each where they stand, with what their materials emit (a
    constant ``emissiveColor`` of ``UsdPreviewSurface``), in metres where it says its unit. There is a mesh for each
    part of one that has a material of its own, and for each light that has an area. What is animated stands as it does
    at its first time.

    Raises:
        InputError: the package is missing, the file is broken, or has surfaces that are no meshes or what cannot be
            rendered.
    """
    with native(path, "it cannot be read as USD"):
        room = _Reader(path, Usd.Stage.Open(str(path))).room()
    if not room.meshes:
        raise InputError(f"{shown(path)}: it has no triangle")
    return room


class _Reader:
    """A stage on its way to a room."""

    def __init__(self, path: Path, stage: Any) -> None:
        self.path = path
        self.stage = stage
        self.time = Usd.TimeCode.EarliestTime()
        self.notes: dict[str, None] = {}
        self.refusals = Refusals()
        self.names: set[str] = set()
        self.left_out = Counter[str]()
        self.smooth: dict[str, None] = {}
        """Meshes that do not say how they are subdivided."""
        self.lights = LightReader(stage, self.time, _BLACK, self._note)
        self._counted: dict[str, int] = {}
        self._parts: dict[str, list[Part]] = {}

    def room(self) -> MeshFile:
        unit, up = 1.0, None
        if UsdGeom.StageHasAuthoredMetersPerUnit(self.stage):
            unit = float(UsdGeom.GetStageMetersPerUnit(self.stage))
            within(unit, f"{shown(self.path)}: its metersPerUnit", 1e-12, LENGTH)
        else:
            self._note(f"{shown(self.path)}: it has no metersPerUnit: its lengths are taken for metres")
        if self.stage.HasAuthoredMetadata("upAxis"):
            up = str(UsdGeom.GetStageUpAxis(self.stage)).lower()
        root = self.stage.GetPseudoRoot()
        check_triangle_count(self._count(root), shown(self.path))
        meshes: list[Mesh] = []
        lights: list[PunctualLight] = []
        domes: list[Any] = []
        for prim, to_world, number in self._drawn(root, np.eye(4)):
            with self.refusals.part():
                for made in self._read(prim, to_world, number):
                    kinds: Any = meshes if isinstance(made, Mesh) else lights
                    (domes if isinstance(made, EnvironmentMap) else kinds).append(made)
        if len(domes) > 1:
            with self.refusals.part():
                raise InputError(f"{shown(self.path)}: it has {len(domes)} dome lights; keep one of them")
        self.refusals.end()
        self._say(unit)
        if unit != 1.0:
            meshes = [replace(mesh, vertices=mesh.vertices * unit) for mesh in meshes]
            lights = [moved_light(light, np.diag([unit] * 3 + [1.0])) for light in lights]
        return MeshFile(
            self.path, meshes, _MATERIALS, tuple(self.notes), tuple(lights),
            environment=next(iter(domes), None), up=up if up in ("y", "z") else None,
        )  # fmt: skip

    def _note(self, said: str) -> None:
        self.notes[said] = None

    def _say(self, unit: float) -> None:
        """What is not as in the file, a sentence each."""
        where = shown(self.path)
        if unit != 1.0:
            self._note(f"{where}: its unit is {unit:g} m: lengths are multiplied by {unit:g}")
        if self.smooth:
            self._note(
                f"{where}: {len(self.smooth)} meshes have no subdivisionScheme, which stands for Catmull-Clark in USD: "
                f"they are read as their faces are ({listed(self.smooth)}); where they should be smooth, apply the "
                "subdivision before the export"
            )
        for kind, count in self.left_out.items():
            self._note(f"{where}: {count} {kind} have no surface, and are left out")

    def _hidden(self, prim: Any) -> bool:
        seen = UsdGeom.Imageable(prim)
        return bool(seen) and seen.GetVisibilityAttr().Get(self.time) == UsdGeom.Tokens.invisible

    def _count(self, prim: Any, abstract: bool = False) -> int:
        """Triangles at and below a prim, at most, without making them; a light counts as some."""
        if self._hidden(prim):
            return 0
        if prim.IsInstance():
            return self._once(prim.GetPrototype())
        if prim.IsA(UsdGeom.PointInstancer):
            instancer = UsdGeom.PointInstancer(prim)
            _, indices, prototypes = self._instances(instancer)
            many = np.bincount(indices, minlength=len(prototypes))
            return sum(int(n) * self._once(one) for n, one in zip(many, prototypes, strict=True) if n)
        own = 0
        if prim.IsA(UsdGeom.Mesh):
            own = face_count(UsdGeom.Mesh(prim), self.time)
        elif prim.HasAPI(UsdLux.LightAPI):
            own = MAX_TRIANGLES
        elif prim.GetTypeName() in (*_SURFACES, *_LEFT_OUT):
            own = 1
        return own + sum(self._count(child, abstract) for child in children_of(prim, abstract))

    def _once(self, prototype: Any) -> int:
        """What :meth:`_count` finds below a prototype, which may be shown many times and is counted once."""
        key = str(prototype.GetPath())
        if key not in self._counted:
            self._counted[key] = self._count(prototype, abstract=True)
        return self._counted[key]

    def _instances(self, instancer: Any) -> tuple[Array, Array, list[Any]]:
        """Transforms of the instances that are shown [n, 4, 4], the numbers of their prototypes [n], and these."""
        where = f"{shown(self.path)}: {shown(instancer.GetPath())}"
        prototypes = [self.stage.GetPrimAtPath(path) for path in instancer.GetPrototypesRel().GetForwardedTargets()]
        indices = np.asarray(instancer.GetProtoIndicesAttr().Get(self.time) or (), np.int64)
        mask = list(instancer.ComputeMaskAtTime(self.time))
        places = instancer.ComputeInstanceTransformsAtTime(self.time, self.time)
        shown_ones = indices[np.array(mask, bool)] if mask else indices
        if len(places) != len(shown_ones) or not all(prototypes) or (len(indices) and (
            indices.min() < 0 or indices.max() >= len(prototypes)
        )):  # fmt: skip
            raise InputError(f"{where}: its instances have no places, or name prototypes that there are not")
        made = np.array(places, np.float64).reshape(-1, 4, 4).transpose(0, 2, 1)
        return made, shown_ones, prototypes

    def _drawn(
        self, prim: Any, above: Array, number: int | None = None, abstract: bool = False, placed: bool = False
    ) -> Iterator[tuple[Any, Array, int | None]]:
        """The visible prims at and below one, where they stand [4, 4], and the number of the instance."""
        if self._hidden(prim):
            return
        to_world = above
        if not placed and (moved := UsdGeom.Xformable(prim)):
            local = np.array(moved.GetLocalTransformation(self.time), np.float64).T
            to_world = local if moved.GetResetXformStack() else above @ local
        if prim.IsInstance() and self._once(prim.GetPrototype()) == 0:
            return
        if prim.IsA(UsdGeom.PointInstancer):
            places, indices, prototypes = self._instances(UsdGeom.PointInstancer(prim))
            for count, (place, index) in enumerate(zip(places, indices, strict=True), 1):
                if self._once(prototypes[index]):
                    yield from self._drawn(prototypes[index], to_world @ place, count, True, True)
            return
        if UsdGeom.Imageable(prim).ComputePurpose() not in ("proxy", "guide"):
            yield prim, to_world, number
        for child in children_of(prim, abstract):
            yield from self._drawn(child, to_world, number, abstract)

    def _read(self, prim: Any, to_world: Array, number: int | None) -> Iterator[Mesh | PunctualLight | EnvironmentMap]:
        kind, where = str(prim.GetTypeName()), f"{shown(self.path)}: {shown(prim.GetPath())}"
        if prim.IsA(UsdGeom.Mesh):
            yield from self._meshes(prim, to_world, number)
        elif prim.HasAPI(UsdLux.LightAPI):
            light = self.lights.read(prim, to_world, where)
            if isinstance(light, Mesh | PunctualLight):
                light = replace(light, name=self._named(light.name, number))
            if light is not None:
                yield light
        elif kind in _SURFACES:
            raise InputError(f"{where} is a {kind}; only meshes are read, convert it")
        elif kind in _LEFT_OUT:
            self.left_out[kind] += 1

    def _named(self, name: str, number: int | None) -> str:
        return make_unique(name if number is None else f"{name} {number}", self.names)

    def _meshes(self, prim: Any, to_world: Array, number: int | None) -> Iterator[Mesh]:
        """The meshes of a prim, one for each of its materials."""
        where = f"{shown(self.path)}: mesh {shown(prim.GetPath())}"
        linear = to_world[:3, :3]
        if abs(np.linalg.det(linear)) <= 1e-12 * np.linalg.norm(linear, axis=0).prod():
            raise InputError(f"{where}: its transform flattens it (it cannot be inverted)")
        parts = self._parts_of(prim, UsdGeom.Mesh(prim), where)
        for part in parts:
            look = look_of(prim if part.subset is None else part.subset, where, self.time)
            look = look or Look("", None, False, None)
            if look.unread:
                self._note(f"{where} may shine by {shown(look.unread)}, of which nothing is read; give --lamp")
            vertices, normals, faces = in_world(to_world, part.points, part.normals, part.faces)
            within(vertices, f"{where}: its coordinates", -LENGTH, LENGTH)
            name = str(prim.GetName())
            if len(parts) > 1:
                name = f"{name} {look.name or prim.GetName()}"
            material = _METAL if look.is_metal and look.emitted is None else _PAINT
            mesh = Mesh(self._named(name, number), vertices, faces, material, normals, radiance=look.emitted)
            if prim.HasAPI(UsdLux.LightAPI):
                light = self.lights.emitted(prim, where)
                glow = light if look.emitted is None else light * look.emitted
                mesh = self.lights.shining(prim, mesh, glow, where) if glow.any() else mesh
            yield mesh

    def _parts_of(self, prim: Any, mesh: Any, where: str) -> list[Part]:
        """The parts of a mesh, those of one that is shown several times once."""
        own = prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim
        key = str(own.GetPath())
        if key not in self._parts:
            self._parts[key], crossing = parts_of(prim, mesh, self.time, where)
            if crossing:
                self._note(f"{where}: the edges of {crossing} polygons cross, so that their surface is a guess")
            if not mesh.GetSubdivisionSchemeAttr().HasAuthoredValue() and self._parts[key]:
                self.smooth[str(prim.GetPath())] = None
        return self._parts[key]
