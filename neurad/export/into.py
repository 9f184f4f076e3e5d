"""``neurad export --into room.blend``: what was recovered, in the file that its room came from."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from neurad.assembly.build import Assembly
from neurad.assembly.relight import recovered_scene
from neurad.core.errors import InputError
from neurad.core.names import make_unique
from neurad.core.parameters import PARAMETERS
from neurad.core.records import FloatArray, IntArray, Material, Mesh
from neurad.core.reflection import PrincipledModel
from neurad.evidence.error_bars import ErrorBars
from neurad.export.atlas import require_xatlas
from neurad.export.base_colour import Target, base_for, is_converted, over_angles
from neurad.export.blender import into_room_path
from neurad.export.charts import triangle_areas
from neurad.export.copies import Copies, Matcher, Mixed, mixed
from neurad.export.images import Coded, coded
from neurad.export.layouts import Group, Layout, Polygons, lay_out, said_sizes
from neurad.export.progress import StageProgress
from neurad.export.raster_kernels import Array
from neurad.export.run import ExportSettings
from neurad.export.texels import densities
from neurad.formats.blender.import_blender import blend_file
from neurad.formats.blender.lamps import lamp_of
from neurad.formats.blender.process import Blender, find_blender
from neurad.formats.blender.script import write_room_path
from neurad.images.image_io import write_exr
from neurad.metrics.seen import SeenBy
from neurad.runtime.files import replacing
from neurad.runtime.reading import exists, listed, read_json, shown

MATCHED = 0.5
"""Fraction of a file's surface that has to be that of the run."""
SAME_LIGHT = 1e-3
"""Relative difference of a radiance to the file's up to which it is left as it is."""
APART = 2.0 / 255.0
"""Difference of copies that is worth a sentence."""


@dataclass(frozen=True)
class Surface:
    """What a texture of a file is for."""

    name: str
    layout: int | None
    """Number of its layout; None where one value has to do."""
    copies: Copies


@dataclass(frozen=True)
class Opened:
    """What a file shows, once its parts have texture coordinates."""

    surfaces: list[Surface]
    loose: list[str]
    """Things whose material none of the textures is for."""
    matched: float
    """Fraction of the area that the run has, too."""


class RoomFile(Protocol):
    """A file that a room came from."""

    def parts(self) -> list[list[Polygons]]:
        """Parts of its meshes, those together that share a texture."""

    def opened(self, layouts: Sequence[Layout], match: Matcher, origin: Array) -> Opened:
        """What it shows with these coordinates, matched with the run."""

    def write(self, painted: Sequence[Painted | None], assembly: Assembly, part: Path) -> list[str]:
        """Write the file; returns sentences about what it cannot hold."""


@dataclass(frozen=True)
class Painted:
    """The material of a surface."""

    material: Material
    """By its model; its textures are not read."""
    texture: Mixed
    target: Target
    """Whose base colours it gets."""

    def files(self, upwards: bool = False) -> Coded | None:
        """Its textures; None where one value has to do.

        Args:
            upwards: v = 0 is the lowest row of a picture, not the highest.
        """
        if self.texture.baked.pixels.shape[:2] == (1, 1):
            return None
        return coded({key: x[::-1] if upwards else x for key, x in self.texture.baked.maps.items()}, self.target)

    def values(self) -> tuple[list[float], float, float]:
        """Base colour, roughness and metalness of the first texel."""
        albedo, roughness, metallic = (
            self.texture.baked.maps.get(p.name, np.full((1, 1, p.channels), p.absent))[:1, :1].astype(np.float32)
            for p in PARAMETERS
        )
        base = np.clip(base_for(self.target, albedo, roughness), 0.0, 1.0)
        return [float(x) for x in base.ravel()], roughness.item(), metallic.item()


def place_beside(source: Path) -> Path:
    """Where the copy of a file goes if nothing else is said: beside it."""
    return source.with_name(f"{source.stem}_recovered{source.suffix}")


def export_into(assembly: Assembly, source: Path, settings: ExportSettings, bars: ErrorBars | None) -> None:
    """Write a copy of the file that a room came from, with what was recovered on its own objects.

    Args:
        assembly: of the run, on the CPU.
        source: the file; it is only read.
        settings: what to write, and where.
        bars: error bars of the run.

    Raises:
        InputError: the file is missing, is none of Blender or glTF, or not the room of the run; there is no Blender;
            or the copy is there already or cannot be written.
    """
    require_xatlas()
    place = settings.out
    check_free(place, source)
    bar = StageProgress()
    scene, geometry = assembly.scene, assembly.world.geometry
    with tempfile.TemporaryDirectory(prefix="neurad-") as folder:
        try:
            file = _opened(source, settings, Path(folder))
            density, seen = densities(assembly.world.tracer.tracer, geometry, scene, bar)
            of_room = float(density @ seen / seen.sum()) if seen.sum() > 0 else float(density.mean())
            parts = file.parts()
            bar.stage("texture coordinates", 1)
            layouts = lay_out(parts, of_room, settings.texels, settings.size, settings.group)
            found = file.opened(layouts, Matcher(geometry), np.array(scene.origin))
            if found.matched < MATCHED:
                raise InputError(
                    f"--into {shown(source)}: it is not the room of the run, which has {100 * found.matched:.0f} % of "
                    "its surface"
                )
            painted = _paint(assembly, found, layouts, settings.target, bars, bar, place)
            bar.close()
            with replacing(place, "--out") as part:
                notes = file.write(painted, assembly, part)
                check_free(place, source)
        finally:
            bar.close()
    _tell(place, found, painted, notes)


def check_free(place: Path, source: Path) -> None:
    """Refuse to write over anything, the file itself least of all.

    Raises:
        InputError: there is something.
    """
    if exists(place) or place.is_symlink():
        same = " is the file itself, which is only read" if place.resolve() == source.resolve() else " is there already"
        raise InputError(f"--out: {shown(place)}{same}; name another file by --out")


def _opened(source: Path, settings: ExportSettings, folder: Path) -> RoomFile:
    """The file, by its kind."""
    from neurad.export.into_glb import GlbRoom
    from neurad.formats.gltf.read import ENDINGS

    if source.suffix.lower() in ENDINGS:
        if settings.blender is not None:
            raise InputError(f"--blender: {shown(source)} is glTF, Blender has nothing to do with it")
        return GlbRoom(source, settings.group)
    if source.suffix.lower() != ".blend":
        raise InputError(f"--into {shown(source)}: it is neither a Blender file (.blend) nor glTF (.glb)")
    return BlendRoom(blend_file(source), find_blender(settings.blender), settings.group, folder)


def _paint(
    assembly: Assembly, found: Opened, layouts: Sequence[Layout], target: Target, bars: ErrorBars | None,
    bar: StageProgress, place: Path,
) -> list[Painted | None]:  # fmt: skip
    """The textures of all surfaces; None of those that stay as they are: mirrors, glass and what shines."""
    geometry, scene = assembly.world.geometry, recovered_scene(assembly)
    emits = (geometry.emission > 0).any(-1).numpy()
    of_prim = geometry.material.numpy()
    area = geometry.face_area.numpy().astype(np.float64)
    kept: list[Material | None] = []
    for surface in found.surfaces:
        prims = surface.copies.prims
        by_material = np.bincount(of_prim[prims], area[prims], len(scene.materials)) if len(prims) else np.zeros(1)
        material = scene.materials[int(by_material.argmax())]
        plain = len(prims) > 0 and not material.model.is_delta and not emits[prims].all()
        kept.append(material if plain else None)
    used = [
        layouts[surface.layout] for surface, material in zip(found.surfaces, kept, strict=True)
        if material is not None and surface.layout is not None
    ]  # fmt: skip
    texels = sum(layout.side**2 for layout in used)
    print(f"{shown(place)}: {len(used)} textures ({said_sizes(used)}), {texels / 1e6:.2f} M texels")
    seen_by = SeenBy.of(geometry, assembly.world.tracer.tracer, scene.train)
    bar.stage("textures", 2 * texels)
    painted: list[Painted | None] = []
    for surface, known in zip(found.surfaces, kept, strict=True):
        if known is None:
            painted.append(None)
            continue
        side = 0 if surface.layout is None else layouts[surface.layout].side
        texture = mixed(surface.copies, side, assembly, seen_by, bars, bar.step)
        painted.append(Painted(known, texture, target if is_converted(known) else "exact"))
    return painted


def _tell(place: Path, found: Opened, painted: Sequence[Painted | None], notes: Sequence[str]) -> None:
    """Say what was written, what shares texels, and what was left alone."""
    mixes = [(s.name, p.texture) for s, p in zip(found.surfaces, painted, strict=True) if p is not None]
    shared = [(name, texture) for name, texture in mixes if texture.layers > 1]
    print(f"{shown(place)}: {len(mixes)} materials, {place.stat().st_size / 1e6:.1f} MB")
    if shared:
        apart = max(texture.apart for _, texture in shared)
        print(f"{len(shared)} of them are on copies that share texels, which have the mean by what is known of each; "
              f"their albedo differs by {apart:.3f} at most (rms)")  # fmt: skip
        far = sorted((t for t in shared if t[1].apart > APART), key=lambda t: -t[1].apart)
        if far:
            print(f"most: {listed(f'{name} ({t.layers} copies, {t.apart:.3f})' for name, t in far)}")
    if found.loose:
        print(f"left alone, as no recovered texture is for them: {listed(dict.fromkeys(found.loose))}")
    if found.matched < 1.0 - 1e-4:
        print(f"{100 * (1 - found.matched):.1f} % of the surface has no counterpart in the run")
    for note in notes:
        print(note)


class BlendRoom:
    """A Blender file.

    Args:
        source: the file.
        blender: opens it.
        group: what shares a texture.
        folder: for what is written on the way.
    """

    def __init__(self, source: Path, blender: Blender, group: Group, folder: Path) -> None:
        self.source, self.blender, self.group, self.folder = source, blender, group, folder
        self.found: dict[str, Any] = {}
        self.laid: dict[str, Any] = {}
        self.members: list[list[tuple[str, IntArray]]] = []
        self.surfaces: list[Surface] = []
        self.job: dict[str, Any] = {
            "path": [str(into_room_path().parent), str(write_room_path().parent)], "out": str(folder),
            "blend": str(source), "part": str(folder / "part.blend"),
        }  # fmt: skip

    def _do(self, what: str, **more: Any) -> Any:
        """A step of ``into_room.py``."""
        self.job |= {**more, "do": what, "answer": str(self.folder / f"{what}.json")}
        job = self.folder / f"{what}-job.json"
        job.write_text(json.dumps(self.job), encoding="utf-8")
        said = self.blender.run(into_room_path(), [str(job)])
        if not exists(self.folder / f"{what}.json"):
            raise InputError(f"--into {shown(self.source)}: Blender {self.blender.version} fails with it ({said})")
        return read_json(self.folder / f"{what}.json")

    def parts(self) -> list[list[Polygons]]:
        """Parts of its meshes, those together that share a texture."""
        self.found = self._do("read")
        if not self.found["meshes"]:
            raise InputError(f"--into {shown(self.source)}: its scene shows no mesh of its own")
        keys: dict[Any, int] = {}
        groups: list[list[Polygons]] = []
        for name, mesh in self.found["meshes"].items():
            arrays = np.load(self.folder / mesh["file"])
            slot = np.clip(arrays["slot"], 0, len(mesh["slots"]) - 1)
            mesh["layouts"] = [None] * len(mesh["slots"])
            for number in np.unique(slot).tolist():
                material = mesh["slots"][number]
                key = material if self.group == "material" and material else (name, number)
                index = keys.setdefault(key, len(groups))
                if index == len(groups):
                    groups.append([])
                    self.members.append([])
                mesh["layouts"][number] = index
                faces = np.flatnonzero(slot == number)
                uvs = arrays["uv"].astype(np.float32) if "uv" in arrays and np.isfinite(arrays["uv"]).all() else None
                groups[index].append(Polygons(
                    arrays["vertices"][arrays["vertex"]] * np.float32(mesh["scale"]),
                    arrays["corners"][faces].astype(np.int64), arrays["polygon"][faces], uvs,
                ))  # fmt: skip
                self.members[index].append((name, faces))
        full = [name for name, mesh in self.found["meshes"].items() if mesh["full"]]
        if full:
            raise InputError(f"--into {shown(self.source)}: {listed(full)}: no mesh may have more than 8 UV maps, and "
                             "the textures need one; take one away")  # fmt: skip
        return groups

    def opened(self, layouts: Sequence[Layout], match: Matcher, origin: Array) -> Opened:
        """What it shows with these coordinates, matched with the run."""
        second: dict[str, FloatArray] = {}
        for layout, members in zip(layouts, self.members, strict=True):
            for uvs, (name, _) in zip(layout.uvs, members, strict=bool(layout.uvs)):
                if uvs is not None:
                    before = second.setdefault(name, np.zeros_like(uvs))
                    second[name] = np.where(np.isnan(uvs), before, uvs)
        jobs = {}
        for number, (name, mesh) in enumerate(self.found["meshes"].items()):
            file = None
            if name in second:
                file = str(self.folder / f"second{number:05d}.npy")
                np.save(file, second[name].astype(np.float32))
            jobs[name] = {"file": file, "layouts": mesh["layouts"]}
        own = [all(uvs is None for uvs in layout.uvs) for layout in layouts]
        constant = [layout.side == 0 for layout in layouts]
        self.laid = self._do("lay", meshes=jobs, objects=self.found["objects"], own=own, constant=constant)
        return self._matched(match, origin)

    def _matched(self, match: Matcher, origin: Array) -> Opened:
        """The triangles of all instances by what textures are for, with those of the run."""
        of = {entry["material"]: number for number, entry in enumerate(self.laid["made"])}
        names, parts = self.laid["materials"], [[] for _ in of]  # type: ignore[var-annotated]
        loose, area, known = [], 0.0, 0.0
        arrays = {file: dict(np.load(self.folder / file)) for file in {t["mesh"] for t in self.laid["objects"]}}
        for number, thing in enumerate(self.laid["objects"]):
            mesh, slots = arrays[thing["mesh"]], thing["materials"]
            pose = np.array(thing["to_world"], np.float64)
            for slot in np.unique(mesh["material"]).tolist():
                index = of.get(names[slots[min(max(slot, 0), len(slots) - 1)]])
                chosen = mesh["material"] == slot
                points = mesh["vertices"][mesh["faces"][chosen]].astype(np.float64)
                points = points @ pose[:3, :3].T + pose[:3, 3] - origin
                uv = thing["uvs"].get(self.laid["made"][index]["uv"]) if index is not None else None
                uvs = None if uv is None else mesh[uv][chosen].astype(np.float64)
                if np.linalg.det(pose[:3, :3]) < 0:  # it is wound the other way round
                    points, uvs = points[:, [0, 2, 1]], None if uvs is None else uvs[:, [0, 2, 1]]
                prims, order = match(points)
                sizes = triangle_areas(points)
                area, known = area + float(sizes.sum()), known + float(sizes[prims >= 0].sum())
                if index is None:
                    loose += [] if thing["name"] in self.found["linked"] else [thing["name"]]
                    continue
                good = np.flatnonzero((prims >= 0) & (sizes > 0))
                row = np.arange(len(good))[:, None]
                parts[index].append((
                    points[good][row, order[good]], None if uvs is None else uvs[good][row, order[good]], prims[good],
                    np.full(len(good), number),
                ))  # fmt: skip
        surfaces = []
        for entry, found in zip(self.laid["made"], parts, strict=True):
            copies = Copies.joined(found)
            layout = None if copies.uvs is None else entry["layout"]
            surfaces.append(Surface(f"{entry['object']} ({entry['material']})", layout, copies))
        self.surfaces = surfaces
        return Opened(surfaces, loose, known / max(area, 1e-30))

    def write(self, painted: Sequence[Painted | None], assembly: Assembly, part: Path) -> list[str]:
        """Write the file; returns sentences about what it cannot hold."""
        taken: set[str] = set()
        kept = set()
        for entry, paint in zip(self.laid["made"], painted, strict=True):
            entry["surface"] = None if paint is None else self._surface(entry["material"], paint, taken)
            kept |= {entry["layout"]} if paint is not None and entry["uv"] == self.laid["second"] else set()
        for mesh in self.job["meshes"].values():
            mesh["used"] = any(layout in kept for layout in mesh["layouts"])
        table = None
        if any(paint is not None and paint.target == "blender" for paint in painted):
            table = "over_angles.exr"
            rows = np.repeat(over_angles()[::-1, :, None], 3, -1)
            write_exr(self.folder / table, np.ascontiguousarray(rows), half=False)
        scene = recovered_scene(assembly)
        environment = None
        if assembly.environment is not None and scene.environment is not None:
            write_exr(self.folder / "recovered_world.exr", scene.environment.pixels, half=False)
            turned = np.asarray(scene.environment.to_world, float)[:3, :3].tolist()
            environment = {"file": "recovered_world.exr", "to_world": turned}
        saved = part.with_name(f".{part.stem}.blend")
        try:
            self._do(
                "paint", made=self.laid["made"], second=self.laid["second"], base_color_over_angles=table,
                environment=environment, to_y=[[1, 0, 0], [0, 0, 1], [0, -1, 0]], max_depth=scene.max_depth,
                lamps=self._lamps(assembly), emission=self._emission(assembly), save=str(saved),
            )  # fmt: skip
            saved.replace(part)
        finally:
            saved.unlink(missing_ok=True)
        return self._notes()

    def _surface(self, name: str, paint: Painted, taken: set[str]) -> dict[str, Any]:
        """What ``into_room.py`` is told of a material."""
        model = paint.material.model
        surface: dict[str, Any] = {
            "ior": model.eta if isinstance(model, PrincipledModel) else 1.5, "diffuse": model.is_diffuse,
            "converted": paint.target == "blender", "two_sided": paint.material.two_sided,
        }  # fmt: skip
        files = paint.files(upwards=True)
        if files is None:
            colour, roughness, metallic = paint.values()
            return surface | {"colour": colour, "roughness": roughness, "metallic": metallic}
        stem = make_unique("".join(c if c.isalnum() or c in "-_" else "_" for c in name), taken, "_", capitals=False)
        for key, data in (("base", files.base), ("orm", files.orm)):
            surface[key] = f"{stem}_{'base_color' if key == 'base' else 'orm'}.png"
            (self.folder / surface[key]).write_bytes(data)
        return surface

    def _lamps(self, assembly: Assembly) -> dict[str, list[float]]:
        """By how much lamps that a fit found shine more than in the file, by name."""
        factors: dict[str, list[float]] = {}
        match = Matcher(assembly.world.geometry)
        for described in self.laid["lamps"] if assembly.lamps is not None else ():
            lamp = lamp_of(described, 0, shown(self.source), [])
            if isinstance(lamp, Mesh) and lamp.radiance is not None:
                points = lamp.vertices[lamp.faces].astype(np.float64) - np.array(assembly.scene.origin)
                factor = self._factor(assembly, match(points)[0], lamp.radiance)
                factors |= {} if factor is None else {described["name"]: factor}
        return factors

    def _factor(self, assembly: Assembly, prims: IntArray, before: FloatArray) -> list[float] | None:
        """Radiance of triangles over that of the file [3]; None where it is the same, or nothing is known."""
        prims = prims[prims >= 0]
        if len(prims) == 0:
            return None
        mesh = recovered_scene(assembly).meshes[int(assembly.world.geometry.mesh_index[int(prims[0])])]
        if mesh.radiance is None or not (before > 0).any():
            return None
        factor = np.where(before > 0, mesh.radiance / np.maximum(before, 1e-30), 0.0)
        same = np.abs(factor - 1.0)[before > 0].max() <= SAME_LIGHT
        return None if same or factor.max() <= 0 else [float(x) for x in factor]

    def _emission(self, assembly: Assembly) -> dict[str, list[float]]:
        """Radiance of materials that a fit found to shine otherwise than in the file, by name."""
        found: dict[str, list[float]] = {}
        for entry, surface in zip(self.laid["made"], self.surfaces, strict=True) if assembly.lamps is not None else ():
            prims = surface.copies.prims
            if entry["surface"] is None and entry["old"] is not None and len(prims):
                index = int(assembly.world.geometry.mesh_index[int(prims[0])])
                before, after = (of.meshes[index].radiance for of in (assembly.scene, recovered_scene(assembly)))
                if after is not None and (before is None or not np.allclose(before, after, rtol=SAME_LIGHT)):
                    found[entry["old"]] = [float(x) for x in after]
        return found

    def _notes(self) -> list[str]:
        notes = ["Cycles' light paths are set as the run has them: no clamping, all bounces"]
        if self.found["linked"] or self.found["libraries"]:
            linked = f": {listed(self.found['linked'])}" if self.found["linked"] else ""
            notes.append(f"linked libraries are left alone ({listed(self.found['libraries'])}){linked}")
        return notes
