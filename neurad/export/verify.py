"""The proof: an exported folder, rendered again, against the fields that it was baked from and the photographs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neurad.assembly.build import Assembly, build_world
from neurad.core.protocols import Materials
from neurad.core.records import FloatArray, Surface, SurfaceInteraction, View
from neurad.core.rng import mix
from neurad.export.room import Room
from neurad.integrators.film import render
from neurad.integrators.renderer import path_tracer
from neurad.metrics.held_out import HeldOut
from neurad.metrics.scores import psnr
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry
from neurad.scene.image_io import read_exr
from neurad.scene.textures import TrueMaterials

SEED = 20260101
ALBEDO_LOSS, ROUGHNESS_LOSS, PICTURE_LOSS = 0.1, 0.1, 0.05
"""Most that baking may lose, in dB."""
MITSUBA_MEAN, MITSUBA_PSNR = 0.01, 0.1
"""Largest difference of a view's mean, as a fraction, and of the PSNR against the photographs, in dB."""
CYCLES_MEAN = 0.03
ERROR = 0.002
"""Standard error of the mean of a view that is rendered for, as a fraction of it."""
PASSES = 8
"""Most passes to get there."""

Draw = Callable[[int, int], FloatArray]
"""A picture [h, w, 3] of the view of this number by this seed."""


@dataclass
class Pictures:
    """The views as one renderer shows them."""

    mean: list[FloatArray] = field(default_factory=list)
    """Linear [h, w, 3]."""
    two: list[FloatArray] = field(default_factory=list)
    """The same of the first two passes alone."""
    error: list[float] = field(default_factory=list)
    """Standard error of the mean of each."""
    noise: list[float] = field(default_factory=list)
    """Mean squared noise of a pixel of ``mean``."""
    noise_of_two: list[float] = field(default_factory=list)
    """The same of ``two``."""

    def add(self, passes: list[FloatArray]) -> None:
        """Add a view from its passes, two at least, which differ in nothing but their random numbers."""
        stack = np.stack(passes).astype(np.float64)
        self.mean.append(np.mean(passes, 0))
        self.two.append(np.mean(passes[:2], 0))
        self.error.append(standard_error(passes))
        noise = float(stack.var(0, ddof=1).mean())
        self.noise.append(noise / len(passes))
        self.noise_of_two.append(float(stack[:2].var(0, ddof=1).mean()) / 2.0)


@dataclass
class Verified:
    """What was found."""

    views: list[View]
    held_out: bool
    """Whether the views are held out; a scene without such views is verified on those that it was fitted to."""
    pictures: dict[str, Pictures] = field(default_factory=dict)
    """By renderer: 'fields', 'baked', 'mitsuba' and 'cycles'."""
    photographs: list[FloatArray | None] = field(default_factory=list)
    scores: dict[str, float] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    """What could not be verified, and why."""
    beyond: list[str] = field(default_factory=list)
    """What lies beyond its bound, a few words each."""

    def ratios(self, name: str) -> list[float]:
        """Means of the views by a renderer over those of the baked room in neurad's path tracer."""
        pairs = zip(self.pictures[name].mean, self.pictures["baked"].mean, strict=True)
        return [float(theirs.mean() / max(float(ours.mean()), 1e-30)) for theirs, ours in pairs]

    def psnr(self, name: str) -> float | None:
        """Of a renderer's views against the photographs, linear, peak 1, over all pixels; None without photographs.

        The noise of the renderer, known from its passes, is taken out, as renderers differ in it.
        """
        shown = self.pictures[name]
        return self._psnr(shown.mean, shown.noise)

    def psnr_of_two(self, name: str) -> float | None:
        """The same of the first two passes alone."""
        shown = self.pictures[name]
        return self._psnr(shown.two, shown.noise_of_two)

    def _psnr(self, pictures: list[FloatArray], noise: list[float]) -> float | None:
        squares = [
            np.square(shown.astype(np.float64) - photo).mean() - variance
            for shown, photo, variance in zip(pictures, self.photographs, noise, strict=True)
            if photo is not None
        ]
        return psnr(max(float(np.mean(squares)), 1e-12)) if squares else None

    def as_json(self) -> dict[str, Any]:
        """What ``verify.json`` holds."""
        found: dict[str, Any] = {
            "verified_on": "held-out views" if self.held_out else "training views, as there are no held-out ones",
            "scores": {name: round(value, 4) for name, value in self.scores.items()},
            "beyond_bounds": self.beyond,
            "left_out": self.left_out,
            "renderers": {},
        }
        for name, shown in self.pictures.items():
            ratios = self.ratios(name)
            worst = int(np.argmax(np.abs(np.array(ratios) - 1.0)))
            entry: dict[str, Any] = {
                "psnr_linear": self.psnr(name),
                "ratio_of_means": float(np.mean([x.mean() for x in shown.mean])
                                        / np.mean([x.mean() for x in self.pictures["baked"].mean])),
                "worst_view": {"name": self.views[worst].name, "ratio_of_means": ratios[worst]},
                "views": {v.name: {"mean": float(x.mean()), "standard_error": e, "ratio_of_means": r}
                          for v, x, e, r in zip(self.views, shown.mean, shown.error, ratios, strict=True)},
            }  # fmt: skip
            found["renderers"][name] = entry
        return found


@dataclass(frozen=True)
class _OnGeometry:
    """Materials of a run, asked at points of the exported meshes: same triangles, other texture coordinates."""

    materials: Materials
    geometry: Geometry

    def _own(self, si: SurfaceInteraction) -> SurfaceInteraction:
        u, v = si.bary.unbind(-1)
        return self.geometry.interact_at(si.prim, u.contiguous(), v.contiguous(), si.wo, si.valid)

    def __call__(self, si: SurfaceInteraction) -> Surface:
        """BSDF parameters at the lanes of ``si``."""
        return self.materials(self._own(si))

    def albedo(self, si: SurfaceInteraction) -> Tensor:
        """The albedo alone [n, 3]."""
        return self.materials.albedo(self._own(si))


def verify(
    room: Room,
    assembly: Assembly,
    folder: Path,
    spp: int,
    cycles: Callable[[list[View], int, int], list[FloatArray]] | None,
) -> Verified:
    """Render an exported folder again.

    Args:
        room: what was written.
        assembly: of the run.
        folder: where it was written to.
        spp: samples a pixel of each pass.
        cycles: renders views of ``scene.glb`` with so many samples a pixel and a seed; None leaves that out.
    """
    views = room.scene.test or room.scene.train
    found = Verified(views, held_out=bool(room.scene.test))
    found.photographs = [None if v.image is None else read_exr(v.image)[..., :3] for v in views]
    scene = replace(_read_again(room, folder, found), train=room.scene.train, test=views)
    fraction = assembly.settings.sampling.specular_fraction
    world = build_world(scene, hide_environment=room.hide_environment, specular_fraction=fraction)
    baked = TrueMaterials(scene, world.geometry)
    fields = _OnGeometry(assembly.materials, assembly.world.geometry)
    _compare_maps(found, scene, HeldOut(scene, world.geometry, world.tracer.tracer), fields, baked)
    draws = {"baked": _ours(world, baked, scene, spp), "fields": _ours(world, fields, scene, spp)}
    if find_spec("mitsuba") is None:
        found.left_out.append("Mitsuba: the package mitsuba is missing (pip install 'neurad[mitsuba]')")
    else:
        draws["mitsuba"] = _mitsuba(folder / "scene.xml", spp, room)
    _render(found, draws)
    if cycles is None:
        found.left_out.append("Cycles: --blender names no Python with bpy and no Blender")
    else:
        found.pictures["cycles"] = Pictures()
        for first, second in zip(cycles(views, spp, 1), cycles(views, spp, 2), strict=True):
            found.pictures["cycles"].add([first, second])
    _judge(found)
    return found


def _read_again(room: Room, folder: Path, found: Verified) -> Scene:
    """The scene of ``scene.xml``, or what was written to it where nothing can read it."""
    if find_spec("mitsuba") is None:
        found.left_out.append("reading scene.xml: the package mitsuba is missing")
        return room.scene
    from neurad.scene.readers.mitsuba_xml import read_xml

    return read_xml(folder / "scene.xml")


def _compare_maps(found: Verified, scene: Scene, held_out: HeldOut, fields: Materials, baked: Materials) -> None:
    """Scores of both materials against the truth, and of the baked ones against the fields."""
    of_fields, of_baked = held_out.predict(fields), held_out.predict(baked)
    for name, maps in (("fields", of_fields), ("baked", of_baked)):
        scores = held_out.score(maps)
        for key in ("albedo_psnr", "roughness_psnr"):
            if key in scores:
                found.scores[f"{key}_{name}"] = scores[key]
    for key in ("albedo", "roughness") if held_out.has_roughness else ("albedo",):
        square = [np.square(a[key] - b[key]).mean() for a, b in zip(of_fields, of_baked, strict=True)]
        found.scores[f"{key}_baked_to_fields_psnr"] = min(psnr(float(np.mean(square))), 200.0)


def _ours(world: Any, materials: Materials, scene: Scene, spp: int) -> Draw:
    """Neurad's path tracer; the same seeds give both materials the same random numbers."""
    tracer = path_tracer(world, materials, scene.max_depth, scene.rr_depth)

    def draw(index: int, seed: int) -> FloatArray:
        with torch.no_grad():
            shown = render(scene.test[index].camera, tracer, spp, mix(SEED, index, seed))
        return np.asarray(shown.numpy(), np.float32)

    return draw


def _mitsuba(path: Path, spp: int, room: Room) -> Draw:
    """Mitsuba on ``scene.xml`` as it stands; its sensors are the views in order."""
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("scalar_rgb")
    loaded: Any = mi.load_file(str(path))
    module: Any = mi

    def draw(index: int, seed: int) -> FloatArray:
        return np.array(module.render(loaded, sensor=index, spp=spp, seed=mix(SEED, index, seed) & 0xFFFFFF))[..., :3]

    return draw


def _render(found: Verified, draws: dict[str, Draw]) -> None:
    """Passes of every view until the means are known well enough; two of the fields, which baking is judged by."""
    for name, draw in draws.items():
        found.pictures[name] = Pictures()
        for index in range(len(found.views)):
            passes = [draw(index, 0), draw(index, 1)]
            most = 2 if name == "fields" else PASSES
            while len(passes) < most and standard_error(passes) > ERROR * abs(float(np.mean(passes))):
                passes.append(draw(index, len(passes)))
            found.pictures[name].add(passes)
    for name in ("fields", "baked"):
        if (score := found.psnr_of_two(name)) is not None:
            found.scores[f"picture_psnr_{name}"] = score


def standard_error(passes: list[FloatArray]) -> float:
    """Of the mean of a picture over passes, from the spread of every pixel over them: pixels are independent."""
    stack = np.stack(passes).mean(-1, dtype=np.float64)
    return float(np.sqrt(stack.var(0, ddof=1).sum() / len(passes)) / stack[0].size)


def _judge(found: Verified) -> None:
    """Find what lies beyond its bound."""
    scores = found.scores
    for what, bound in (("albedo", ALBEDO_LOSS), ("roughness", ROUGHNESS_LOSS), ("picture", PICTURE_LOSS)):
        before, after = scores.get(f"{what}_psnr_fields"), scores.get(f"{what}_psnr_baked")
        if before is not None and after is not None and before - after > bound:
            found.beyond.append(f"baking took {before - after:.2f} dB of {what} (bound {bound})")
    for name, bound in (("mitsuba", MITSUBA_MEAN), ("cycles", CYCLES_MEAN)):
        if name not in found.pictures:
            continue
        ratios = found.ratios(name)
        worst = max(range(len(ratios)), key=lambda i: abs(ratios[i] - 1.0))
        if abs(ratios[worst] - 1.0) > bound:
            view = found.views[worst].name
            found.beyond.append(f"{name} shows {view} {ratios[worst]:.3f} times as bright (bound {100 * bound:g} %)")
    ours, theirs = found.psnr("baked"), found.psnr("mitsuba") if "mitsuba" in found.pictures else None
    if ours is not None and theirs is not None and abs(ours - theirs) > MITSUBA_PSNR:
        found.beyond.append(f"mitsuba's PSNR is {theirs:.2f} dB, ours {ours:.2f} (bound {MITSUBA_PSNR} dB)")
