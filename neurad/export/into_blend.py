"""The Blender file that a room came from, with what was recovered on its own objects."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neurad.assembly.build import Assembly
from neurad.assembly.relight import recovered_scene
from neurad.core.errors import InputError
from neurad.core.names import make_unique
from neurad.core.records import Array, FloatArray, IntArray
from neurad.core.reflection import PrincipledModel
from neurad.core.scene_records import Mesh
from neurad.export.base_colour import BY_ANGLES, write_over_angles
from neurad.export.blender import INTO_ROOM
from neurad.export.copies import Copies, Matcher, Painted, Part, Surface
from neurad.export.layouts import Group, Layout, Polygons
from neurad.formats.blender.cameras_and_lamps import lamp_of
from neurad.formats.blender.process import Blender
from neurad.formats.blender.script import WRITE_ROOM
from neurad.images.image_io import write_exr
from neurad.runtime.reading import exists, listed, read_json, shown

SAME_LIGHT = 1e-3
"""Relative difference of a radiance to the file's up to which it is left as it is."""


class BlendRoom:
    """A Blender file."""

    def __init__(self, source: Path, blender: Blender, group: Group, folder: Path) -> None:
        self.source, self.blender, self.group, self.folder = source, blender, group, folder
        self.found: dict[str, Any] = {}
        self.laid: dict[str, Any] = {}
        self.members: list[list[tuple[str, IntArray]]] = []
        self.surfaces: list[Surface] = []
        self.job: dict[str, Any] = {
            "path": [str(INTO_ROOM.parent), str(WRITE_ROOM.parent)], "out": str(folder),
            "blend": str(source), "part": str(folder / "part.blend"),
        }  # fmt: skip

    def _do(self, what: str, **more: Any) -> Any:
        """A step of ``into_room.py``."""
        self.job |= {**more, "do": what, "answer": str(self.folder / f"{what}.json")}
        job = self.folder / f"{what}-job.json"
        job.write_text(json.dumps(self.job), encoding="utf-8")
        said = self.blender.run(INTO_ROOM, [str(job)])
        if not exists(self.folder / f"{what}.json"):
            raise InputError(f"--into {shown(self.source)}: Blender {self.blender.version} fails with it ({said})")
        return read_json(self.folder / f"{what}.json")

    def parts(self) -> list[list[Polygons]]:
        """Parts of its meshes, those together that share a texture."""
        self.found = self._do("read")
        if not self.found["meshes"]:
            raise InputError(f"--into {shown(self.source)}: its scene shows no mesh of its own")
        number_of: dict[Any, int] = {}
        groups: list[list[Polygons]] = []
        for name, mesh in self.found["meshes"].items():
            arrays = np.load(self.folder / mesh["file"])
            slot = np.clip(arrays["slot"], 0, len(mesh["slots"]) - 1)
            mesh["layouts"] = [None] * len(mesh["slots"])
            for number in np.unique(slot).tolist():
                material = mesh["slots"][number]
                key = material if self.group == "material" and material else (name, number)
                if key not in number_of:
                    number_of[key] = len(groups)
                    groups.append([])
                    self.members.append([])
                index = mesh["layouts"][number] = number_of[key]
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

    def opened(self, layouts: Sequence[Layout], match: Matcher, origin: Array) -> tuple[list[Surface], list[str]]:
        """What it shows with these coordinates, matched with the run, and things whose material no texture is for."""
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
        of = {entry["material"]: number for number, entry in enumerate(self.laid["made"])}
        names: list[str] = self.laid["materials"]
        parts: list[list[Part]] = [[] for _ in of]
        loose: list[str] = []
        arrays = {file: dict(np.load(self.folder / file)) for file in {t["mesh"] for t in self.laid["objects"]}}
        for number, thing in enumerate(self.laid["objects"]):
            mesh, slots = arrays[thing["mesh"]], thing["materials"]
            for slot in np.unique(mesh["material"]).tolist():
                index = of.get(names[slots[min(max(slot, 0), len(slots) - 1)]])
                chosen = mesh["material"] == slot
                uv = thing["uvs"].get(self.laid["made"][index]["uv"]) if index is not None else None
                points, uvs = mesh["vertices"][mesh["faces"][chosen]], None if uv is None else mesh[uv][chosen]
                part = match.part(points, uvs, np.array(thing["to_world"], np.float64), origin, number)
                if index is not None:
                    parts[index].append(part)
                elif thing["name"] not in self.found["linked"]:
                    loose.append(thing["name"])
        for entry, found in zip(self.laid["made"], parts, strict=True):
            copies = Copies.joined(found)
            name, at = f"{entry['object']} ({entry['material']})", None if copies.uvs is None else entry["layout"]
            self.surfaces.append(Surface(name, at, copies))
        return self.surfaces, loose

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
        if any(paint is not None and (paint.target, paint.lobe) == BY_ANGLES for paint in painted):
            table = "over_angles.exr"
            write_over_angles(self.folder / table)
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
        notes = ["Cycles' light paths are set as the run has them: no clamping, all bounces"]
        if self.found["linked"] or self.found["libraries"]:
            linked = f": {listed(self.found['linked'])}" if self.found["linked"] else ""
            notes.append(f"linked libraries are left alone ({listed(self.found['libraries'])}){linked}")
        return notes

    def _surface(self, name: str, paint: Painted, taken: set[str]) -> dict[str, Any]:
        """What ``into_room.py`` reads of a material."""
        model = paint.material.model
        surface: dict[str, Any] = {
            "ior": model.eta if isinstance(model, PrincipledModel) else 1.5, "diffuse": model.is_diffuse,
            "converted": (paint.target, paint.lobe) == BY_ANGLES, "two_sided": paint.material.two_sided,
        }  # fmt: skip
        files = paint.files(upwards=True)
        if files is None:
            colour, roughness, metallic = paint.values()
            return surface | {"colour": colour, "roughness": roughness, "metallic": metallic}
        stem = make_unique("".join(c if c.isalnum() or c in "-_" else "_" for c in name), taken, "_", capitals=False)
        for key, data in (("base", files.base), ("orm", files.orm)):
            surface[key] = f"{stem}_{'base_color' if key == 'base' else 'orm'}.png"
            (self.folder / surface[key]).write_bytes(data)
        if (lit := paint.emission(upwards=True)) is not None:
            surface |= {"emission": f"{stem}_emission.png", "strength": lit[1]}
            (self.folder / surface["emission"]).write_bytes(lit[0])
        return surface

    def _lamps(self, assembly: Assembly) -> dict[str, list[float]]:
        """By how much lamps that a fit found shine more than in the file, by name."""
        factors: dict[str, list[float]] = {}
        match, found = Matcher(assembly.scene.meshes, assembly.world.geometry), recovered_scene(assembly)
        for described in self.laid["lamps"] if assembly.lamps is not None else ():
            lamp = lamp_of(described, 0, shown(self.source), [])
            if not isinstance(lamp, Mesh) or lamp.radiance is None or not (lamp.radiance > 0).any():
                continue
            points = lamp.vertices[lamp.faces].astype(np.float64) - np.array(assembly.scene.origin)
            prims, before = match(points)[0], lamp.radiance
            known = prims[prims >= 0][:1].tolist()
            after = found.meshes[int(assembly.world.geometry.mesh_index[known[0]])].radiance if known else None
            if after is not None:
                factor = np.where(before > 0, after / np.maximum(before, 1e-30), 0.0)
                if np.abs(factor - 1.0)[before > 0].max() > SAME_LIGHT and factor.max() > 0:
                    factors[described["name"]] = factor.tolist()
        return factors

    def _emission(self, assembly: Assembly) -> dict[str, list[float]]:
        """Radiance of what a fit found to shine otherwise than in the file, by the name of its material."""
        found: dict[str, list[float]] = {}
        for entry, surface in zip(self.laid["made"], self.surfaces, strict=True) if assembly.lamps is not None else ():
            prims = surface.copies.prims
            if entry["surface"] is None and entry["old"] is not None and len(prims):
                index = int(assembly.world.geometry.mesh_index[int(prims[0])])
                before, after = (of.meshes[index].radiance for of in (assembly.scene, recovered_scene(assembly)))
                if after is not None and (before is None or not np.allclose(before, after, rtol=SAME_LIGHT)):
                    found[entry["material"]] = after.tolist()
        return found
