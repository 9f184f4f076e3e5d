"""What is fixed before the first step: the training views' camera rays, emitter pixels and unit of radiance."""

import math
import sys
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurad.assembly.build import Assembly
from neurad.assembly.exposure import brightness_warning
from neurad.assembly.gains import shared_gains
from neurad.core.errors import InputError
from neurad.core.protocols import PhotoSource
from neurad.core.records import FloatArray, PixelBatch
from neurad.core.scene_records import Camera
from neurad.evidence.pixel_derivatives import TrainingPixels
from neurad.evidence.view_residuals import surface_fractions
from neurad.integrators.focus import TIMES
from neurad.integrators.primary_hits import PrimaryHits, kept_positions
from neurad.lamps.known import check_lamps
from neurad.lamps.photographed import LampPhotographs, lamp_photographs
from neurad.lamps.sky import begin_sky
from neurad.lamps.unknown import begin_lamps
from neurad.runtime.memory import free_memory, resident_memory
from neurad.runtime.numbers import check_bright
from neurad.runtime.progress import say
from neurad.runtime.reading import listed
from neurad.scene.description import Scene

LARGE = 1 << 30
"""Bytes of camera rays from which on it is said what is taken."""
_HIT, _DIRECTION, _MASK = 12, 6, 1  # bytes
BLIND = 0.25
"""Times the median fraction of pixels that meet a surface, below which a view is named."""


@dataclass(frozen=True)
class TrainingViews:
    """The training views of a run."""

    primary: PrimaryHits
    """Camera rays of the views."""
    emitter_mask: Tensor
    """Pixels that an emitter covers, in part or whole, or that a mask leaves out; they train nothing [views, pixels],
    bool. True behind the last pixel of a view that is smaller than others."""
    mean_square_radiance: float
    """Mean squared radiance of all other pixels of the photographs."""
    checksum: int = 0
    """Checksum of all photographs; 0 where they cannot change."""
    sample: PixelBatch | None = None
    """Random pixels of all photographs that show no emitter."""
    surface: FloatArray | None = None
    """Fraction of each view's pixels that meet a surface [views]; NaN where the sample has none of a view."""
    lamps: LampPhotographs | None = None
    """What the photographs show of lamps alone; None where the lamps are known."""
    pixels: int = 0
    """Number of pixels that can be drawn: they show something, and no emitter."""
    causes: list[str] | None = None
    """What is wrong with all photographs, where they show known lamps of another radiance; None where they do not."""
    scale_known: bool = False
    """Whether photographs show how bright some lamp is."""


def prepare_views(
    assembly: Assembly,
    photographs: PhotoSource,
    emitters_train: bool = False,
    check_brightness: bool = True,
) -> TrainingViews:
    """Trace the camera rays of the training views, and take the unit of radiance from the photographs.

    The radiance field and an environment that is recovered get that unit: the root of the mean squared radiance.

    Args:
        assembly: on the device where the rays are traced.
        emitters_train: let pixels that an emitter covers train too: where everything emits there are no others.
        check_brightness: warn if the photographs are far brighter or darker than the lights make the scene, and if a
            camera sees next to nothing of it.

    Raises:
        InputError: camera rays do not fit in memory, every pixel shows an emitter, the photographs are black or too
            dim, no camera sees a surface, or a lamp is far from what the photographs show.
    """
    scene, settings, device = assembly.scene, assembly.settings, assembly.world.geometry.vertices.device
    cameras = [view.camera for view in scene.train]
    kept = kept_positions(assembly.world, settings.sampling.cached_spp)
    _announce_camera_rays(cameras, kept, assembly.world.features.has_environment, device)
    # Stage 1: primary hits and the emitter mask [views, pixels].
    primary = PrimaryHits(assembly.world, cameras, kept, settings.seed, device)
    emitter_mask = _emitter_mask(primary, photographs, emitters_train, scene.name)
    # Stage 2: the unit of radiance.
    stats = photographs.dataset_stats(emitter_mask.cpu())
    surface = surface_fractions(primary, stats.sample, settings.seed)
    if check_brightness:
        check_views(scene, surface)
    if settings.objective.fireflies == "spread":
        spread = photographs.spread_fireflies(emitter_mask.cpu(), lambda: primary.sees_beyond().cpu())
        if spread > 0:
            stats = photographs.dataset_stats(emitter_mask.cpu())
            if check_brightness:
                print(
                    f"neurad: {100.0 * spread:.0f} % of the photographs' light is in single pixels far brighter than "
                    "all around them; it is spread over their surroundings (model.objective.fireflies keep leaves it; "
                    "photographs of more samples have less of it)",
                    file=sys.stderr,
                )
    mean_square = stats.mean_square_radiance
    check_bright(mean_square, stats.brightest, scene.name)
    if assembly.radiance is not None:
        assembly.radiance.set_scale(math.sqrt(mean_square))
    # Stage 3: where light and exposures begin.
    if assembly.environment is not None:
        assembly.environment.set_unit(math.sqrt(mean_square))
        begin_sky(assembly.environment, primary, stats.sample, settings.seed)
    if check_brightness:
        _begin_gains(assembly, primary, photographs, stats.sample, emitter_mask)
    lamps, causes, scale_known = None, None, False
    if assembly.lamps is not None:
        lamps = lamp_photographs(assembly.world, cameras, photographs, stats.sample, settings.seed)
        if not bool(assembly.lamps.begun):
            begin_lamps(assembly, primary, photographs, lamps, stats.sample)
        scale_known = bool((assembly.lamps.unclipped > 0).any())
    asks = check_brightness and assembly.environment is None
    if asks and (said := brightness_warning(scene, primary, stats.sample, settings.seed)):
        print(f"neurad: warning: {said}", file=sys.stderr)
    if check_brightness and assembly.lamps is None:
        causes, scale_known = check_lamps(assembly, photographs, stats.sample)
    # Stage 4: what batches need.
    kind = settings.objective.normaliser
    if kind == "blurred" or (kind == "prediction" and not settings.method.needs_field):  # no field predicts it
        photographs.request_blurred()
    if assembly.focus is not None:
        photographs.request_candidates(assembly.focus.fraction, TIMES)
    checksum = zlib.crc32(repr(stats.checksums).encode()) if stats.checksums else 0
    pixels = stats.pixels or int((~emitter_mask).sum())
    return TrainingViews(
        primary, emitter_mask, mean_square, checksum, stats.sample, surface, lamps, pixels, causes, scale_known
    )


def _announce_camera_rays(
    cameras: Sequence[Camera], cached_spp: int, has_environment: bool, device: torch.device
) -> None:
    """One line about what kept camera rays and the emitter mask take, if it is much: for each pixel a byte, and for
    each kept ray a triangle and barycentrics, in a scene with an environment its direction too.

    Args:
        cached_spp: kept rays of a pixel.
        device: that they are kept on; only a CPU's memory is compared with what is free.

    Raises:
        InputError: the machine does not have as much.
    """
    pixels = sum(camera.width * camera.height for camera in cameras)
    needed = pixels * (_MASK + cached_spp * (_HIT + (_DIRECTION if has_environment else 0)))
    if cached_spp == 0 or needed < LARGE:
        return
    size = " or ".join(dict.fromkeys(f"{camera.width} x {camera.height}" for camera in cameras))
    what = f"the camera rays of {len(cameras)} views of {size} pixels take {needed / 1e9:.3g} GB of memory"
    free = free_memory() if device.type == "cpu" else None
    stream = "--model.sampling.cached_spp 0 --data.resident 1"
    if free is not None and needed > free:
        raise InputError(f"{what}, and {free / 1e9:.3g} GB are free: stream them with {stream}")
    whole = "" if free is None else f", so the process has {(resident_memory() + needed) / 1e9:.3g} GB then"
    minutes = max(1, round(cached_spp * pixels / 5e6 / 60))  # five million rays a second are usual on a core
    say(f"{what} (about {minutes} min to trace){whole}; {stream} keeps none")


def _emitter_mask(primary: PrimaryHits, photographs: PhotoSource, emitters_train: bool, scene: str) -> Tensor:
    """Pixels that train nothing [views, pixels], bool, see :class:`TrainingViews`."""
    mask = primary.nothing() if emitters_train else primary.sees_emitter()
    ignored = photographs.ignored()
    if ignored is not None:
        mask |= ignored.to(mask.device)
    if bool(mask.all()):
        masked = "" if ignored is None else " or is black in its mask"
        raise InputError(f"scene {scene}: every pixel of every training view shows an emitter{masked}")
    return mask


def _begin_gains(
    assembly: Assembly, primary: PrimaryHits, photographs: PhotoSource, sample: PixelBatch, emitter_mask: Tensor
) -> None:
    """Let gains of photographs, where they are recovered, begin by surfaces that several of them show."""
    development = assembly.development
    if development is None or development.values is None:
        return
    development.begin(shared_gains(primary, photographs, sample, emitter_mask, assembly.settings.seed))
    begins = development.gains().detach()
    print(
        f"neurad: gains begin between {float(begins.min()):.3g} and {float(begins.max()):.3g}, by surfaces that "
        "several photographs show",
        file=sys.stderr,
    )


def check_views(scene: Scene, surface: FloatArray) -> None:
    """Name the training views whose cameras see next to nothing of the scene.

    Raises:
        InputError: no camera sees a surface.
    """
    if not np.nanmax(surface, initial=0.0) > 0.0:
        raise InputError(
            f"scene {scene.name}: no training camera sees a surface in the pixels that its photographs show; check "
            "the units and the axes of transform_matrix (x right, y up, looking along -z)"
        )
    blind = [f"{scene.train[i].name} ({100 * surface[i]:.0f} %)" for i in blind_views(surface)]
    if blind:
        print(
            f"neurad: warning: of the pixels of training view{'s' if len(blind) > 1 else ''} {listed(blind)} "
            f"few meet a surface (median of all views: "
            f"{100 * float(np.nanmedian(surface)):.0f} %); check the pose",
            file=sys.stderr,
        )


def blind_views(surface: FloatArray) -> list[int]:
    """Views that see next to nothing of the scene beside the others.

    Args:
        surface: fraction of each view's pixels that meet a surface [views].
    """
    return [int(i) for i in np.flatnonzero(surface < BLIND * float(np.nanmedian(surface)))]


def training_pixels(assembly: Assembly, views: TrainingViews, photographs: PhotoSource) -> TrainingPixels:
    """Where the pixels of a run's photographs say what they do of its present materials."""
    return TrainingPixels(
        assembly.estimator, views.primary, photographs, views.emitter_mask, assembly.settings.seed,
        views.mean_square_radiance, assembly.development,
    )  # fmt: skip
