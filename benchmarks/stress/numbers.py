"""Extreme numbers through ``neurad fit`` itself: scene folders, the command line, ``metrics.csv``."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.stress.case import Case, Outcome
from benchmarks.stress.fit import resized
from benchmarks.stress.folder import Photographs, photograph, write_folder
from neurad.core.reflection import PrincipledModel
from neurad.core.scene_records import Constant, Mesh, View
from neurad.runs.child import run_neurad
from neurad.runtime.tables import numbers, read_csv
from neurad.scene.builtin import build_cornell
from neurad.scene.builtin.shapes import quad
from neurad.scene.description import Scene

BAR = 0.3
"""Decibels of albedo that a row may lose against the plain scene."""
PLAIN = ("plain", "principled, roughness 0.5", "albedo 0.5")
"""Rows that others are compared with."""
AREA = 0.2
"""Area of the box's own light."""


@dataclass(frozen=True)
class Size:
    """How long the rows take."""

    pixels: int = 32
    """Width and height of the views."""
    spp: int = 256
    """Samples per pixel of the photographs: of 64, a fit learns their noise, and rows differ by that."""
    steps: int = 300
    arguments: tuple[str, ...] = ()
    """Further ones of ``neurad fit``."""


QUICK = Size(spp=16, steps=60)
"""Sizes of the short form, whose rows show nothing that noise could hide."""


@dataclass(frozen=True)
class Extreme:
    """A scene, and the scene that its albedo is compared with."""

    name: str
    scene: Callable[[], Scene]
    plain: str = "plain"
    """Name of the other row."""
    light: float = 1.0
    """Factor on the photographs that the row shares with the plain one."""
    shares: bool = True
    """Whether the photographs are those of the plain scene: what differs does not show in them."""
    samples: int = 1
    """Factor on the samples of its photographs, where they are noisier than the plain ones."""
    reason: str = ""
    """Why a row that loses more than the bar is stated and does not fail."""
    quick: bool = False


def fits(rows: dict[str, Extreme], size: Size) -> Callable[[str], float]:
    """What fits a row, by its name, and gives the albedo PSNR in decibels over the held-out views at the end; each is
    fitted once. It raises RuntimeError where a fit ends with an error.
    """

    def scene_of(name: str) -> Scene:
        return resized(rows[name].scene(), size.pixels)

    @cache
    def images(name: str) -> Photographs:
        return photograph(scene_of(name), size.spp * rows[name].samples)

    @cache
    def psnr(name: str) -> float:
        row = rows[name]
        with tempfile.TemporaryDirectory(prefix="neurad_stress_") as folder:
            root, out = Path(folder) / "scene", Path(folder) / "fit"
            write_folder(scene_of(name), root, images(row.plain if row.shares else name), row.light)
            out.mkdir()
            words = [
                "fit", "--config", "cornell.yaml", "--data.scene", "null", "--data.root", str(root),
                "--trainer.max_time", "null", "--trainer.max_steps", str(size.steps),
                "--trainer.default_root_dir", str(out), "--trainer.enable_progress_bar", "false",
                "--evaluation.every_n_steps", str(10 * size.steps), "--evaluation.spp", "1", *size.arguments,
            ]  # fmt: skip
            ended = run_neurad(words, out / "log.txt")
            if ended.code != 0:
                raise RuntimeError(ended.message)
            (metrics,) = out.glob("**/metrics.csv")
            return numbers(read_csv(metrics)[1][-1])["albedo_psnr"]

    return psnr


# ---- scenes


def _lit(factor: float) -> Scene:
    """The box with its light so many times as bright."""
    scene = build_cornell()
    light = scene.meshes[-1]
    assert light.radiance is not None
    return replace(scene, meshes=[*scene.meshes[:-1], replace(light, radiance=light.radiance * np.float32(factor))])


def _placed(scale: float, offset: float) -> Scene:
    """The box and its cameras scaled, then moved along all axes."""
    scene = build_cornell()

    def placed(view: View) -> View:
        pose: Any = np.array(view.camera.to_world, np.float64)
        pose[:3, 3] = pose[:3, 3] * scale + offset
        return replace(view, camera=replace(view.camera, to_world=pose))

    meshes = [
        replace(mesh, vertices=(mesh.vertices.astype(np.float64) * scale + offset).astype(np.float32))
        for mesh in scene.meshes
    ]
    train, test = ([placed(view) for view in views] for views in (scene.train, scene.test))
    return replace(scene, meshes=meshes, train=train, test=test)


def _stray() -> Scene:
    scene = build_cornell()
    mesh = scene.meshes[0]
    vertices = np.concatenate((mesh.vertices, np.full((3, 3), 1000.0, np.float32)))
    return replace(scene, meshes=[replace(mesh, vertices=vertices, uvs=None), *scene.meshes[1:]])


def _far_triangle() -> Scene:
    scene = build_cornell()
    corners = np.array([[300, 300, 300], [301, 300, 300], [300, 301, 300]], np.float32)
    return replace(scene, meshes=[*scene.meshes, Mesh("far", corners, np.array([[0, 1, 2]]), 2)])


def _ground() -> Scene:
    scene = build_cornell()
    plane = quad((-1000.0, -1.1, -1000.0), (0.0, 0.0, 2000.0), (2000.0, 0.0, 0.0))
    return replace(scene, meshes=[*scene.meshes, plane.mesh("ground", 2, smooth_shading=False)])


def _lamps(count: int, side: float) -> Scene:
    """The box with ``count`` x ``count`` square lights in place of its own, of the same power together."""
    scene = build_cornell()
    light = scene.meshes[-1]
    assert light.radiance is not None
    radiance = light.radiance * np.float32(AREA / (count * side) ** 2)
    place = (np.arange(count) + 0.5) / count * 1.6 - 0.8 - 0.5 * side
    lamps = [
        replace(
            quad((x, 0.995, z), (side, 0, 0), (0, 0, side)).mesh("light", light.material, smooth_shading=False),
            radiance=radiance,
        )
        for x in place
        for z in place
    ]
    return replace(scene, meshes=[*scene.meshes[:-1], *lamps])


def glossy(roughness: float) -> Scene:
    """The box painted with a principled BSDF; its light is not."""
    scene = build_cornell()
    rough = Constant(np.full(1, roughness, np.float32))
    walls = [replace(m, model=PrincipledModel(), roughness=rough) for m in scene.materials[:-1]]
    return replace(scene, materials=[*walls, scene.materials[-1]])


def _grey(albedo: float) -> Scene:
    """The box with one albedo on all surfaces but the light."""
    scene = build_cornell()
    walls = [replace(m, albedo=Constant(np.full(3, albedo, np.float32))) for m in scene.materials[:-1]]
    return replace(scene, materials=[*walls, scene.materials[-1]], max_depth=1000)


# ---- rows


def _rows() -> list[Extreme]:
    lights = (1e-12, 1e-6, 1e6, 1e15)
    return [
        Extreme("plain", build_cornell),
        *(Extreme(f"light times {f:g}", partial(_lit, f), light=f, quick=f == lights[0]) for f in lights),
        *(Extreme(f"size times {s:g}", partial(_placed, s, 0.0)) for s in (1e-3, 1e4)),
        Extreme("moved by 1e4", partial(_placed, 1.0, 1e4)),
        Extreme("three stray vertices at 1000", _stray, quick=True),
        Extreme("a triangle of area 0.5 at 300", _far_triangle),
        Extreme("a ground plane of side 2000 below", _ground),
        Extreme("100 lights", partial(_lamps, 10, 0.04), shares=False, samples=2),  # a sample sees one of them
        Extreme("a light of side 0.001", partial(_lamps, 1, 1e-3), shares=False),
        Extreme("principled, roughness 0.5", partial(glossy, 0.5), shares=False),
        Extreme(
            "principled, roughness 0.01", partial(glossy, 0.01), "principled, roughness 0.5", shares=False,
            reason="its caustics give photographs of as many samples 4.9 times the noise, and a fit learns it",
        ),
        Extreme("albedo 0.5", partial(_grey, 0.5), shares=False),
        Extreme("albedo 0.999", partial(_grey, 0.999), "albedo 0.5", shares=False),
    ]  # fmt: skip


def cases(quick_size: Size = QUICK) -> list[Case]:
    """Light, size, place, geometry that is not seen, many and small lights, smooth and bright surfaces."""
    rows = {row.name: row for row in _rows()}
    full, short = fits(rows, Size()), fits(rows, quick_size)

    def case(row: Extreme) -> Case:
        def measure(quick: bool) -> Outcome:
            psnr, steps = (short, quick_size.steps) if quick else (full, Size().steps)
            found, plain = psnr(row.name), psnr(row.plain)
            note = f"{found:.2f} dB, {row.plain}: {plain:.2f} dB, {steps} steps"
            lost = plain - found
            if row.reason and lost > BAR:
                return Outcome(lost, None, f"{note}; {row.reason}")
            return Outcome(lost, BAR, note)

        return Case("numbers", row.name, f"albedo PSNR lost against {row.plain}, in dB", measure, row.quick)

    return [case(row) for row in rows.values() if row.name not in PLAIN]
