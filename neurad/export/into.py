"""``neurad export --into room.blend``: what was recovered, in the file that its room came from."""

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from neurad.assembly.build import Assembly
from neurad.assembly.relight import recovered_scene
from neurad.core.errors import InputError
from neurad.core.scene_records import Material
from neurad.evidence.error_bars import ErrorBars
from neurad.export.base_colour import conversion
from neurad.export.copies import Matcher, Painted, Surface, glow, mixed
from neurad.export.cycles import render_views
from neurad.export.into_blend import BlendRoom
from neurad.export.into_glb import GlbRoom
from neurad.export.layouts import Layout, lay_out
from neurad.export.run import ExportSettings, tell_verified
from neurad.export.texels import densities
from neurad.export.verify import not_rendered, path_traced, verify_copy
from neurad.formats.blender.import_blender import blend_file
from neurad.formats.blender.process import find_blender
from neurad.formats.gltf.read import read_scene
from neurad.metrics.seen import SeenBy
from neurad.runtime.extras import need
from neurad.runtime.files import replacing
from neurad.runtime.progress import Phase, phase, say
from neurad.runtime.reading import exists, listed, shown
from neurad.scene.origin import near

MATCHED = 0.5
"""Fraction of a file's surface that has to be that of the run."""
APART = 2.0 / 255.0
"""Difference of copies that is worth a sentence."""


def place_beside(source: Path) -> Path:
    """Where the copy of a file goes if nothing else is said: beside it."""
    return source.with_name(f"{source.stem}_recovered{source.suffix}")


def export_into(assembly: Assembly, source: Path, settings: ExportSettings, bars: ErrorBars | None) -> list[str]:
    """Write a copy of the file that a room came from, which is only read, with what was recovered on its own objects,
    and render it again.

    Returns:
        What that found beyond its bounds, in a sentence each; none if all is well.

    Raises:
        InputError: the file is missing, is none of Blender or glTF, or not the room of the run; there is no Blender;
            or the copy is there already or cannot be written.
    """
    need("xatlas", "export", "export: a texture atlas")
    place = settings.out
    check_free(place, source)
    scene, geometry = assembly.scene, assembly.world.geometry
    with tempfile.TemporaryDirectory(prefix="neurad-") as folder, phase("export") as bar:
        file = _opened(source, settings, Path(folder))
        density, seen = densities(assembly.world.tracer.tracer, geometry, scene, bar)
        of_room = float(density @ seen / seen.sum()) if seen.sum() > 0 else float(density.mean())
        parts = file.parts()
        bar.stage("texture coordinates", 1)
        layouts = lay_out(parts, of_room, settings.texels, settings.size, settings.group)
        match = Matcher(scene.meshes, geometry)
        surfaces, loose = file.opened(layouts, match, np.array(scene.origin))
        matched = match.known / max(match.area, 1e-30)
        if matched < MATCHED:
            raise InputError(
                f"--into {shown(source)}: it is not the room of the run, which has {100 * matched:.0f} % of its surface"
            )
        painted = _paint(assembly, surfaces, layouts, settings, bars, bar)
        with replacing(place, "--out") as part:
            notes = file.write(painted, assembly, part)
            check_free(place, source)
        if loose:
            notes.insert(0, f"left alone, as no recovered texture is for them: {listed(dict.fromkeys(loose))}")
        if matched < 1.0 - 1e-4:
            notes.append(f"{100 * (1.0 - matched):.1f} % of the surface has no counterpart in the run")
        _tell(place, surfaces, painted, notes)
        return _verify(assembly, file, settings, bar) if settings.verify else []


def _verify(assembly: Assembly, file: BlendRoom | GlbRoom, settings: ExportSettings, bar: Phase) -> list[str]:
    """Render the copy of a file again, by Cycles or, of glTF, by neurad, and say what was found."""
    place, run = settings.out, recovered_scene(assembly)
    why = not_rendered(run)
    if why is None and isinstance(file, GlbRoom) and settings.target == "gltf":
        why = "its base colours are for other programs (--for gltf)"
    if why is not None:
        say(f"nothing is rendered again: {why}")
        return []
    if isinstance(file, BlendRoom):
        program = partial(render_views, file.blender, place, transparent=assembly.world.hide_environment)
        verified = verify_copy(assembly, "cycles", program, settings.spp, bar)
    else:
        # What glTF does not hold, the world and how long paths are, is as the run has it.
        copy = near(replace(read_scene(place), test=[]), np.array(run.origin))
        copy = replace(copy, environment=run.environment, max_depth=run.max_depth, rr_depth=run.rr_depth)
        copy = copy.with_diffuse("lambert" if settings.target == "blender" else "burley")
        verified = verify_copy(assembly, "copy", path_traced(copy, assembly), settings.spp, bar)
    tell_verified(verified)
    for verdict in verified.verdicts:
        print(f"{verdict.text}: {verdict.state}")
    return verified.beyond


def check_free(place: Path, source: Path) -> None:
    """Refuse to write over anything, the file itself least of all."""
    if exists(place) or place.is_symlink():
        same = " is the file itself, which is only read" if place.resolve() == source.resolve() else " is there already"
        raise InputError(f"--out: {shown(place)}{same}; name another file by --out")


def _opened(source: Path, settings: ExportSettings, folder: Path) -> BlendRoom | GlbRoom:
    kind = source.suffix.lower()
    if kind == ".glb":
        if settings.blender is not None:
            raise InputError(f"--blender: {shown(source)} is glTF, Blender has nothing to do with it")
        return GlbRoom(source, settings.group)
    if kind != ".blend":
        raise InputError(f"--into {shown(source)}: it is neither a Blender file (.blend) nor binary glTF (.glb)")
    return BlendRoom(blend_file(source), find_blender(settings.blender), settings.group, folder)


def _paint(
    assembly: Assembly, surfaces: Sequence[Surface], layouts: Sequence[Layout], settings: ExportSettings,
    bars: ErrorBars | None, bar: Phase,
) -> list[Painted | None]:  # fmt: skip
    """The textures of all surfaces; None of those that stay as they are: mirrors, glass and what shines."""
    geometry, scene = assembly.world.geometry, recovered_scene(assembly)
    radiance = scene.radiance[geometry.mesh_index.numpy()]
    emits = (radiance > 0).any(-1)
    of_prim = geometry.material.numpy()
    area = geometry.face_area.numpy().astype(np.float64)
    kept: list[Material | None] = []
    for surface in surfaces:
        prims = surface.copies.prims
        by_material = np.bincount(of_prim[prims], area[prims], len(scene.materials)) if len(prims) else np.zeros(1)
        material = scene.materials[int(by_material.argmax())]
        plain = len(prims) > 0 and not material.model.is_delta and not emits[prims].all()
        kept.append(material if plain else None)
    sides = [
        layouts[surface.layout].side for surface, material in zip(surfaces, kept, strict=True)
        if material is not None and surface.layout is not None
    ]  # fmt: skip
    sizes = ", ".join(f"{sides.count(side)} of {side} x {side}" for side in sorted(set(sides), reverse=True))
    texels = sum(side**2 for side in sides)
    print(f"{shown(settings.out)}: {len(sides)} textures ({sizes}), {texels / 1e6:.2f} M texels")
    seen_by = SeenBy.of(geometry, assembly.world.tracer.tracer, scene.train)
    bar.stage("textures", len(surfaces))
    painted: list[Painted | None] = []
    for surface, known in zip(surfaces, kept, strict=True):
        paint, copies = None, surface.copies
        if known is not None:
            side = 0 if surface.layout is None else layouts[surface.layout].side
            shines = emits[copies.prims].any()
            lit = glow(copies, side, radiance) if shines and copies.uvs is not None else None
            if shines and lit is None:
                print(f"{surface.name}: a part of it shines, which its one value cannot say; the copy is darker there")
            texture = mixed(copies, side, assembly, seen_by, bars)
            paint = Painted(known, *texture, *conversion(known, settings.target), lit)
        painted.append(paint)
        bar.step()
    return painted


def _tell(place: Path, surfaces: Sequence[Surface], painted: Sequence[Painted | None], notes: Sequence[str]) -> None:
    known = [(surface.name, paint) for surface, paint in zip(surfaces, painted, strict=True) if paint is not None]
    shared = [(name, paint) for name, paint in known if paint.layers > 1]
    print(f"{shown(place)}: {len(known)} materials, {place.stat().st_size / 1e6:.1f} MB")
    if shared:
        apart = max(paint.apart for _, paint in shared)
        print(f"{len(shared)} of them are on copies that share texels, which have the mean by what is known of each; "
              f"their albedo differs by {apart:.3f} at most (rms)")  # fmt: skip
        far = sorted((t for t in shared if t[1].apart > APART), key=lambda t: -t[1].apart)
        if far:
            print(f"most: {listed(f'{name} ({t.layers} copies, {t.apart:.3f})' for name, t in far)}")
    for note in notes:
        print(note)
