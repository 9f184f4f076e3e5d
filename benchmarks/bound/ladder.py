"""The ladder from a fit up to the best possible, one cause a rung."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse import csr_array

from benchmarks.bound.cells import CellMaterials, SurfaceCells, encode
from benchmarks.bound.fields import fit_fields, predicted, training_run
from benchmarks.bound.photographs import Predicted, misfit, noise_covariance, photo_noise, predict
from benchmarks.bound.recovery import LOOSE_TOLERANCE, Photographed, Prior, Recovery, Response, SeenDirectly
from benchmarks.true_views import check_truth, training_truth
from neurad.core.errors import InputError
from neurad.core.parameters import RECOVERED, ROUGHNESS, recovered
from neurad.core.protocols import Materials
from neurad.core.records import BoolArray, FloatArray, IntArray, SurfaceInteraction
from neurad.integrators.estimator import Estimator
from neurad.integrators.film import box_mean
from neurad.integrators.method import SceneModel
from neurad.integrators.primary_hits import PrimaryHits
from neurad.metrics.held_out import HeldOut, Maps
from neurad.metrics.lit_glossy import lit_glossy
from neurad.metrics.scores import Pool, psnr
from neurad.runs.load import LoadedRun
from neurad.scene.textures import TrueMaterials
from neurad.training.session import TrainingRun

POSITIONS, MAX_FOOTPRINT = (16, 9, 4), 1 << 23
"""In each training pixel, of which its footprint is made: as many as make no more than so many in all."""
TRUTH_SPP = 64
"""Samples per pixel of true maps, whose own noise is part of them."""
SEED = 20231123

Errors = dict[str, float]
"""Mean squared errors by map and region, such as ``roughness_lit_glossy``."""


@dataclass(frozen=True)
class Rung:
    """What is left of the truth with all causes up to this one."""

    name: str
    cause: str
    errors: Errors

    def psnr(self, key: str) -> float:
        """In dB."""
        return psnr(self.errors[key])


def rungs(resolution: Errors, noise: Errors, fields: Errors, light: Errors, ours: Errors) -> list[Rung]:
    """The ladder of some mean squared errors: what the fields lose beside the resolution adds to all that follows.

    Args:
        resolution: of true maps averaged over the training pixels.
        noise: of the best linear estimate from photographs with noise, in light that is known.
        fields: of the fields fitted to the true maps of the training pixels.
        light: of the best linear estimate from the photographs in the light of the radiance field.
        ours: of the fit.
    """
    lost = {key: max(0.0, fields[key] - resolution[key]) for key in fields}
    with_light = {key: max(light[key], noise[key]) + lost[key] for key in lost}
    return [
        Rung("resolution", "pixels of the photographs", resolution),
        Rung("noise", "noise of the photographs, and what no highlight tells: the bound", noise),
        Rung("fields", "the fields, fitted to the true maps", {key: noise[key] + lost[key] for key in lost}),
        Rung("light field", "light as the radiance field has it", with_light),
        Rung("ours", "noise of the samples, time and everything else", ours),
    ]


class Ladder:
    """All that the rungs are made from.

    Args:
        run: a fit.
        report: told what is done.

    Raises:
        InputError: the run has no radiance field or known materials, the scene has smooth surfaces, or true maps or
            photographs are missing.
    """

    def __init__(self, run: LoadedRun, report: Callable[[str], None] = print) -> None:
        if run.radiance is None or isinstance(run.materials, TrueMaterials):
            raise InputError(
                f"--ckpt_path {run.checkpoint}: the bound needs a fit of materials by a method with a radiance field"
            )
        self.run, self.report = run, report
        scene, world = run.scene, run.world
        if world.delta is not None:
            raise InputError(f"scene {scene.name}: footprints through glass and in mirrors are not known to the bound")
        self.truth: Materials = TrueMaterials(scene, world.geometry)
        self.held_out = HeldOut(scene, world.geometry, world.tracer).read()
        check_truth(self.held_out, "held-out")
        self.maps, photographs = training_truth(run)
        pixels = len(scene.train) * scene.train[0].camera.width * scene.train[0].camera.height
        self.positions = next((n for n in POSITIONS if n * pixels <= MAX_FOOTPRINT), POSITIONS[-1])
        self.training: TrainingRun = training_run(scene, run.settings, photographs)
        device, cameras = world.geometry.vertices.device, [view.camera for view in scene.train]
        primary = PrimaryHits(world, cameras, self.positions, run.settings.seed, device)
        self.left_out = self.training.views.emitter_mask.clone()
        views, pixels = self.left_out.shape
        missed = primary.prim.view(views, pixels, self.positions) < 0
        self.left_out |= missed.any(-1)
        self.photographs = self.training.photographs.photographs.numpy()  # type: ignore[attr-defined]
        report("cells of what the training views see")
        self.region = low, size = self._region(primary)
        codes = np.concatenate(
            [self._codes(primary, view) for view in range(views)]
        )  # [views * pixels * self.positions]
        kept = (~self.left_out).view(-1).cpu().numpy()
        self.kept: IntArray = np.flatnonzero(kept)
        codes = codes.reshape(-1, self.positions)[self.kept]
        self.cells = SurfaceCells.of(low, size, np.unique(codes), len(self.kept))
        self._first_finest = sum(self.cells.counts[:-1])
        self.footprint = self._footprint(codes)
        self.prior, self.spread = self._prior(primary, codes, device)
        report(f"{self.cells.counts[-1]} cells, {len(self.kept)} pixels")

    # ---- what there is

    @property
    def _pair(self) -> slice:
        """Two of the positions of every pixel, of an odd number of them, too."""
        return slice(0, self.positions - 1, self.positions // 2)

    def _region(self, primary: PrimaryHits) -> tuple[FloatArray, float]:
        """Corner and longest side of what the training views see."""
        ends = []
        for view in range(len(self.left_out)):
            si = self._points(primary, view, slice(0, 1))
            if bool(si.valid.any()):
                p = si.p[si.valid]
                ends.append(torch.stack((p.amin(0), p.amax(0))).cpu().numpy())
        low, high = np.min([end[0] for end in ends], 0), np.max([end[1] for end in ends], 0)
        return low, float(np.max(np.subtract(high, low)))

    def _codes(self, primary: PrimaryHits, view: int) -> IntArray:
        """Cells of the kept positions of a view [pixels * self.positions]."""
        return encode(self._points(primary, view, slice(None)), *self.region)

    def _points(self, primary: PrimaryHits, view: int, chosen: slice) -> SurfaceInteraction:
        """Surface points of a view at some of the kept positions of every pixel."""
        here = primary.hits.view(len(self.run.scene.train), primary.pixels, self.positions, 3)[view, :, chosen].reshape(
            -1, 3
        )
        bary = here[:, 1:].contiguous().view(torch.float32)
        prim, valid = here[:, 0].long(), here[:, 0] >= 0
        origin = primary.origin[view].expand(len(here), 3)
        si = primary.world.geometry.interact_at(prim, bary[:, 0], bary[:, 1], origin, valid)
        return replace(si, wo=torch.nn.functional.normalize(origin - si.p, dim=-1))

    def _footprint(self, codes: IntArray) -> csr_array:
        """Footprints of the pixels that count, among the finest cells; each cell of a position weighs the same."""
        column = self.cells.find(codes.reshape(-1)) - self._first_finest
        start = np.arange(len(codes) + 1, dtype=np.int64) * self.positions
        weight = np.full(len(column), 1.0 / self.positions, np.float32)
        return csr_array((weight, column, start), shape=(len(codes), self.cells.counts[-1]))

    def _prior(self, primary: PrimaryHits, codes: IntArray, device: torch.device) -> tuple[Prior, FloatArray]:
        """Prior by true materials at two positions of each pixel, and their covariance in pixels [kept, 4, 4]: means
        over 5 x 5 of them.
        """
        values = []
        for view in range(len(self.left_out)):
            si = self._points(primary, view, self._pair)
            surface = self.truth(si)
            values.append(torch.cat((surface.albedo, surface.roughness), -1).view(primary.pixels, 2, 4).cpu())
        both = torch.cat(values).numpy()  # [views * pixels, 2, 4]
        if ROUGHNESS not in self.run.scene.parameters:
            both[..., 3] = 1.0
        width = self.run.scene.train[0].camera.width
        apart = torch.from_numpy(both[:, 0] - both[:, 1])
        power = (apart[:, :, None] * apart[:, None, :] / 2).view(len(self.left_out), -1, width, 16)
        spread = torch.stack([box_mean(image, 5) for image in power]).view(-1, 4, 4).numpy()[self.kept]
        pairs = both[self.kept]
        column = self.footprint.indices.reshape(-1, self.positions)[:, self._pair].reshape(-1)
        shape = len(column), self.footprint.shape[1]
        one = csr_array((np.ones(len(column), np.float32), column, np.arange(len(column) + 1)), shape=shape)
        return Prior.of(self.cells, one, pairs.reshape(-1, 4)), spread

    # ---- maps and errors

    def maps_of(self, values: FloatArray) -> list[Maps]:
        """What the held-out views show of values in the cells of all levels [cells, 4], less the mean."""
        return [*self.held_out.predict(CellMaterials(self.cells, values, self.prior.mean))]

    def errors(self, maps: Sequence[Maps], regions: Mapping[str, Sequence[BoolArray]]) -> Errors:
        """Over the counted pixels, and over those of each region."""
        result = {}
        for suffix, masks in {"": None, **regions}.items():
            for name in (parameter.name for parameter in recovered(self.run.scene.parameters)):
                pool = Pool()
                for index, entry in enumerate(maps):
                    counted = self.held_out.counted(index)
                    mask = counted if masks is None else counted & masks[index]
                    pool.add(entry[name], self.held_out.truth(index)[f"{name}_true"], mask)
                if scores := pool.scores():
                    result[f"{name}_{suffix}".rstrip("_")] = 10.0 ** (-scores["psnr"] / 10.0)
        return result

    def regions(self) -> dict[str, list[BoolArray]]:
        """Pixels that are scored apart."""
        if ROUGHNESS not in self.run.scene.parameters:
            return {}
        model = SceneModel(self.run.world, self.truth, self.run.radiance)
        return {"lit_glossy": lit_glossy(self.held_out, self.run.settings.method, model)}

    # ---- the rungs

    def climb(self, seconds: float, spp: int) -> list[Rung]:
        """Measure every rung.

        Args:
            seconds: of the fields' fit to the true maps.
            spp: samples a pixel behind what photographs tell.
        """
        self.report("which pixels are lit and glossy")
        regions = self.regions()
        ours = self.errors(self.held_out.predict(self.run.materials), regions)
        self.report("resolution")
        seen = self.maps.reshape(-1, 4)[self.kept]
        sampling = self.spread * np.float32(1.0 / self.positions + 1.0 / TRUTH_SPP)  # of counted positions
        sampling += np.float32(1e-7) * np.eye(4, dtype=np.float32)
        direct = self._recovery(SeenDirectly(), np.sqrt(np.einsum("ncc->nc", sampling)))
        resolution = self.errors(self.maps_of(direct(direct.less_mean(seen))), regions)
        self.report(f"what photographs tell, {spp} samples a pixel")
        noise, light = self._photographed(seen, sampling, spp, regions)
        self.report(f"fields fitted to the true maps, {seconds:g} s")
        truth = {"albedo": torch.from_numpy(self.maps[..., :3]), "roughness": torch.from_numpy(self.maps[..., 3:])}
        fit_fields(self.training, {name: truth[name] for name in ours if name in truth}, seconds)
        fields = self.errors(predicted(self.training, self.held_out), regions)
        return rungs(resolution, noise, fields, light, ours)

    def _recovery(self, response: Response, sigma: FloatArray) -> Recovery:
        return Recovery(self.cells, self.prior, self.footprint, response, sigma)

    def _photographed(
        self, seen: FloatArray, sampling: FloatArray, spp: int, regions: Mapping[str, Sequence[BoolArray]]
    ) -> tuple[Errors, Errors]:
        """Errors of the best linear estimate: with simulated noise in known light, and from the photographs themselves
        in the light of the radiance field.
        """
        views, width = len(self.left_out), self.run.scene.train[0].camera.width
        found = self._predicted(self.run.assembly.estimator, spp, width)
        response = Photographed.of(*(x.reshape(-1, 3)[self.kept] for x in (found.by_albedo, found.by_roughness)))
        jacobian = response.jacobian  # [kept, 3, 4]
        positions: FloatArray = (jacobian @ sampling @ jacobian.transpose(0, 2, 1)).astype(np.float32)  # [kept, 3, 3]
        drawn, covariance = self._noise(found, positions, (views, -1, width, 3))
        recovery, white = self._whitened(response, covariance + positions)
        noise = self.errors(self.maps_of(recovery(recovery.less_mean(seen) + white(drawn))), regions)
        # Who knows that the light is wrong, and by how much around each pixel, trusts photographs less. What is wrong
        # with the light is taken for independent in each channel: its colour may be what is wrong.
        counted = ~self.left_out.cpu().numpy().reshape(views, -1, width)
        wrong = misfit(self.photographs.reshape(*counted.shape, 3), found, counted).reshape(-1, 3)[self.kept]
        more = (wrong - np.einsum("ncc->nc", covariance)).clip(0.0)
        covariance = covariance + positions + more[:, :, None] * np.eye(3, dtype=np.float32)
        recovery, white = self._whitened(response, covariance)
        values = recovery(recovery.less_mean(seen))
        photographs = self.photographs.reshape(-1, 3)[self.kept]
        differences = [photographs - picture.reshape(-1, 3)[self.kept] for picture in found.pictures]
        first, second = (values + recovery(white(difference), LOOSE_TOLERANCE) for difference in differences)
        # The product of two errors whose samples are independent has no noise of the samples in it.
        half = self.errors(self.maps_of((first + second) * np.float32(0.5)), regions)
        apart = self._spread(self.maps_of(first), self.maps_of(second), regions)
        return noise, {key: half[key] - apart[key] / 4 for key in half}

    def _whitened(
        self, response: Photographed, covariance: FloatArray
    ) -> tuple[Recovery, Callable[[FloatArray], FloatArray]]:
        """The estimate from sums of the channels whose noise is independent and of variance 1, and what makes them of
        radiance [kept, 3], by the ``covariance`` of that [kept, 3, 3].
        """
        channels = np.linalg.inv(np.linalg.cholesky(covariance.astype(np.float64))).astype(np.float32)

        def white(radiance: FloatArray) -> FloatArray:
            mixed: FloatArray = np.einsum("ncd,nd->nc", channels, radiance)
            return mixed

        return self._recovery(response.mixed(channels), np.ones((len(covariance), 3), np.float32)), white

    def _noise(self, found: Predicted, positions: FloatArray, shape: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
        """Noise such as that of the photographs in the pixels that count [kept, 3], and its covariance [kept, 3, 3];
        ``positions`` is the covariance [kept, 3, 3] that positions add.
        """
        photographs, maps = self.photographs.reshape(shape), self.maps[..., :3].reshape(shape)
        sigma = np.zeros((self.left_out.numel(), 3), np.float32)
        known = np.zeros((self.left_out.numel(), 3, 3), np.float32)
        pairs = zip(photographs, maps, strict=True)
        sigma[self.kept] = np.stack([photo_noise(*pair) for pair in pairs]).reshape(-1, 3)[self.kept]
        known[self.kept] = positions
        shared = noise_covariance(
            photographs, found, sigma.reshape(photographs.shape), known.reshape(*photographs.shape, 3)
        )
        sigma = sigma[self.kept]
        light = np.maximum(self.photographs.reshape(-1, 3)[self.kept], 1e-6)
        size = 100 * float(np.median(sigma / light)) * float(np.sqrt(shared[0, 0]))
        common = float(shared[~np.eye(3, dtype=bool)].mean() / shared[0, 0])
        self.report(f"noise of the photographs: {size:.1f} % (median), correlation of channels {common:.2f}")
        drawn = np.random.default_rng(SEED).standard_normal(sigma.shape, np.float32)
        drawn = sigma * (drawn @ np.linalg.cholesky(shared).T.astype(np.float32))
        return drawn, sigma[:, :, None] * shared * sigma[:, None, :]

    def _predicted(self, estimator: Estimator, spp: int, width: int) -> Predicted:
        primary = self.training.views.primary
        return predict(estimator, self.truth, primary, self.left_out, spp, SEED, width)

    def _spread(
        self, first: Sequence[Maps], second: Sequence[Maps], regions: Mapping[str, Sequence[BoolArray]]
    ) -> Errors:
        """Mean squared differences of two kinds of maps."""
        truth = self.held_out.truth
        moved = [
            {name: truth(i)[f"{name}_true"] + a[name] - b[name] for name in RECOVERED if f"{name}_true" in truth(i)}
            for i, (a, b) in enumerate(zip(first, second, strict=True))
        ]
        return self.errors(moved, regions)
