"""The ladder from a fit up to the best possible, one cause a rung."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse import csr_array

from benchmarks.bound.cells import CellMaterials, SurfaceCells, encode
from benchmarks.bound.photographs import Predicted, noise_covariance, photo_noise, predict
from benchmarks.bound.recovery import Prior, Recovery, Response
from benchmarks.photos import PhotosInMemory
from neurad.core.errors import InputError
from neurad.core.parameters import ROUGHNESS
from neurad.core.protocols import Materials
from neurad.core.records import BoolArray, FloatArray, IntArray, SurfaceInteraction
from neurad.integrators.film import box_mean
from neurad.integrators.method import SceneModel
from neurad.integrators.primary_hits import PrimaryHits
from neurad.metrics.held_out import HeldOut
from neurad.metrics.held_out_scores import score
from neurad.metrics.lit_glossy import lit_glossy
from neurad.runs.load import LoadedRun
from neurad.scene.textures import TrueMaterials
from neurad.training.session import TrainingRun

POSITIONS, MAX_FOOTPRINT = (16, 9, 4), 1 << 23
"""In each training pixel, of which its footprint is made: as many as make no more than so many in all."""
TRUTH_SPP = 64
"""Samples per pixel of true maps, whose own noise is part of them."""
SEED = 20231123


@dataclass(frozen=True)
class Rung:
    """What is left of the truth with all causes up to this one."""

    name: str
    cause: str
    scores: dict[str, float]
    """Of held-out views, such as ``roughness_psnr_lit_glossy``."""

    def error(self, what: str) -> float:
        """Mean squared error of a map."""
        return math.pow(10.0, -self.scores[f"{what}_psnr"] / 10.0)


class Ladder:
    """All that the rungs are made from.

    Args:
        run: a fit.
        report: told what is done.

    Raises:
        InputError: the run has no radiance field or known materials, the scene has smooth surfaces, or true maps or
            photographs are missing.
    """

    def __init__(self, run: LoadedRun, report: Callable[[str], None]) -> None:
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
        source = PhotosInMemory(photographs, scene.train[0].camera.width)
        self.training = TrainingRun.of_scene(scene, source, run.settings)
        device, cameras = world.geometry.vertices.device, [view.camera for view in scene.train]
        primary = PrimaryHits(world, cameras, self.positions, run.settings.seed, device)
        self.left_out = self.training.views.emitter_mask.clone()
        views, pixels = self.left_out.shape
        missed = primary.prim.view(views, pixels, self.positions) < 0
        self.left_out |= missed.any(-1)
        self.photographs: FloatArray = source.photographs.numpy()
        report("cells of what the training views see")
        low, size = self._region(primary)
        points = [encode(self._points(primary, view, slice(None)), low, size) for view in range(views)]
        self.kept: IntArray = np.flatnonzero((~self.left_out).view(-1).cpu().numpy())
        codes = np.concatenate(points).reshape(-1, self.positions)[self.kept]
        self.cells = SurfaceCells.of(low, size, np.unique(codes), len(self.kept))
        # Footprints among the finest cells; each position's cell weighs the same.
        column = self.cells.find(codes.reshape(-1)) - sum(self.cells.counts[:-1])
        start = np.arange(len(codes) + 1, dtype=np.int64) * self.positions
        weight = np.full(len(column), 1.0 / self.positions, np.float32)
        self.footprint = csr_array((weight, column, start), shape=(len(codes), self.cells.counts[-1]))
        self.prior, self.spread = self._prior(primary)
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

    def _points(self, primary: PrimaryHits, view: int, chosen: slice) -> SurfaceInteraction:
        """Surface points of a view at some of the kept positions of every pixel."""
        hits = primary.hits.view(len(self.run.scene.train), primary.pixels, self.positions, 3)
        here = hits[view, :, chosen].reshape(-1, 3)
        bary = here[:, 1:].contiguous().view(torch.float32)
        prim, valid = here[:, 0].long(), here[:, 0] >= 0
        origin = primary.origin[view].expand(len(here), 3)
        si = primary.world.geometry.interact_at(prim, bary[:, 0], bary[:, 1], origin, valid)
        return replace(si, wo=torch.nn.functional.normalize(origin - si.p, dim=-1))

    def _prior(self, primary: PrimaryHits) -> tuple[Prior, FloatArray]:
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
        column = self.footprint.indices.reshape(-1, self.positions)[:, self._pair].reshape(-1)
        shape = len(column), self.footprint.shape[1]
        one = csr_array((np.ones(len(column), np.float32), column, np.arange(len(column) + 1)), shape=shape)
        return Prior.of(self.cells, one, both[self.kept].reshape(-1, 4)), spread

    def regions(self) -> dict[str, list[BoolArray]]:
        """Pixels that are scored apart."""
        if ROUGHNESS not in self.run.scene.parameters:
            return {}
        model = SceneModel(self.run.world, self.truth, self.run.radiance)
        return {"lit_glossy": lit_glossy(self.held_out, self.run.settings.method, model)}

    # ---- the rungs

    def climb(self, spp: int) -> list[Rung]:
        """Measure every rung.

        Args:
            spp: samples a pixel behind what photographs tell.
        """
        self.report("which pixels are lit and glossy")
        regions = self.regions()

        def scores(materials: Materials) -> dict[str, float]:
            return score(self.held_out, self.held_out.predict(materials), None, regions)

        def of_cells(details: FloatArray) -> dict[str, float]:
            return scores(CellMaterials(self.cells, details, self.prior.mean))

        ours = scores(self.run.materials)
        self.report("resolution")
        seen = self.maps.reshape(-1, 4)[self.kept]
        sampling = self.spread * np.float32(1.0 / self.positions + 1.0 / TRUTH_SPP)  # of counted positions
        sampling += np.float32(1e-7) * np.eye(4, dtype=np.float32)
        direct = self._recovery(Response.direct(len(seen)), np.sqrt(np.einsum("ncc->nc", sampling)))
        resolution = of_cells(direct(direct.less_mean(seen)))
        self.report(f"what photographs tell, {spp} samples a pixel")
        noise = of_cells(self._photographed(seen, sampling, spp))
        return [
            Rung("resolution", "pixels of the photographs", resolution),
            Rung("noise", "noise of the photographs, and what no highlight tells: the bound", noise),
            Rung("ours", "the fields, their light, noise of the samples, time and everything else", ours),
        ]

    def _recovery(self, response: Response, sigma: FloatArray) -> Recovery:
        return Recovery(self.cells, self.prior, self.footprint, response, sigma)

    def _photographed(self, seen: FloatArray, sampling: FloatArray, spp: int) -> FloatArray:
        """The best linear estimate from photographs with simulated noise in known light."""
        views, width = len(self.left_out), self.run.scene.train[0].camera.width
        estimator, primary = self.run.assembly.estimator, self.training.views.primary
        found = predict(estimator, self.truth, primary, self.left_out, spp, SEED, width)
        response = Response.of(*(x.reshape(-1, 3)[self.kept] for x in (found.by_albedo, found.by_roughness)))
        jacobian = response.jacobian  # [kept, 3, 4]
        positions: FloatArray = (jacobian @ sampling @ jacobian.transpose(0, 2, 1)).astype(np.float32)  # [kept, 3, 3]
        drawn, covariance = self._noise(found, positions, (views, -1, width, 3))
        # Sums of the channels whose noise is independent and of variance 1.
        channels = np.linalg.inv(np.linalg.cholesky((covariance + positions).astype(np.float64))).astype(np.float32)
        recovery = self._recovery(response.mixed(channels), np.ones((len(seen), 3), np.float32))
        return recovery(recovery.less_mean(seen) + np.einsum("ncd,nd->nc", channels, drawn))

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


def training_truth(run: LoadedRun) -> tuple[FloatArray, torch.Tensor]:
    """True materials of all training pixels [views, pixels, 4], and the photographs [views, pixels, 3].

    Raises:
        InputError: a view lacks one, has a mask or another size than the first.
    """
    scene, world = run.scene, run.world
    sizes = {(view.camera.width, view.camera.height) for view in scene.train}
    if len(sizes) > 1 or any(view.mask is not None for view in scene.train):
        raise InputError(f"scene {scene.name}: this takes training photographs of one size and without masks")
    reader = HeldOut(replace(scene, test=scene.train), world.geometry, world.tracer, 1)
    check_truth(reader, "training")
    maps, photographs = [], []
    for index in range(len(scene.train)):
        found = reader.truth(index)
        albedo = found["albedo_true"]
        roughness = found.get("roughness_true", np.ones_like(albedo[..., :1]))
        maps.append(np.concatenate((albedo, roughness), -1).reshape(-1, 4))
        photographs.append(torch.from_numpy(found["photograph"]).reshape(-1, 3))
    return np.stack(maps), torch.stack(photographs)


def check_truth(reader: HeldOut, kind: str) -> None:
    """Check that every view of a ``kind`` has what is compared with.

    Raises:
        InputError: one has not.
    """
    if not reader.views:
        raise InputError(f"the scene has no {kind} views to compare with")
    names = {"photograph": "photograph", "albedo_true": "true albedo"}
    names |= {"roughness_true": "true roughness"} if ROUGHNESS in reader.scene.parameters else {}
    for index, view in enumerate(reader.views):
        for name, words in names.items():
            if name not in reader.truth(index):
                raise InputError(f"{kind} view {view.name}: it has no {words}, which is compared with here")
