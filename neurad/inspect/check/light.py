"""What a check says of light: lamps and their power, what a fit would refuse, the exposure of each photograph, and how
far photographs lie beside each other.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from neurad.assembly.build import Assembly
from neurad.assembly.common_causes import common_causes
from neurad.assembly.exposure import brightness_warning
from neurad.assembly.gains import shared_development
from neurad.assembly.region import Region
from neurad.core.camera import camera_rays
from neurad.core.errors import InputError
from neurad.core.protocols import Materials, PhotoSource
from neurad.core.records import FloatArray, PixelBatch
from neurad.core.rng import Stream, mix
from neurad.core.robust import robust_deviation
from neurad.core.scene_records import Camera
from neurad.evidence.texture_offsets import texture_offsets
from neurad.evidence.view_residuals import few
from neurad.inspect.check.findings import Findings, Level
from neurad.integrators.film import pixel_positions
from neurad.integrators.method import SceneModel
from neurad.integrators.path import PathTracing
from neurad.integrators.renderer import MethodRenderer
from neurad.integrators.world import World
from neurad.lamps.known import agrees, causes_of_mismatch, far_off, refusal, report
from neurad.lamps.photographed import WARN, PhotographedLamp, lamp_photographs, photographed_lamps
from neurad.runs.model_settings import model_settings
from neurad.runtime.reading import listed
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials
from neurad.training.training_views import TrainingViews, blind_views, check_views, prepare_views

SEED = 20231101
OUT = 2.0
"""Factor between a photograph's exposure and that of the others from which on it is named ..."""
SPREADS = 6.0
"""... if it is also so many robust standard deviations."""
DIFFERENT = 5.0
"""Factor between the photographs and the scene's own picture from which on lights and photographs disagree."""
SHINES, MIN_PIXELS = 8.0, 8
"""A mesh shines that is photographed so many times as bright as its surroundings explain, in as many pixels."""

Source = Callable[[Scene], PhotoSource]
"""Makes the photographs of a scene's training views."""
SPP = 4
"""Samples in each pixel; it is the mean over pixels that counts."""
_DEPTH, _RR_DEPTH = 12, 4
_GROUPS = 15
"""Parts that the pixels of a view are split into: the median of their means leaves fireflies out."""


@dataclass(frozen=True)
class Light:
    """What is known of lamps and exposure."""

    power: list[tuple[str, FloatArray, float, float]]
    """Name, radiance [3], area and power (mean of the channels) of each lamp."""
    lamps: list[PhotographedLamp] = field(default_factory=list)
    """As the photographs show them."""
    exposures: dict[str, float] = field(default_factory=dict)
    """Photographed over expected brightness by name of the training view."""
    offsets: dict[str, float] = field(default_factory=dict)
    """Pixels by which its textures lie beside those of others, by name of the training view; NaN where nobody knows."""


def lamp_power(scene: Scene, world: World) -> list[tuple[str, FloatArray, float, float]]:
    """Name, radiance [3], area, and power ``pi A L`` of each lamp."""
    geometry, rows = world.geometry, []
    area = torch.zeros(len(scene.meshes)).index_add_(0, geometry.mesh_index, geometry.face_area)
    for index, mesh in enumerate(scene.meshes):
        if mesh.radiance is not None and mesh.radiance.any():
            size = float(area[index])
            rows.append((mesh.name, mesh.radiance, size, math.pi * size * float(mesh.radiance.mean())))
    return rows


def check_light(
    scene: Scene,
    world: World,
    source: Source,
    findings: Findings,
    emitters: str,
    edges: Sequence[tuple[Tensor, Camera, Tensor]],
) -> Light:
    """Say whether a fit would begin with these photographs and lights, and whether they belong together.

    Args:
        scene: whose training views have photographs that can be read.
        emitters: what a fit will take as known of area lights, as ``model.lighting.emitters``.
        edges: ranks, cameras and directions to edges of views, for :func:`neurad.evidence.edge_fit.shared_turn`.
    """
    light = Light(lamp_power(scene, world))
    materials = TrueMaterials(scene, world.geometry)
    settings = model_settings("scene.yaml", SEED)
    settings = replace(settings, sampling=replace(settings.sampling, cached_spp=0))
    assembly = Assembly(scene, settings, world, materials, None, None, Region(scene.bounds))
    try:
        photographs = source(scene)
        world.hide_environment = photographs.has_alpha
        views = prepare_views(assembly, photographs, check_brightness=False)
        assembly = replace(assembly, development=shared_development(scene, world, photographs, SEED))
        assert views.surface is not None
        if float(np.nanmax(views.surface, initial=0.0)) == 0.0:
            check_views(scene, views.surface)  # raises
    except InputError as error:
        findings.add(Level.REFUSED, "photograph", str(error))
        return light
    for index in blind_views(views.surface):
        few_met = f"only {100 * views.surface[index]:.0f} % of its pixels meet a surface, far fewer than of other views"
        findings.add(Level.WRONG, "camera", f"{few_met}; check its pose", scene.train[index].name)
    lamps = _lamps(assembly, photographs, views, findings, emitters == "known", edges)
    offsets = _offsets(assembly, photographs, findings)
    exposures = _exposures(assembly, views, findings, emitters == "known")
    return replace(light, lamps=lamps, exposures=exposures, offsets=offsets)


def _offsets(assembly: Assembly, photographs: PhotoSource, findings: Findings) -> dict[str, float]:
    """Pixels by which photographs lie beside each other where they show the same surfaces."""
    train = assembly.scene.train
    names, cameras = [view.name for view in train], [view.camera for view in train]
    found = texture_offsets(assembly.world, cameras, photographs, SEED).summary(len(train))
    mended = "fits with --data.poses refine, as scene.yaml has it, refine poses and lenses"
    for sentence in found.sentences(names):
        findings.add(Level.NOTE, "camera", f"{sentence}; {mended}")
    return dict(zip(names, found.views.tolist(), strict=True))


def _lamps(
    assembly: Assembly,
    photographs: PhotoSource,
    views: TrainingViews,
    findings: Findings,
    known: bool,
    edges: Sequence[tuple[Tensor, Camera, Tensor]],
) -> list[PhotographedLamp]:
    """Lamps as the photographs show them, after what is wrong with all photographs; where they are not known they
    differ from the scene rightly.
    """
    scene, world = assembly.scene, assembly.world
    cameras, lamps = [view.camera for view in scene.train], []
    if scene.features.has_area_lights and views.sample is not None:
        shown = lamp_photographs(world, cameras, photographs, views.sample, SEED)
        developed = shown.developed(assembly.development)
        lamps = photographed_lamps(scene, world, assembly.materials, cameras, developed, SEED)
    if known and any(lamp.beyond(WARN) for lamp in lamps):
        causes = causes_of_mismatch(assembly, photographs, lamps, edges)
    else:
        scale = any(map(agrees, lamps))
        causes = common_causes(
            world, cameras, photographs, SEED, assembly.development, views=edges, lit=known, scale_known=scale
        )
    for cause in causes:
        findings.add(Level.WRONG, "photograph", cause)
    if not known:
        return lamps
    wrong = far_off(lamps)
    if wrong and not causes:
        findings.add(Level.REFUSED, "lamp", f"scene {scene.name}: {refusal(wrong)}")
    for line in report(lamps, bool(causes)):
        add_line(findings, line)
    return lamps


def add_line(findings: Findings, line: str) -> None:
    """Add what a fit would say of lamps; what it would warn of is wrong."""
    warned = line.removeprefix("warning: ")
    findings.add(Level.WRONG if warned != line else Level.NOTE, "lamp", warned)


def _exposures(assembly: Assembly, views: TrainingViews, findings: Findings, known: bool) -> dict[str, float]:
    """How bright each photograph is beside a picture with the scene's own lights and materials."""
    scene, world = assembly.scene, assembly.world
    assert views.sample is not None
    sample = views.sample if assembly.development is None else assembly.development(views.sample)
    if known and (said := brightness_warning(scene, views.primary, sample, SEED)):
        findings.add(Level.WRONG, "exposure", said)
    pixels = few(sample, len(scene.train))
    expected = rendered(world, assembly.materials, [view.camera for view in scene.train], pixels, SEED)
    ratios = exposure_ratios(pixels.color, expected, pixels.view, len(scene.train))
    logs = np.log(ratios[np.isfinite(ratios)])
    if len(logs):
        middle = float(np.median(logs))
        if known and not said:
            _overall(math.exp(middle), findings)
        if known:
            _shining(scene, world, views, pixels, expected * math.exp(middle), findings)
        limit = max(math.log(OUT), SPREADS * robust_deviation(logs, middle))
        for view, ratio in zip(scene.train, ratios, strict=True):
            if len(logs) >= 4 and np.isfinite(ratio) and abs(math.log(ratio) - middle) > limit:
                factor = ratio / math.exp(middle)
                how = f"{factor:.3g} times brighter" if factor > 1 else f"{1 / factor:.3g} times darker"
                findings.add(
                    Level.WRONG, "exposure",
                    f"its photograph is {how} than the lights make it, against all others: another exposure, or it "
                    "shows something else", view.name,
                )  # fmt: skip
    return {view.name: float(ratio) for view, ratio in zip(scene.train, ratios, strict=True)}


def _overall(ratio: float, findings: Findings) -> None:
    if not 1.0 / DIFFERENT < ratio < DIFFERENT:
        how = f"{ratio:.3g} times as bright" if ratio > 1 else f"{1 / ratio:.3g} times darker"
        findings.add(
            Level.WRONG, "exposure",
            f"the photographs are {how} {'as' if ratio > 1 else 'than'} the scene with its own lights and materials; a "
            "lamp may be missing or too many, or their units differ",
        )  # fmt: skip


def _shining(
    scene: Scene, world: World, views: TrainingViews, pixels: PixelBatch, expected: Tensor, findings: Findings
) -> None:
    """Name meshes that shine in the photographs and are no lamps."""
    primary = views.primary.views
    with world.tracer.uncounted():
        corner = primary.corner(pixels.view, pixels.pixel)
        prim = world.tracer.closest(primary.rays(pixels.view, corner + 0.5)).prim
    mesh = torch.where(prim >= 0, world.geometry.mesh_index[prim.clamp_min(0)], -1)
    level = float(pixels.color.mean(-1).median())
    names = []
    for index in sorted(set(mesh.tolist())):
        mine = mesh == index
        if index < 0 or int(mine.sum()) < MIN_PIXELS:
            continue
        shown = float(pixels.color[mine].mean(-1).median())
        given = max(float(expected[mine].mean()), 0.05 * level)
        if shown > SHINES * given and shown > SHINES * level:
            names.append(f"{scene.meshes[index].name} ({shown / given:.3g} times)")
    if names:
        findings.add(
            Level.WRONG, "lamp",
            f"in the photographs {listed(names, 6)} is far brighter than the lights make it, as if it shone, but the "
            "scene has no lamp there",
        )  # fmt: skip


def usable(scene: Scene, refused: Sequence[str]) -> Scene:
    """The scene with those of its training views whose photographs can be read."""
    return replace(scene, train=[view for view in scene.train if view.image is not None and view.name not in refused])


@torch.no_grad()
def rendered(world: World, materials: Materials, cameras: Sequence[Camera], pixels: PixelBatch, seed: int) -> Tensor:
    """What the scene's lights and materials give in some pixels, without what surfaces emit [n, 3]; noisy."""
    device = world.geometry.vertices.device
    tracer = MethodRenderer(PathTracing(_DEPTH, _RR_DEPTH), SceneModel(world, materials))
    found = torch.zeros(len(pixels.view), 3, device=device)
    with world.tracer.uncounted():
        for index in sorted(set(pixels.view.tolist())):
            lanes = (pixels.view == index).nonzero().squeeze(-1).to(device)
            stream = Stream(seed, index, 33, device=device)
            xy = pixel_positions(cameras[index].width, pixels.pixel.to(device)[lanes], SPP, stream)
            rays = camera_rays(cameras[index], xy.view(-1, 2))
            found[lanes] = tracer(rays, mix(seed, index, 34)).view(-1, SPP, 3).mean(1)
    return found.cpu()


def exposure_ratios(photographed: Tensor, expected: Tensor, view: Tensor, views: int) -> FloatArray:
    """Photographed over expected brightness of each view [views], by random pixels [n, 3] of views ``view`` [n]; NaN
    where there are too few pixels or no light. Pixels in which something shines count in neither: a mirror that nobody
    declared shows lamps, too.
    """
    ratios = np.full(views, np.nan, np.float32)
    a, b = (x.double().mean(-1).numpy() for x in (photographed, expected))
    for index in range(views):
        mine = np.flatnonzero(view.numpy() == index)
        mine = mine[a[mine] <= SHINES * np.median(a[mine])] if len(mine) else mine
        if len(mine) >= 4 * _GROUPS:
            parts = np.array_split(mine, _GROUPS)
            shown, given = (float(np.median([x[part].mean() for part in parts])) for x in (a, b))
            if shown > 0.0 and given > 0.0:
                ratios[index] = shown / given
    return ratios
