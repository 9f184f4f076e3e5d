"""Other light and other things in a scene: what ``neurad render --edit`` and the viewer change."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.colour import LUMINANCE
from neurad.core.errors import InputError
from neurad.core.names import make_unique
from neurad.core.parameters import ALBEDO, PARAMETERS
from neurad.core.records import FloatArray
from neurad.core.reflection import PrincipledModel
from neurad.core.scene_records import Constant, EnvironmentMap, Material, Mesh, PunctualLight, View
from neurad.core.suggest import nearest
from neurad.formats.edits.placement import Placement, placed, scene_up, turned_environment
from neurad.formats.meshes.files import read_object
from neurad.images.lat_long import read_map
from neurad.runtime.numbers import RADIANCE, within
from neurad.runtime.reading import listed, shown
from neurad.scene.description import Scene

Color = tuple[float, float, float]
"""Linear RGB."""
Vector = tuple[float, float, float]
"""In scene units."""
MaterialEdit = Mapping[str, tuple[float, ...]]
"""What a mesh is made of instead: surface parameters by name; it keeps the others."""


@dataclass(frozen=True)
class LampEdit:
    """What happens to a lamp. The radiance is replaced first, then coloured, then scaled."""

    off: bool = False
    scale: float = 1.0
    """Times as bright."""
    color: Color | None = None
    """Colour that it gets at the luminance that it has."""
    radiance: Color | None = None
    """Radiance instead of what it has."""
    move: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class EnvironmentEdit:
    """What happens to the environment. Another map is read first, then coloured, scaled and turned."""

    off: bool = False
    file: str | None = None
    """Lat-long map (EXR) instead of what the scene has, in the same frame."""
    turn: float = 0.0
    """Degrees about its vertical axis, counterclockwise as seen from above."""
    scale: float = 1.0
    color: Color | None = None


@dataclass(frozen=True)
class ObjectEdit:
    """A thing that is put into the scene."""

    file: str
    """OBJ, GLB, PLY or STL."""
    placement: Placement
    name: str | None = None
    """What its meshes are called; None takes the name of the file."""
    material: MaterialEdit = field(default_factory=dict)
    """Instead of what the file says, and where it says nothing albedo and roughness 0.5."""
    radiance: Color | None = None
    """It shines: a lamp is put in."""


@dataclass(frozen=True)
class Edit:
    """What is to be changed in a scene. Names may be patterns such as ``lamp*``; they apply in their order."""

    lamps: dict[str, LampEdit] = field(default_factory=dict)
    environment: EnvironmentEdit | None = None
    materials: dict[str, MaterialEdit] = field(default_factory=dict)
    objects: tuple[ObjectEdit, ...] = ()
    source: str = "--edit"
    """Begins the sentences about it."""

    @property
    def files(self) -> list[str]:
        """Files that it reads."""
        named = [self.environment.file] if self.environment is not None else []
        return [file for file in (*named, *(thing.file for thing in self.objects)) if file is not None]


@dataclass(frozen=True)
class Edited:
    """A scene after an edit. Meshes keep their places in the list; what was put in comes last."""

    scene: Scene
    base: Scene
    """The scene before."""
    painted: Mapping[str, frozenset[int]] = field(default_factory=dict)
    """By the name of a surface parameter: meshes that have what the scene's materials say, whatever was recovered."""
    said: tuple[str, ...] = ()
    """What was changed, a few words each."""
    reshaped: bool = False
    """Whether triangles moved or came: rays have to be traced against other ones."""


def lamps_of(scene: Scene) -> list[str]:
    """Names of the meshes that shine, then of the lights without extent that do, and of what moves with the camera."""
    shine = [mesh.name for mesh in scene.meshes if mesh.radiance is not None and float(mesh.radiance.max()) > 0.0]
    points = [light.name for light in scene.punctual if light.intensity.any()]
    return [*shine, *points, *([] if scene.flash is None else [scene.flash.name])]


def edited(scene: Scene, edit: Edit) -> Edited:
    """The scene with an edit applied.

    Raises:
        InputError: a name is none of a lamp or mesh, a file cannot be read, or no light is left.
    """
    work = _Work(scene, edit.source)
    for pattern, lamp in edit.lamps.items():
        work.lamp(pattern, lamp)
    if edit.environment is not None:
        work.environment(edit.environment)
    for pattern, material in edit.materials.items():
        work.material(pattern, material)
    for thing in edit.objects:
        work.put_in(thing)
    made = replace(work.scene, meshes=work.meshes, materials=work.materials, punctual=tuple(work.punctual))
    if not made.features.has_light:
        raise InputError(f"{edit.source}: it leaves no light in the scene, so every picture would be black")
    painted = {name: frozenset(meshes) for name, meshes in work.painted.items()}
    return Edited(made.check(), scene, painted, tuple(work.said), work.reshaped)


def coloured(radiance: FloatArray, color: Color) -> FloatArray:
    """Radiance [..., 3] of another colour with the luminance that it has."""
    weights = np.asarray(LUMINANCE)
    tint = np.asarray(color, np.float64)
    brightness = np.asarray(radiance, np.float64) @ weights
    made: FloatArray = (brightness[..., None] * (tint / float(tint @ weights))).astype(np.float32)
    return made


class _Work:
    """A scene while it is changed."""

    def __init__(self, scene: Scene, source: str) -> None:
        self.scene = scene
        self.source = source
        self.meshes: list[Mesh] = list(scene.meshes)
        self.materials: list[Material] = list(scene.materials)
        self.punctual: list[PunctualLight] = list(scene.punctual)
        self.painted: dict[str, set[int]] = {parameter.name: set() for parameter in PARAMETERS}
        self.said: list[str] = []
        self.reshaped = False

    def lamp(self, pattern: str, edit: LampEdit) -> None:
        flash, chosen = self.scene.flash, self._named(pattern, "lamp", lamps_of(self.scene))
        for index, light in enumerate(self.scene.punctual):
            if light.name in chosen and light.intensity.any():
                self._punctual(index, edit)
        if flash is not None and flash.name in chosen:
            train, test = ([self._flash(view, edit) for view in views] for views in (self.scene.train, self.scene.test))
            self.scene, self.said = replace(self.scene, train=train, test=test), list(dict.fromkeys(self.said))
        for index, there in enumerate(self.scene.meshes):
            if there.name not in chosen or there.radiance is None:
                continue
            mesh = self.meshes[index]
            now = there.radiance if mesh.radiance is None else mesh.radiance
            made = self._relit(mesh.name, now, edit, "radiance")
            self.meshes[index] = replace(mesh, radiance=made if made.any() else None)
            if any(edit.move):
                here = self.meshes[index]
                step = np.asarray(edit.move, np.float32)
                self.meshes[index] = replace(here, vertices=(here.vertices + step).astype(np.float32))
                self.said.append(f"lamp {mesh.name} moved by {_listed(step)}")
                self.reshaped = True

    def _flash(self, view: View, edit: LampEdit) -> View:
        """The view with another flash, where it has one."""
        flash = view.camera.flash
        if flash is None:
            return view
        if edit.radiance is not None or any(edit.move):
            raise InputError(f"{self.source}: lamps: the flash moves with the camera and has no radiance; give a scale")
        flash = replace(flash, intensity=self._relit(flash.name, flash.intensity, edit, "intensity"))
        return replace(view, camera=replace(view.camera, flash=flash))

    def _punctual(self, index: int, edit: LampEdit) -> None:
        """Change a light without extent. One that is off keeps its place in the list, without light."""
        light = self.punctual[index]
        if edit.radiance is not None:
            raise InputError(
                f"{self.source}: lamps: {shown(light.name)} is a {light.kind} light and has no radiance; give a scale"
            )
        now = light.intensity if light.intensity.any() else self.scene.punctual[index].intensity
        self.punctual[index] = replace(light, intensity=self._relit(light.name, now, edit, "intensity"))
        if any(edit.move):
            if light.kind == "directional":
                raise InputError(
                    f"{self.source}: lamps: {shown(light.name)} is a directional light, which has no place to move from"
                )
            step = np.asarray(edit.move, np.float32)
            self.punctual[index] = replace(self.punctual[index], position=(light.position + step).astype(np.float32))
            self.said.append(f"lamp {light.name} moved by {_listed(step)}")

    def _relit(self, name: str, now: FloatArray, edit: LampEdit, measure: str) -> FloatArray:
        """The light [3] that a lamp sends instead of ``now``, 0 where it is dark."""
        light = now if edit.radiance is None else np.asarray(edit.radiance, np.float32)
        light = light if edit.color is None else coloured(light, edit.color)
        light = (light * np.float32(edit.scale)).astype(np.float32)
        within(light, f"{self.source}: lamps: the {measure} of {shown(name)} then", 0.0, RADIANCE)
        if edit.off or not light.any():
            self.said.append(f"lamp {name} off")
            return np.zeros(3, np.float32)
        if not np.array_equal(light, now):
            self.said.append(f"lamp {name} {_listed(light)} instead of {_listed(now)}")
        return light

    def environment(self, edit: EnvironmentEdit) -> None:
        there = self.scene.environment
        if edit.off:
            self.scene = replace(self.scene, environment=None)
            self.said += [] if there is None else ["no environment"]
            return
        where = f"{self.source}: environment"
        if edit.file is not None:
            # In the frame of the scene's own or, where it has none, upright.
            pose = scene_up(self.scene, "y").astype(np.float32) if there is None else there.to_world
            there = EnvironmentMap(read_map(edit.file), pose)
            self.said.append(f"environment {edit.file}")
        if there is None:
            raise InputError(f"{where}: the scene has none to change; give it a file")
        pixels = there.pixels if edit.color is None else coloured(there.pixels, edit.color)
        pixels = (pixels * np.float32(edit.scale)).astype(np.float32)
        within(pixels, f"{where}: its radiance then", 0.0, RADIANCE)
        words = [] if edit.color is None else [f"of colour {_listed(edit.color)}"]
        words += [] if edit.scale == 1.0 else [f"{edit.scale:g} times as bright"]
        words += [] if edit.turn % 360.0 == 0.0 else [f"turned by {edit.turn:g} degrees"]
        made = turned_environment(replace(there, pixels=pixels), edit.turn)
        self.scene = replace(self.scene, environment=made)
        self.said += [f"environment {', '.join(words)}"] if words else []

    def material(self, pattern: str, edit: MaterialEdit) -> None:
        meant = self._named(pattern, "mesh", [mesh.name for mesh in self.scene.meshes])
        chosen = [i for i, mesh in enumerate(self.scene.meshes) if mesh.name in meant]
        for index in chosen:
            material = self.materials[self.meshes[index].material]
            glossy = next((name for name in edit if name != ALBEDO.name), None)
            if glossy is not None and (material.model.is_delta or material.model.is_diffuse):
                kind = "smooth" if material.model.is_delta else "diffuse"
                raise InputError(
                    f"{self.source}: materials: mesh {shown(self.meshes[index].name)} is {kind} and has no {glossy}"
                )
            self._paint(index, material, edit)
        changes = [f"{name} {_listed(value)}" for name, value in edit.items()]
        names = self.meshes[chosen[0]].name if len(chosen) == 1 else f"{len(chosen)} meshes {pattern}"
        if changes:
            self.said.append(f"{names} of {' and '.join(changes)}")

    def _paint(self, index: int, material: Material, edit: MaterialEdit) -> None:
        """A material of its own for a mesh, with the constants of an edit."""
        textures: dict[str, Any] = {name: Constant(np.asarray(value, np.float32)) for name, value in edit.items()}
        material = replace(material, **textures)
        for name in textures:
            self.painted[name].add(index)
        self.materials.append(replace(material, name=f"{material.name} of {self.meshes[index].name}"))
        self.meshes[index] = replace(self.meshes[index], material=len(self.materials) - 1)

    def put_in(self, thing: ObjectEdit) -> None:
        where = f"{self.source}: objects"
        parts = read_object(thing.file, where)
        meshes = placed([mesh for mesh, _ in parts], thing.placement, self.scene, f"{where}: {shown(thing.file)}")
        name = thing.name or Path(thing.file).stem
        taken = {mesh.name for mesh in self.meshes}
        for (_, textures), mesh in zip(parts, meshes, strict=True):
            label = make_unique(name if len(parts) == 1 else f"{name} {mesh.name}", taken)
            radiance = None if thing.radiance is None else np.asarray(thing.radiance, np.float32)
            self.materials.append(Material(label, PrincipledModel(), **textures))  # type: ignore[arg-type]
            self.meshes.append(replace(mesh, name=label, material=len(self.materials) - 1, radiance=radiance))
            index = len(self.meshes) - 1
            self._paint(index, self.materials[-1], thing.material)
            for painted in self.painted.values():
                painted.add(index)
        count = sum(len(mesh.faces) for mesh in meshes)
        self.said.append(f"{name} put in ({count} triangles)")
        self.reshaped = True

    def _named(self, pattern: str, what: str, names: Sequence[str]) -> set[str]:
        """Those of some names that a name or pattern means."""
        if found := {pattern} if pattern in names else {name for name in names if fnmatchcase(name, pattern)}:
            return found
        is_mesh = what == "lamp" and any(mesh.name == pattern for mesh in self.scene.meshes)
        near = None if is_mesh else nearest(pattern, names)
        hint = f"there are {listed(names) or 'none in this scene'}" if near is None else f"did you mean {shown(near)}?"
        wrong = f"mesh {shown(pattern)} is no lamp" if is_mesh else f"there is no {what} {shown(pattern)}"
        raise InputError(f"{self.source}: {'lamps' if what == 'lamp' else 'materials'}: {wrong}; {hint}")


def _listed(values: FloatArray | Sequence[float]) -> str:
    return ", ".join(f"{float(x):.4g}" for x in values)
