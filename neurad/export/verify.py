"""The proof: an exported folder, rendered again, against the fields that it was baked from and the photographs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from neurad.assembly.build import Assembly, build_world
from neurad.assembly.relight import paths
from neurad.core.parameters import RECOVERED, recovered
from neurad.core.protocols import Integrator, Materials
from neurad.core.records import FloatArray, Surface, SurfaceInteraction
from neurad.core.rng import mix
from neurad.core.scene_records import View
from neurad.export.bake import BakedRoom
from neurad.export.base_colour import lobe_of
from neurad.export.pictures import BLOCKS, PASSES, Draw, Pictures, change_is_known, drawn, excess, is_known
from neurad.export.seams import find_seams
from neurad.export.verified import Verified
from neurad.formats.cameras.write import NO_LENS, shown_alike
from neurad.formats.mitsuba.plugin import NOT_ALONE, cannot_hide, fastest, mitsuba_as, no_mitsuba
from neurad.formats.mitsuba.write import ORIGIN
from neurad.images.photographs import kept_pixels, read_view
from neurad.integrators.correlated import CorrelatedPaths
from neurad.integrators.film import render
from neurad.integrators.method import SceneModel
from neurad.integrators.renderer import MethodRenderer
from neurad.integrators.world import World
from neurad.metrics.held_out import HeldOut
from neurad.metrics.held_out_scores import responded, score
from neurad.metrics.scores import psnr
from neurad.runtime import threads
from neurad.runtime.progress import Phase
from neurad.scene.description import Scene
from neurad.scene.exposure import scene_exposure
from neurad.scene.geometry import Geometry
from neurad.scene.origin import moved_views
from neurad.scene.textures import TrueMaterials

SEED = 20260101
MITSUBA_PASSES = 4 * PASSES
"""Most passes of Mitsuba, which is several times as fast and whose samples spread more."""
SPREAD = 16
"""Samples of a pixel whose first bounces are spread evenly, where they divide those of a pass."""
SAMPLES = 1 << 21
"""That Mitsuba draws at once: bounds its memory."""
Program = Callable[[list[View], int, int], list[FloatArray]]
"""Renders views of a file with so many samples a pixel and a seed."""


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


def not_rendered(scene: Scene) -> str | None:
    """Why nothing of what is exported of a scene is rendered again; None where it is."""
    if not shown_alike(scene):
        return NO_LENS
    if not replace(scene.features, has_flash=False).has_light:
        return "only a flash lights the room, which moves with the camera"
    return None


def _views(scene: Scene) -> list[View]:
    """What is rendered again: without a flash, which no file has."""
    return [replace(view, camera=replace(view.camera, flash=None)) for view in shown_alike(scene)]


def verify(
    room: BakedRoom, assembly: Assembly, folder: Path, spp: int, cycles: Program | None, progress: Phase
) -> Verified:
    """Render an exported folder again, ``spp`` samples a pixel in each pass, by Cycles too where there is one."""
    views = _views(room.scene)
    scale = np.float32(scene_exposure(room.scene))
    lobes = {lobe_of(material) for material in room.scene.materials}
    found = Verified(views, bool(room.scene.test), float(scale), "lambert" not in lobes)
    found.photographs = [None if v.image is None else scale * _photograph(v, assembly) for v in views]
    progress.stage("seams", len(room.names))
    found.seams = find_seams(room, assembly.world.geometry, assembly.materials, done=progress.step)
    scene = room.scene
    if find_spec("mitsuba") is None:
        found.left_out.append("reading scene.xml: the package mitsuba is missing")
    else:
        from neurad.formats.mitsuba.read import read_xml

        scene = read_xml(folder / "scene.xml", np.array(scene.origin))
    scene = replace(scene, train=room.scene.train, test=views)
    fraction = assembly.settings.sampling.specular_fraction
    world = build_world(scene, hide_environment=room.hide_environment, specular_fraction=fraction)
    baked = TrueMaterials(scene, world.geometry)
    fields = _OnGeometry(assembly.materials, assembly.world.geometry)
    progress.stage("maps", 1)
    _compare_maps(found, HeldOut(scene, world.geometry, world.tracer.tracer), fields, baked)
    pair: Integrator = CorrelatedPaths(world, baked, fields, scene.max_depth, scene.rr_depth)
    both, ours = (_ours(tracer, views, spp, scale) for tracer in (pair, _alone(scene, world, baked, spp)))
    why = NOT_ALONE if cannot_hide(scene, room.hide_environment) else no_mitsuba()
    if why is not None:
        found.left_out.append(f"Mitsuba: {why}")
        _render(found, both, ours, None, progress)
    else:
        with mitsuba_as(fastest()) as mi:
            mitsuba = _mitsuba(mi, folder / "scene.xml", spp, room.scene.origin, scale)
            _render(found, both, ours, mitsuba, progress)
    if cycles is None:
        found.left_out.append("Cycles: --blender names no Python with bpy and no Blender")
    else:
        _render_by(found, "cycles", cycles, spp, progress)
    found.judge()
    return found


def verify_copy(assembly: Assembly, name: str, program: Program, spp: int, progress: Phase) -> Verified:
    """Render the views of a run, ``spp`` samples a pixel in each pass, and by a program the file that its materials
    were put into; ``name`` is what its pictures are called. What masks leave out of a photograph counts in neither: the
    run does not know it.
    """
    scene, views = assembly.scene, _views(assembly.scene)
    scale = np.float32(scene_exposure(scene))
    found = Verified(views, bool(scene.test), float(scale), ours="fields")
    counts = [np.float32(1.0) if kept is None else kept[..., None] for kept in map(kept_pixels, views)]
    found.photographs = [
        None if v.image is None else scale * _photograph(v, assembly) * c for v, c in zip(views, counts, strict=True)
    ]
    ours = _ours(_alone(scene, assembly.world, assembly.materials, spp), views, spp, scale)
    progress.stage("pictures", len(views))
    found.pictures["fields"] = Pictures()

    def of_view(index: int) -> FloatArray:
        """Passes [k, h, w, 3]."""
        known = partial(is_known, photo=found.photographs[index], views=len(views))
        return drawn(lambda seed: ours(index, seed) * counts[index], known)

    for photo, passes in zip(found.photographs, threads.parallel_map(of_view, range(len(views))), strict=True):
        found.pictures["fields"].add(passes, photo)
        progress.step()

    def theirs(_: list[View], samples: int, seed: int) -> list[FloatArray]:
        pictures = program(moved_views(views, scene.origin), samples, seed)
        return [picture * count for picture, count in zip(pictures, counts, strict=True)]

    _render_by(found, name, theirs, spp, progress)
    found.judge()
    return found


def path_traced(scene: Scene, assembly: Assembly) -> Program:
    """Neurad's path tracer on a file that was read again as ``scene``, whose views have its coordinates."""
    world = build_world(
        scene, hide_environment=assembly.world.hide_environment,
        specular_fraction=assembly.settings.sampling.specular_fraction,
    )  # fmt: skip
    materials = TrueMaterials(scene, world.geometry)

    def program(views: list[View], samples: int, seed: int) -> list[FloatArray]:
        here = moved_views(views, -np.asarray(scene.origin))
        draw = _ours(_alone(scene, world, materials, samples), here, samples, np.float32(1.0))
        return list(threads.parallel_map(lambda index: draw(index, PASSES + seed), range(len(views))))

    return program


def _photograph(view: View, assembly: Assembly) -> FloatArray:
    """A view's photograph [h, w, 3], by the response that the run recovered if it did."""
    photograph = read_view(view)[..., :3]
    development = assembly.development
    return photograph if development is None else responded(view, photograph, development.respond)


def _render_by(found: Verified, name: str, program: Program, spp: int, progress: Phase) -> None:
    """Two passes of all views, with as many samples as neurad took."""
    progress.stage(name, 2)
    most = spp * max(found.pictures[found.ours].passes)
    passes = []
    for seed in (1, 2):
        passes.append(program(found.views, max(most // 2, 1), seed))
        progress.step()
    found.pictures[name] = Pictures()
    for pair, photo in zip(zip(*passes, strict=True), found.photographs, strict=True):
        found.pictures[name].add(np.float32(found.exposure) * np.stack(pair), photo)


def _compare_maps(found: Verified, held_out: HeldOut, fields: Materials, baked: Materials) -> None:
    """Scores of both materials against the truth, and of the baked ones against the fields."""
    of_fields, of_baked = held_out.predict(fields), held_out.predict(baked)
    for name, maps in (("fields", of_fields), ("baked", of_baked)):
        scores = score(held_out, maps)
        for key in (f"{of}_psnr" for of in RECOVERED if f"{of}_psnr" in scores):
            found.scores[f"{key}_{name}"] = scores[key]
    for key in (parameter.name for parameter in recovered(held_out.scene.parameters)):
        square = [np.square(a[key] - b[key]).mean() for a, b in zip(of_fields, of_baked, strict=True)]
        found.scores[f"{key}_baked_to_fields_psnr"] = psnr(float(np.mean(square)))


def _ours(tracer: Integrator, views: Sequence[View], spp: int, scale: np.float32) -> Draw:
    """Views by neurad's path tracer, at an exposure."""

    def draw(index: int, seed: int) -> FloatArray:
        shown = render(views[index].camera, tracer, spp, mix(SEED, index, seed))
        return scale * np.asarray(shown.numpy(), np.float32)

    return draw


def _mitsuba(mi: Any, path: Path, spp: int, origin: Sequence[float], scale: np.float32) -> Draw:
    """Mitsuba on ``scene.xml``, moved to the origin if it lies far from it; its sensors are the views in order."""
    loaded = mi.load_file(str(path), **dict.fromkeys(ORIGIN if any(origin) else (), "0"))

    def draw(index: int, seed: int) -> FloatArray:
        most = max(1, SAMPLES // int(np.prod(loaded.sensors()[index].film().size())))
        counts = [min(most, spp - done) for done in range(0, spp, most)]
        keys = [mix(SEED, index, seed, part) & 0x7FFFFFFF for part in range(len(counts))]
        parts = [
            count * np.array(mi.render(loaded, sensor=index, spp=count, seed=key))[..., :3]
            for count, key in zip(counts, keys, strict=True)
        ]
        return scale * np.asarray(np.sum(parts, 0) / spp, np.float32)

    return draw


def _alone(scene: Scene, world: World, materials: Materials, spp: int) -> Integrator:
    return MethodRenderer(paths(scene), SceneModel(world, materials), 1 if spp % SPREAD else SPREAD)


def _render(found: Verified, both: Draw, ours: Draw, mitsuba: Draw | None, progress: Phase) -> None:
    """Passes of every view until the means are known well enough, those of a few views in memory at once: of the folder
    and the fields along the same paths until what baking changes is known, then, at half the cost, of the folder alone.
    """
    names = ["baked", "fields", *([] if mitsuba is None else ["mitsuba"])]
    progress.stage("pictures", len(found.views) * len(names))
    found.pictures |= {name: Pictures() for name in names}
    found.excess |= {name: [] for name in names if name != "baked"}
    count = sum(photo is not None for photo in found.photographs)
    known = [partial(is_known, photo=photo, views=count) for photo in found.photographs]

    def of_view(index: int) -> tuple[FloatArray, FloatArray]:
        """Passes of pairs [k, h, w, 6], and of the folder [j, h, w, 3], which begin with those of the pairs."""
        pairs = drawn(partial(both, index), partial(change_is_known, photo=found.photographs[index], views=count))
        return pairs, drawn(partial(ours, index), known[index], begun=pairs[..., :3])

    for index, (pairs, baked) in enumerate(threads.parallel_map(of_view, range(len(found.views)))):
        photo, begun = found.photographs[index], pairs[..., :3]
        passes = {"baked": baked, "fields": pairs[..., 3:]}
        progress.step(2)
        if mitsuba is not None:
            passes["mitsuba"] = drawn(partial(mitsuba, index), known[index], MITSUBA_PASSES)
            progress.step()
        for name, pictures in passes.items():
            found.pictures[name].add(pictures, photo)
        for name, entries in found.excess.items():
            pair = passes[name], begun if name == "fields" else passes["baked"]
            entries.append(None if photo is None else {block: excess(*pair, photo, block) for block in BLOCKS})
    for name in names:
        if (picture := found.psnr(name)[0]) is not None:
            found.scores[f"picture_psnr_{name}"] = picture
