"""Scores, error bars and plain paint of a module's present state, inside and outside of a fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from neurad.assembly.build import Assembly
from neurad.assembly.common_causes import common_causes
from neurad.assembly.fitted_materials import FittedMaterials
from neurad.core.errors import InputError
from neurad.core.parameters import ALBEDO
from neurad.core.protocols import PhotoSource
from neurad.core.records import Float64Array, FloatArray
from neurad.core.rng import Stream
from neurad.evidence.bar_maps import predict_bars
from neurad.evidence.error_bars import ErrorBars, measure
from neurad.evidence.paint import find_paint
from neurad.evidence.pixel_derivatives import SPP, pixel_derivatives
from neurad.evidence.texture_offsets import texture_offsets
from neurad.evidence.view_residuals import view_residuals
from neurad.fields.segments import Segments
from neurad.lamps.scores import EXTRA, MISSED, lamp_scores, read_lamps_true
from neurad.metrics.effort import EvaluationResolution
from neurad.metrics.environment import EnvironmentScores
from neurad.metrics.held_out import HeldOut
from neurad.metrics.held_out_scores import albedo_factors
from neurad.optim.polyak_average import averaged
from neurad.training.evaluate import Evaluation, evaluate
from neurad.training.guard import Guard
from neurad.training.schedule import Counters
from neurad.training.training_views import TrainingViews, prepare_views, training_pixels

if TYPE_CHECKING:
    from neurad.training.inverse import InverseRenderer

BARS_FRACTION = 0.04
"""Samples of the pass for error bars over those that the fit has drawn. One of them costs about half of one of a
training step."""
MIN_PIXELS, MAX_PIXELS = 64, 1 << 18
"""Pixels in that pass; of fewer nothing can be said."""
PAINT_POINTS = 1 << 16
"""Photographed points that are looked at for plain paint."""
_PAINT_STREAM = 67  # last number of the stream's key


class Scoring:
    """Looks at the averages of the weights; its rays and seconds do not count."""

    def __init__(self, run: InverseRenderer, guard: Guard) -> None:
        self.run, self.guard = run, guard
        self.effort = EvaluationResolution()
        """How much of the held-out views evaluations look at. Set before a fit starts."""
        self.found_lamps = False
        """Whether the meshes that shine were found by photographs."""
        self._held_out: HeldOut | None = None
        self._light: EnvironmentScores | None = None
        self._lamps_true: tuple[Float64Array, int] | None = None
        self._bars: tuple[int, ErrorBars] | None = None

    @property
    def held_out(self) -> HeldOut:
        """The held-out views, as much of them as evaluations look at."""
        if self._held_out is None:
            world, effort = self.run.assembly.world, self.effort
            self._held_out = HeldOut(self.run.assembly.scene, world.geometry, world.tracer, effort.grid, effort.stride)
        return self._held_out

    def restart(self, effort: EvaluationResolution) -> None:
        """Look at so much of the held-out views from now on."""
        self.effort, self._held_out, self._light = effort, None, None

    def read_lamps_true(self, path: str | None, found: bool) -> None:
        """Read what recovered lamps are scored against.

        Args:
            path: of the table; None where nothing is given.
        """
        scene, self.found_lamps = self.run.assembly.scene, found
        if path is None or (self.run.assembly.lamps is None and not found):
            return
        wholes = {mesh.name: mesh.part_of for mesh in scene.meshes if mesh.part_of is not None}
        self._lamps_true = read_lamps_true(path, self._lamp_names(), found, wholes)

    def _lamp_names(self) -> list[str]:
        lamps = self.run.assembly.lamps
        return [] if lamps is None else [self.run.assembly.scene.meshes[index].name for index in lamps.mesh.tolist()]

    def evaluate(
        self, render_spp: int = 4, glossy: bool = False, steady: bool = False, bars: ErrorBars | None = None
    ) -> Evaluation:
        """Score the present materials and radiance field on held-out views.

        The arguments are those of :func:`neurad.training.evaluate.evaluate`.
        """
        assembly, scene = self.run.assembly, self.run.assembly.scene
        held_out, development = self.held_out, assembly.development
        held_out.respond = None if development is None else development.respond
        with averaged(assembly.average), assembly.world.tracer.uncounted():
            if self._light is None and assembly.environment is not None:
                assert scene.environment is not None
                size = assembly.environment.width, assembly.environment.height
                self._light = EnvironmentScores(scene.environment, assembly.world, held_out.training, *size)
            light = None
            if self._light is not None and assembly.environment is not None:
                light = assembly.environment, self._light
            result = evaluate(held_out, self.run.assembly.estimator, render_spp, glossy, light, scene, steady, bars)
            result.scores.update(self._lamp_scores(result))
        self.guard.images(self.run.counters.iteration, result.maps, [view.name for view in held_out.views])
        return result

    def _lamp_scores(self, found: Evaluation) -> dict[str, float]:
        if self._lamps_true is None:
            return {}
        lamps, (truth, missed) = self.run.assembly.lamps, self._lamps_true
        if lamps is None:  # none was found
            return {MISSED: float(missed), EXTRA: 0.0}
        factors = albedo_factors(self.held_out, found.maps) if lamps.values.requires_grad else {}
        scores = lamp_scores(lamps.found(), truth, self._lamp_names(), factors)
        if self.found_lamps:
            scores |= {MISSED: float(missed), EXTRA: float((~truth.any(-1)).sum())}
        return scores

    def find_paint(self, ends: bool) -> None:
        """Let results show plain paint where a fit ``ends``, by the error bars without it; before that they show none,
        nor what an earlier fit ended with.
        """
        assembly, views, iteration = self.run.assembly, self.run.training_views, self.run.iteration
        materials = assembly.materials
        segments = materials.recovered[ALBEDO.name].segments if isinstance(materials, FittedMaterials) else None
        if segments is None:
            return
        segments.paint.zero_()
        if not ends or views is None or (bars := self.error_bars()) is None:
            return
        self._bars = iteration, bars
        with averaged(assembly.average), assembly.world.tracer.uncounted():
            _show_paint(segments, assembly, views, bars, iteration)

    def error_bars(self) -> ErrorBars | None:
        """Error bars of the present materials, see :func:`error_bars`.

        Raises:
            InputError: outside of a fit the training photographs are read for it, and one is missing or wrong; or they
                are of another light.
        """
        if self.run.other_light:
            raise InputError("they are those of the light of the fit, which is another one here")
        if self._bars is not None and self._bars[0] == self.run.iteration:
            return self._bars[1]
        run, assembly, views = self.run, self.run.assembly, self.run.training_views
        # The trainer tests in inference mode, in which nothing can be differentiated.
        with torch.inference_mode(False), torch.no_grad(), averaged(assembly.average):
            if views is None:
                with assembly.world.tracer.uncounted():
                    views = prepare_views(assembly, run.photographs, check_brightness=False)
            return error_bars(assembly, views, run.photographs, run.counters)

    def bar_maps(self, bars: ErrorBars) -> list[dict[str, FloatArray]]:
        """``albedo_std`` and ``roughness_std`` of the held-out views, see :func:`predict_bars`."""
        assembly = self.run.assembly
        assert isinstance(assembly.materials, FittedMaterials)
        with averaged(assembly.average), assembly.world.tracer.uncounted():
            return predict_bars(self.held_out, bars, assembly.materials)

    def view_residuals(self) -> FloatArray | None:
        """How far each training photograph is from what is recovered [views], see :func:`view_residuals`. None outside
        of a fit.
        """
        views, assembly = self.run.training_views, self.run.assembly
        if views is None or views.sample is None:
            return None
        with averaged(assembly.average):
            sample = views.sample if assembly.development is None else assembly.development(views.sample)
            return view_residuals(self.run.assembly.estimator, views.primary, sample, self.run.settings.seed)

    def common_causes(self) -> list[str]:
        """What is wrong with all training photographs, see :mod:`neurad.assembly.common_causes`, and how far they lie
        beside each other, see :mod:`neurad.evidence.texture_offsets`. Nothing outside of a fit.
        """
        views, assembly = self.run.training_views, self.run.assembly
        if views is None:
            return []
        train = self.run.assembly.scene.train
        cameras = [view.camera for view in train]
        given = assembly.world, cameras, self.run.photographs, self.run.settings.seed, assembly.development
        causes = views.causes
        if causes is None:
            causes = common_causes(*given, scale_known=views.scale_known)
        if not self.run.photographs.has_photographs:
            return causes
        offsets = texture_offsets(*given).summary(len(train))
        return [*causes, *offsets.sentences([view.name for view in train])]


def error_bars(
    assembly: Assembly, views: TrainingViews, photographs: PhotoSource, counters: Counters
) -> ErrorBars | None:
    """Error bars of the present materials, from pixels that the fit would have drawn next; the same ones at every call.

    None where materials are known, and of a fit too short to have drawn samples for :data:`MIN_PIXELS` pixels. Nothing
    of the run changes.

    Args:
        assembly: with the materials that are reported, the averaged ones if the run averages.
    """
    if not isinstance(assembly.materials, FittedMaterials):
        return None
    count = min(int(BARS_FRACTION * counters.samples) // SPP, MAX_PIXELS, views.pixels)
    if count < MIN_PIXELS:
        return None
    with assembly.world.tracer.uncounted():
        pixels = pixel_derivatives(training_pixels(assembly, views, photographs), counters.iteration, count)
    return None if pixels is None else measure(pixels, assembly.materials, views.pixels, counters.iteration)


@torch.no_grad()
def _show_paint(segments: Segments, assembly: Assembly, views: TrainingViews, bars: ErrorBars, iteration: int) -> None:
    """Find the paint of the albedo's segments by photographed points, for results to show; the materials are those that
    are reported.
    """
    materials = assembly.materials
    assert isinstance(materials, FittedMaterials)
    if views.sample is None:
        return
    stream = Stream(assembly.settings.seed, iteration, _PAINT_STREAM, device=segments.paint.device)
    si, _ = views.primary.some(views.sample, PAINT_POINTS, stream)
    emission = assembly.world.geometry.emission.amax(-1)
    si = si[(si.valid & (emission[si.prim.clamp_min(0)] <= 0)).nonzero().squeeze(-1)]
    albedo, std = materials(si).albedo.cpu().numpy(), bars.at(materials, si.p, si.prim)[ALBEDO.name]
    segment = segments.at(si.p, si.prim).cpu().numpy()
    segments.paint.copy_(torch.from_numpy(find_paint(albedo, std, segment, len(segments.paint))))
