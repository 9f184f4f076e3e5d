"""``neurad export``: from the parts of a run to a folder with the room in it."""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

import neurad
from neurad.assembly.build import Assembly
from neurad.core.errors import InputError
from neurad.core.ranges import Count, Texels, TextureSide, checked
from neurad.core.scene_records import PunctualLight
from neurad.evidence.error_bars import ErrorBars
from neurad.export.bake import BakedRoom
from neurad.export.baking import bake_room
from neurad.export.base_colour import BY_ANGLES, Target, conversion, for_mitsuba, is_converted, write_over_angles
from neurad.export.blender import BLENDER_SETUP
from neurad.export.cycles import render_views
from neurad.export.evidence import COARSER, write_evidence
from neurad.export.folder import MANIFEST, check_out, check_sources, written_beside
from neurad.export.gltf import write_glb
from neurad.export.layouts import Group
from neurad.export.report import write_report
from neurad.export.verified import Verified
from neurad.export.verify import not_rendered, verify
from neurad.formats.axes import Up, rotation
from neurad.formats.blender.process import find_blender
from neurad.formats.cameras.write import NO_LENS, files_of, is_plain, shown_alike, write_views
from neurad.formats.mitsuba.plugin import NOT_ALONE, cannot_hide, hides_alone, sensor
from neurad.formats.mitsuba.write import describe, path_integrator, write_xml
from neurad.runtime.progress import Phase, phase, say
from neurad.runtime.reading import listed
from neurad.scene.punctual import pose

_OVER_ANGLES = "base_color_over_angles.exr"
NO_USD = "room.usdc: the package usd-core is missing (pip install 'neurad[usd]')"
NO_BARS = "error bars: the run folder has none of this checkpoint; neurad test writes them"


@dataclass(frozen=True)
class ExportSettings:
    """What to write, and where."""

    out: Path
    """Folder to write."""
    target: Target = "blender"
    """Whose base colours ``scene.glb`` gets."""
    texels: Texels = 16_000_000
    """Most texels of all textures together."""
    size: TextureSide | None = None
    """Side of every texture, a power of two, instead of what each mesh needs."""
    up: Up | None = None
    """Axis that points up; None takes the one that the cameras hold up."""
    copy: bool = False
    """Copy photographs and true maps instead of linking to them."""
    overwrite: bool = False
    verify: bool = True
    spp: Count = 16
    """Samples a pixel of the pictures that verify, in each of several passes."""
    blender: str | None = None
    """A Python that has bpy, or Blender itself."""
    into: Path | None = None
    """The file that the room came from: ``out`` is a copy of it then, see :mod:`neurad.export.into`."""
    group: Group = "mesh"
    """What shares a texture in such a copy."""

    def __post_init__(self) -> None:
        """Refuse what cannot be written."""
        checked(self)
        if self.size is not None and self.size & (self.size - 1):
            raise InputError(f"--size: {self.size} is no power of two between 8 and 8192")
        if self.into is not None and (self.overwrite or self.copy or self.up is not None):
            raise InputError(
                "--overwrite, --copy and --up are about a folder; --into writes a file that is not there yet"
            )
        if self.into is None and self.group != "mesh":
            raise InputError("--group: it is about textures in a file that --into names; give that, too")
        if self.blender is not None and not self.verify and self.into is None:
            raise InputError("--blender: it verifies, which --no-verify leaves out; give one of them")


def export(assembly: Assembly, checkpoint: Path, settings: ExportSettings, bars: ErrorBars | None = None) -> list[str]:
    """Write what a run recovered as a folder that other programs read, and verify it.

    Args:
        assembly: of the run, on the CPU.
        checkpoint: where it comes from, for the folder's notes.
        bars: error bars of the run; None leaves their maps out, and says so.

    Returns:
        What the verification found beyond its bounds, in a sentence each; none if all is well.

    Raises:
        InputError: something is missing, cannot be baked or cannot be written.
    """
    check_out(settings.out, settings.overwrite)
    check_sources(settings.out, [checkpoint, *files_of(assembly.scene)])
    blender = None if settings.blender is None else find_blender(settings.blender)
    start = time.perf_counter()
    with phase("export") as bar:
        room = bake_room(assembly, settings.texels, settings.size, settings.up, bar)
        baked = time.perf_counter()
        with written_beside(settings.out, settings.overwrite) as folder:
            notes = _write_room(room, assembly, folder, settings, bar, bars)
            seconds = {"bake": round(baked - start, 2), "write": round(time.perf_counter() - baked, 2)}
            notes |= {"checkpoint": str(checkpoint), "seconds": seconds}
            (folder / MANIFEST).write_text(json.dumps(notes, indent=1) + "\n", encoding="utf-8")
            found = None
            if settings.verify and (why := not_rendered(room.scene)) is not None:
                say(f"nothing is rendered again: {why}")
            elif settings.verify:
                cycles = None if blender is None else partial(render_views, blender, folder)
                found = verify(room, assembly, folder, settings.spp, cycles, bar)
                (folder / "verify.json").write_text(json.dumps(found.as_json(), indent=1) + "\n", encoding="utf-8")
                write_report(found, folder / "report.html", f"{settings.out.name}: verified export")
    _tell(room, settings, notes, found)
    return [] if found is None else found.beyond


def _write_room(
    room: BakedRoom, assembly: Assembly, folder: Path, settings: ExportSettings, bar: Phase, bars: ErrorBars | None
) -> dict[str, Any]:
    """Everything but the verification, into ``folder``; returns what ``room.json`` says."""
    scene = room.scene
    views = shown_alike(scene)
    bar.stage("scene.xml", 1)
    sensors = [sensor(scene, v.camera, v.camera.width, v.camera.height, 256, room.hide_environment) for v in views]
    hidden = room.hide_environment and hides_alone(scene)
    described = replace(scene, materials=[for_mitsuba(material) for material in scene.materials])
    write_xml(describe(described, folder, sensors, path_integrator(scene, hidden)), folder / "scene.xml")
    bar.stage("scene.glb", len(room.names))
    with_usd = find_spec("pxr") is not None
    clipped = write_glb(room, folder / "scene.glb", settings.target, with_usd, bar.step)
    if with_usd:
        from neurad.export.usd import write_usd

        write_usd(room, folder, settings.target)
    seen = write_evidence(room, assembly, folder, bars, bar)
    missing = write_views(scene, folder, settings.copy)
    (folder / "blender_setup.py").write_bytes(BLENDER_SETUP.read_bytes())
    over = any(conversion(material, settings.target) == BY_ANGLES for material in scene.materials)
    if over:
        write_over_angles(folder / _OVER_ANGLES)
    camera = views[0].camera if views else None
    environment = None
    if scene.environment is not None:
        turned = np.asarray(scene.environment.to_world, float)[:3, :3].tolist()
        environment = {"file": "environment.exr", "to_world": turned}
    return {
        "neurad": neurad.__version__,
        "base_color_for": settings.target,
        "base_color_over_angles": _OVER_ANGLES if over else None,
        "clipped_texels": clipped,
        "texels": room.texels,
        "up": room.up,
        "origin": list(scene.origin),
        "to_y": rotation(room.up).tolist(),
        "max_depth": scene.max_depth,
        "hide_environment": room.hide_environment,
        "environment": environment,
        "lights": [_light_notes(light, scene.origin) for light in scene.punctual if light.intensity.any()],
        "film": None if camera is None else [camera.width, camera.height],
        "camera": views[0].name if views else None,
        "views": {"train": [v.name for v in scene.train], "test": [v.name for v in scene.test]},
        "without_photographs": missing,
        "left_out": [*([] if with_usd else [NO_USD]), *([] if bars else [NO_BARS]), *_left_out(room, with_usd)],
        "meshes": [_mesh_notes(room, i, seen[i]) for i in range(len(room.names))],
    }


def _left_out(room: BakedRoom, with_usd: bool) -> list[str]:
    """What other files than those that describe it best lack: cameras with lenses, lights without extent."""
    scene = room.scene
    bent = [view.name for view in (*scene.train, *scene.test) if not is_plain(view.camera)]
    said = [f"{len(bent)} cameras: {NO_LENS}"] if bent else []
    shine = [light.name for light in scene.punctual if light.intensity.any()]
    if shine and with_usd:
        said.append(f"room.usdc: it lacks {len(shine)} lights without extent ({listed(shine)})")
    if scene.flash is not None:
        said.append("the flash, which moves with the camera: only the camera files have it")
    if cannot_hide(scene, room.hide_environment):
        said.append(f"scene.xml: it shows the environment, which the photographs leave out: {NOT_ALONE}")
    return said


def _light_notes(light: PunctualLight, origin: Sequence[float]) -> dict[str, Any]:
    """A light without extent in the scene's frame and units, with its direction of length 1."""
    return {
        "name": light.name,
        "type": light.kind,
        "intensity": light.intensity.tolist(),
        "position": [x + step for x, step in zip(light.position.tolist(), origin, strict=True)],
        "direction": pose(light)[:3, 2].tolist(),
        "cutoff_angle": light.cutoff_angle,
        "beam_width": light.beam_width,
    }


def _mesh_notes(room: BakedRoom, index: int, seen: float | None) -> dict[str, Any]:
    mesh, chart = room.scene.meshes[index], room.charts[index]
    texture = None
    if chart is not None:
        size = {"width": chart.width, "height": chart.height}
        texture = {"coordinates": chart.kind, **size, "seen": seen, "evidence_is_coarser_by": COARSER}
    return {
        "name": room.names[index],
        "triangles": len(mesh.faces),
        "emits": bool(mesh.radiance is not None and mesh.radiance.max() > 0),
        "two_sided": room.scene.materials[mesh.material].two_sided,
        "base_color_converted": is_converted(room.scene.materials[mesh.material]),
        "texture": texture,
    }


def _tell(room: BakedRoom, settings: ExportSettings, notes: dict[str, Any], found: Verified | None) -> None:
    kinds = [chart.kind for chart in room.charts if chart is not None]
    counts = ", ".join(f"{kinds.count(k)} {k}" for k in ("own", "atlas", "grid") if k in kinds)
    size = sum(f.stat().st_size for f in settings.out.rglob("*") if f.is_file() and not f.is_symlink())
    glb, seconds = (settings.out / "scene.glb").stat().st_size, notes["seconds"]
    print(
        f"{settings.out}: {len(room.names)} meshes (texture coordinates: {counts}), {room.texels / 1e6:.2f} M texels, "
        f"scene.glb {glb / 1e6:.1f} MB, all {size / 1e6:.1f} MB, baked in {seconds['bake']:.0f} s, written in "
        f"{seconds['write']:.0f} s"
    )
    if notes["clipped_texels"]:
        print(f"{notes['clipped_texels']} texels need a base colour beyond 0 to 1 for {settings.target}; clipped")
    for text in (*notes["left_out"], *([] if found is None else found.left_out)):
        print(f"left out: {text}")
    for part in notes["without_photographs"]:
        print(f"transforms_{part}.json: photographs are missing, so that the folder cannot be fitted as it stands")
    if found is not None:
        tell_verified(found)


def tell_verified(found: Verified) -> None:
    """Say what was found."""
    for name, entry in found.as_json()["renderers"].items():
        psnr, worst = entry["psnr_below_white"], entry["worst_view"]
        score = "" if psnr is None else f"PSNR {psnr:.2f} ({entry['psnr_standard_error']:.2f}) dB, "
        print(f"{name:8} {score}mean {entry['ratio_of_means']:.4f} of {found.ours}, worst view {worst['name']} "
              f"{worst['ratio_of_means']:.4f}")  # fmt: skip
    if found.seams is not None:
        print(
            f"seams: at most {255 * found.seams.largest:.2f}/255 over {found.seams.points} points on "
            f"{found.seams.sides} sides of chart borders, {255 * found.seams.mean:.2f}/255 on average"
        )
    for text in found.undecided:
        print(f"not decided: {text}; raise --spp")
