"""One pass of path replay backpropagation over rays of all views mixed, with leave-one-out residuals."""

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch

from benchmarks.loaded import to_mitsuba
from benchmarks.peer.texture import make_shading, make_texture
from benchmarks.peer.voxels import SurfaceVoxels
from neurad.core.camera import Cameras
from neurad.core.lens import Lens
from neurad.core.patch_sampler import PatchSampler
from neurad.core.records import FloatArray, IntArray
from neurad.core.rng import mix
from neurad.losses.relative import relative_weight
from neurad.scene.description import Scene


@dataclass(frozen=True)
class Gradient:
    """The result of one step."""

    values: FloatArray
    """Derivative of the loss by the voxel values [n, 4]; 0 where it was not finite."""
    not_finite: int
    """Entries that were not finite."""
    loss: float
    """Unbiased estimate of the loss."""


class Replay:
    """Mitsuba's own ``prb`` on rays that are ours: ``sample`` in primal, then in backward mode.

    The two passes of ``prb`` are those of one estimate (the second replays the first); a second rendering for an
    unbiased gradient is not needed, since every pixel has ``samples`` independent ones and each is compared with the
    mean of the others.

    Args:
        mi: the module ``mitsuba``.
        scene: geometry, lights and cameras; its materials, all but the delta ones, are replaced by the voxels.
        voxels: where albedo and roughness are.
        photographs: of the training views [views, h * w, 3].
        max_depth: of ``prb``; -1 for no limit.
        rr_depth: depth from which roulette may end a path.
        hide_emitters: camera rays that miss see black (photographs with alpha).
        epsilon: floor of the relative loss in units of the mean squared radiance of the photographs.
        seed: of pixels and paths.
    """

    def __init__(
        self,
        mi: Any,
        scene: Scene,
        voxels: SurfaceVoxels,
        photographs: FloatArray,
        max_depth: int,
        rr_depth: int,
        hide_emitters: bool = False,
        epsilon: float = 0.01,
        seed: int = 0,
    ) -> None:
        import drjit

        self.mi, self.dr = mi, cast(Any, drjit)
        self.texture = make_texture(mi, voxels)
        integrator = {"type": "prb", "max_depth": max_depth, "rr_depth": rr_depth, "hide_emitters": hide_emitters}
        shading = make_shading(mi, self.texture, scene.features.is_diffuse)
        camera = scene.train[0].camera  # of one size with all others; their rays are ours
        plain = replace(scene.train[0], camera=replace(camera, lens=Lens()))
        self.scene = to_mitsuba(scene, plain, camera.width, 1, integrator, shading)
        self.integrator = self.scene.integrator()
        self.sampler = mi.load_dict({"type": "independent"})
        self.photographs = photographs
        self.seed = seed
        self.random = np.random.default_rng(seed)
        self.iteration = 0
        self.cameras = Cameras.of([view.camera for view in scene.train], "cpu")
        self.patches = PatchSampler.build([(camera.width, camera.height)] * len(scene.train), 1, None, seed)
        self.lit = self._sees_no_emitter()
        square = (photographs**2).mean(-1)
        self.epsilon = epsilon * float(square[self.lit].mean() if self.lit.any() else square.mean())

    def rays(self, view: IntArray, pixel: IntArray) -> Any:
        """Mitsuba rays through a random position of every pixel, row-major [n], of the views [n]."""
        jitter = self.random.random((len(view), 2), dtype=np.float32)
        where = torch.from_numpy(view)
        corner = self.cameras.corner(where, torch.from_numpy(pixel))  # [n, 2]
        ours = self.cameras.rays(where, corner + torch.from_numpy(jitter))
        o, d = (np.ascontiguousarray(x.numpy().T) for x in (ours.o, ours.d))
        return self.mi.Ray3f(self.mi.Point3f(o), self.mi.Vector3f(d))

    def _sees_no_emitter(self) -> npt.NDArray[np.bool_]:
        """Pixels none of whose tested positions sees an emitter [views, pixels]: the others train nothing."""
        pixels = np.arange(self.photographs.shape[1])
        good = np.ones((len(self.cameras.origin), len(pixels)), bool)
        for view in range(len(good)):
            for _ in range(8):
                hit = self.scene.ray_intersect(self.rays(np.full_like(pixels, view), pixels))
                good[view] &= ~np.array(hit.is_valid() & (hit.shape.emitter() != None), dtype=bool)  # noqa: E711
        return good

    def step(self, values: FloatArray, pixels: int, samples: int) -> Gradient:
        """The gradient of the relative loss over ``pixels`` of all views, drawn as ``neurad fit`` draws them, by albedo
        and roughness at the vertices [n, 4], with at least 2 independent ``samples`` of each pixel.
        """
        dr, mi = self.dr, self.mi
        view, pixel = (x.numpy() for x in self.patches.draw(self.iteration * pixels, pixels))
        rays = self.rays(np.repeat(view, samples), np.repeat(pixel, samples))
        self.sampler.seed(mix(self.seed, self.iteration) & 0xFFFFFFFF, pixels * samples)
        self.iteration += 1
        self.texture.values = mi.Float(np.ascontiguousarray(values).ravel())
        with dr.suspend_grad():
            radiance, _, _, state = self.integrator.sample(
                dr.ADMode.Primal, self.scene, self.sampler.clone(), rays, None, None, mi.Bool(True)
            )
            dr.eval(radiance, state)
        adjoint, loss = self._adjoint(np.array(radiance).T.reshape(pixels, samples, 3), view, pixel)
        dr.enable_grad(self.texture.values)
        with dr.suspend_grad():
            weight = mi.Spectrum(np.ascontiguousarray(adjoint.reshape(-1, 3).T))
            self.integrator.sample(dr.ADMode.Backward, self.scene, self.sampler, rays, weight, state, mi.Bool(True))
            dr.eval()
        gradient = np.array(dr.grad(self.texture.values)).reshape(-1, 4)
        dr.disable_grad(self.texture.values)
        finite = np.isfinite(gradient)
        return Gradient(np.where(finite, gradient, 0.0), int(gradient.size - finite.sum()), loss)

    def _adjoint(self, radiance: FloatArray, view: IntArray, pixel: IntArray) -> tuple[FloatArray, float]:
        """Derivative of the loss by every sample [b, n, 3], its residual taken from the other samples of the pixel."""
        samples = radiance.shape[1]
        finite = np.asarray(np.isfinite(radiance)).all((1, 2))
        radiance = np.where(np.reshape(finite, (-1, 1, 1)), radiance, np.float32(0.0))
        target = self.photographs[view, pixel][:, None]
        others = (radiance.sum(1, keepdims=True) - radiance) / (samples - 1)
        normaliser = np.ascontiguousarray(np.broadcast_to(target, radiance.shape))
        weight = relative_weight(torch.from_numpy(normaliser), self.epsilon).numpy()
        counts = np.asarray(self.lit[view, pixel] & finite)
        weight = weight * counts[:, None, None]
        residual = weight * (others - target)
        loss = float((residual * (radiance - target)).mean())
        return (2.0 / radiance.size * residual).astype(np.float32), loss
