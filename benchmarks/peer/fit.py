"""One run of the peer, in a process of its own (:func:`benchmarks.bench.peer.work`)."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch

from benchmarks.loaded import load_mitsuba
from benchmarks.peer.models import Networks, Pyramid
from benchmarks.peer.replay import Replay
from benchmarks.peer.voxels import SurfaceVoxels, VoxelMaterials
from neurad.core.errors import InputError
from neurad.core.parameters import ALBEDO, ROUGHNESS
from neurad.core.protocols import Tracer
from neurad.core.ranges import Count, Fraction, NonNegative, Positive, Range, Seed, checked
from neurad.core.records import FloatArray
from neurad.fields.material import MaterialField
from neurad.fields.settings import FieldConfig, GridConfig
from neurad.formats.load import load_scene
from neurad.images.photographs import read_view
from neurad.optim.polyak_average import PolyakAverage, averaged
from neurad.optim.schedule import cosine, warmup
from neurad.runtime import clock
from neurad.runtime.allocator import imports_kept
from neurad.runtime.machine import usable_cores
from neurad.runtime.tables import append_csv, write_csv
from neurad.scene.description import Scene

if TYPE_CHECKING:
    from neurad.metrics.held_out import HeldOut

MARKS = 20
"""Evaluations in a run, evenly spaced, as in a fit that is limited by time."""
WARMUP = 5
"""Steps over which the learning rates rise."""
COLUMNS = ("iteration", "seconds", "albedo_psnr", "roughness_psnr", "loss", "not_finite")


Moment = Annotated[float, Range(0.0, 1.0, below=True)]
"""Decay of a moment of Adam."""


@dataclass
class PeerSettings:
    """A run of the peer. The defaults are the best found; see :mod:`benchmarks.bench.peer`."""

    kind: str
    """'grid' or 'network'."""
    seconds: Positive
    """Length of the run, from the start of the process, evaluations left out."""
    out: str
    """CSV file to write."""
    root: str | None = None
    scene: str | None = None
    max_steps: Count | None = None
    """Ends the run earlier; for tests."""
    resolution: Annotated[int, Range(2, 1 << 10)] = 128
    """Voxels along the longest side of the scene."""
    pixels: Count = 4096
    """In a batch."""
    samples: Annotated[int, Range(2, 1 << 16)] = 4
    """Paths from each."""
    max_depth: Annotated[int, Range(2, 1 << 16)] = 20
    rr_depth: Count = 3
    rate: NonNegative = 3e-2
    """Learning rate of albedo."""
    roughness_rate: NonNegative = 1e-2
    beta1: Moment = 0.9
    beta2: Moment = 0.99
    final: Fraction = 0.02
    """Fraction of the rates left at the end of the cosine."""
    average: Fraction = 0.0
    """Fraction of the iterations so far over which scored values are averaged, as in ``neurad fit``; 0 is none."""
    epsilon: Positive = 0.01
    seed: Seed = 0
    albedo: dict[str, Any] = field(default_factory=dict)
    """Sizes of the albedo network, as in a config's ``model.albedo``."""
    roughness: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse what does not exist."""
        checked(self)


BEST: dict[str, dict[str, Any]] = {
    "grid": {"pixels": 4096, "samples": 16},
    "network": {"pixels": 8192, "samples": 8, "resolution": 64, "rate": 1e-2, "roughness_rate": 3e-3},
}
"""What differs from the defaults in the best settings found for each kind."""


def main(path: Path) -> None:
    """Run with the settings of a JSON file.

    Raises:
        InputError: as :func:`fit`.
    """
    with imports_kept():  # as ``neurad fit`` does
        load_mitsuba()
    fit(PeerSettings(**json.loads(path.read_text())))


def fit(settings: PeerSettings) -> None:
    """Optimise for the time given and write one row an evaluation.

    Raises:
        InputError: Mitsuba cannot run, or the scene cannot be used.
    """
    mi = load_mitsuba()
    torch.set_num_threads(usable_cores())
    torch.manual_seed(settings.seed)
    scene = load_scene(settings.root, settings.scene)
    photographs, has_alpha = _photographs(scene)
    voxels = SurfaceVoxels(scene, settings.resolution)
    with clock.excluded():
        held_out = _held_out(scene)
    model = _model(settings, scene, voxels, held_out.tracer)
    replay = Replay(
        mi, scene, voxels, photographs, settings.max_depth, settings.rr_depth, has_alpha,
        settings.epsilon, settings.seed,
    )  # fmt: skip
    report = _Report(Path(settings.out), held_out, voxels)
    average = PolyakAverage(model, settings.average, every=1) if settings.average > 0 else None
    iteration = mark = 0
    while True:
        progress = clock.training_seconds() / settings.seconds
        if settings.max_steps is not None:
            progress = max(progress, iteration / settings.max_steps)
        if progress >= 1.0:
            break
        if int(progress * MARKS) > mark:
            mark = int(progress * MARKS)
            report(iteration, model, average)
        values = model()
        for optimizer in model.optimizers:
            optimizer.zero_grad()
            for group in optimizer.param_groups:
                group["lr"] = group["rate"] * warmup(iteration, WARMUP) * cosine(progress, settings.final)
        gradient = replay.step(values.detach().numpy(), settings.pixels, settings.samples)
        values.backward(torch.from_numpy(gradient.values))
        for optimizer in model.optimizers:
            optimizer.step()
        report.add(gradient.loss, gradient.not_finite)
        iteration += 1
        if average is not None:
            average.update(iteration)
    report(iteration, model, average)


def _model(settings: PeerSettings, scene: Scene, voxels: SurfaceVoxels, tracer: Tracer) -> Pyramid | Networks:
    rates, betas = (settings.rate, settings.roughness_rate), (settings.beta1, settings.beta2)
    if settings.kind == "grid":
        return Pyramid(voxels, *rates, betas)
    with clock.excluded():
        albedo, roughness = _sizes(settings, scene, tracer)
    bounds = torch.from_numpy(scene.bounds)
    second = None if scene.features.is_diffuse else MaterialField(ROUGHNESS, roughness, bounds)
    return Networks(voxels, MaterialField(ALBEDO, albedo, bounds), second, *rates, betas)


def _sizes(settings: PeerSettings, scene: Scene, tracer: Tracer) -> tuple[FieldConfig, FieldConfig]:
    """Sizes of the networks of albedo and roughness, as in ``neurad fit``; what it imports is no part of the race."""
    from neurad.assembly.region import finest_cells, resolve_finest

    cells = cache(partial(finest_cells, tracer, scene))

    def field_of(described: dict[str, Any]) -> FieldConfig:
        sizes = {key: value for key, value in described.items() if key != "grid"}
        return resolve_finest(FieldConfig(grid=GridConfig(**described.get("grid", {})), **sizes), cells)

    return field_of(settings.albedo), field_of(settings.roughness)


def _photographs(scene: Scene) -> tuple[FloatArray, bool]:
    """Training photographs [views, h * w, 3], and whether alpha is below 1 in one."""
    images, first = [], scene.train[0].camera
    for view in scene.train:
        if view.image is None:
            raise InputError(f"training view {view.name}: it has no photograph")
        if view.mask is not None or (view.camera.width, view.camera.height) != (first.width, first.height):
            raise InputError(f"training view {view.name}: the peer takes photographs of one size and without masks")
        images.append(read_view(view))
    stacked = np.stack([image[..., :3] for image in images])
    return stacked.reshape(len(images), -1, 3), any(image.shape[-1] == 4 for image in images)


def _held_out(scene: Scene) -> HeldOut:
    """The metrics of ``neurad fit``; importing and building them is evaluation, so it is done in here."""
    from neurad.metrics.held_out import HeldOut
    from neurad.scene.geometry import Geometry
    from neurad.tracing.select import make_tracer

    geometry = Geometry(scene)
    return HeldOut(scene, geometry, make_tracer("embree", geometry.vertices, geometry.faces)).read()


class _Report:
    """Scores the present values and appends a row; none of it counts as training time."""

    def __init__(self, path: Path, held_out: HeldOut, voxels: SurfaceVoxels) -> None:
        self.path, self.held_out, self.voxels = path, held_out, voxels
        self.losses: list[float] = []
        self.not_finite = 0
        write_csv(path, COLUMNS, [])

    def add(self, loss: float, not_finite: int) -> None:
        """What a step found."""
        self.losses.append(loss)
        self.not_finite += not_finite

    @torch.no_grad()
    def __call__(self, iteration: int, model: Pyramid | Networks, average: PolyakAverage | None) -> None:
        """Evaluate what the model has, or has on average."""
        from neurad.metrics.held_out_scores import score

        with clock.excluded(), averaged(average):
            values = model()
            scores = score(self.held_out, self.held_out.predict(VoxelMaterials(self.voxels, values)))
            row: dict[str, Any] = {
                "iteration": iteration,
                "seconds": f"{clock.training_seconds():.2f}",
                "loss": float(np.mean(self.losses)) if self.losses else None,
                "not_finite": self.not_finite,
            }
            row.update({key: f"{scores[key]:.4f}" for key in ("albedo_psnr", "roughness_psnr") if key in scores})
            append_csv(self.path, COLUMNS, row)
            self.losses.clear()
