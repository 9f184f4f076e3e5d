"""Held-out views: their photographs, their true materials, and what materials show there.

Together with the data module's reader of training photographs this is the only place that opens images; ground truth is
opened nowhere else.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Self

import numpy as np
import torch
from torch import Tensor

from neurad.core.camera import camera_rays
from neurad.core.errors import InputError
from neurad.core.parameters import ALBEDO, METALLIC, ROUGHNESS, SurfaceParameter
from neurad.core.protocols import Materials, Tracer
from neurad.core.records import BoolArray, FloatArray, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.core.scene_records import View
from neurad.images.image_io import read_exr
from neurad.images.photographs import kept_pixels, read_view
from neurad.images.picture_notes import say_pictures
from neurad.integrators.film import pixel_positions, strided
from neurad.metrics.colour_lookup import MAX_VIEWS, ColourLookup
from neurad.metrics.seen import SeenBy
from neurad.runtime.numbers import PIXEL, UNIT, within
from neurad.runtime.progress import counted
from neurad.scene.description import Scene
from neurad.scene.exposure import scene_exposure
from neurad.scene.geometry import Geometry

CHUNK = 1 << 18
"""Sub-samples in flight: bounds the memory."""
CACHE_BYTES = 1 << 28
"""Primary hits are kept between evaluations up to this size, and traced again beyond it."""
_HIT_BYTES = 12
"""Bytes of a kept hit: triangle and barycentrics."""
SEED = 20230807

Maps = Mapping[str, FloatArray]


class HeldOut:
    """The held-out views of a scene.

    Args:
        scene: its ``scored`` views are scored, as a rule those held out; its ``train`` views decide which surfaces
            count as seen.
        geometry: the triangles, on the device where predictions are made.
        grid: every pixel is predicted at ``grid`` x ``grid`` stratified positions and box-filtered like the truth. Four
            positions are too few for patterns as fine as a pixel: they took 0.2 dB from the staircase's albedo and 1 dB
            from the built-in patterned kitchen's.
        stride: of rows and columns only every so many-th count; all arrays below have only these pixels.
    """

    def __init__(self, scene: Scene, geometry: Geometry, tracer: Tracer, grid: int = 4, stride: int = 1) -> None:
        self.scene = scene
        self.views: list[View] = scene.scored
        self.geometry = geometry
        self.tracer = tracer
        self.grid = grid
        self.stride = stride
        self.training = SeenBy.of(geometry, tracer, scene.train)
        self._room = CACHE_BYTES
        self._hits: dict[tuple[int, int], tuple[Tensor, Tensor, Tensor]] = {}
        self._counted: dict[int, BoolArray] = {}
        self._seen: dict[int, BoolArray] = {}
        self._shows: dict[int, BoolArray] = {}
        self._truth: dict[int, dict[str, FloatArray]] = {}
        self._emitted: dict[int, Tensor] = {}
        self._kept: dict[int, BoolArray] = {}
        self.respond: Callable[[Tensor], Tensor] | None = None
        """A response curve that was recovered, see :class:`neurad.fields.development.FittedDevelopment`."""

    def read(self) -> Self:
        """Read all files now, so that a bad one is found before training and not after it."""
        for index in counted(range(len(self.views)), "reading", len(self.views), "held-out views"):
            self.truth(index)
            self.kept(index)
        _ = self.lookup, self.exposure
        say_pictures()
        return self

    @cached_property
    def exposure(self) -> float:
        """What radiance is multiplied with before pictures are shown, or compared as they are shown."""
        return scene_exposure(self.scene)

    @cached_property
    def lookup(self) -> ColourLookup | None:
        """Roughness by colour in the true maps of some training views; None where there are none, or where held-out
        views have none to score.
        """
        both = {ALBEDO.name, ROUGHNESS.name}
        views = [view for view in self.scene.train if both <= view.maps.keys()]
        has_truth = any(both <= view.maps.keys() for view in self.views)
        if not (views and has_truth and ROUGHNESS in self.scene.parameters):
            return None
        chosen = replace(self.scene, test=views[:: -(-len(views) // MAX_VIEWS)])
        training = HeldOut(chosen, self.geometry, self.tracer, 1)  # a ray a pixel tells what is no emitter

        def pixels(index: int) -> tuple[FloatArray, FloatArray]:
            truth, counted = training.truth(index), training.counted(index)
            return truth["albedo_true"][counted], truth["roughness_true"][counted][:, 0]

        return ColourLookup.of(pixels(index) for index in range(len(chosen.test)))

    # --- sub-samples

    def sub_samples(self, index: int, few: bool = False) -> Iterator[tuple[slice, SurfaceInteraction]]:
        """First hits of view ``index``: slices of row-major pixels with their interactions [pixels * grid^2], pixel by
        pixel, or with fewer of them.

        Args:
            few: only four per pixel, one in each quarter (all of them for an odd ``grid``), for costly tests.
        """
        camera, device = self.views[index].camera, self.geometry.vertices.device
        per = self.grid * self.grid
        pixels = math.prod(self.size(index))
        step = max(1, CHUNK // per)
        for begin in range(0, pixels, step):
            part = slice(begin, min(begin + step, pixels))
            row_major = strided(camera.width, torch.arange(part.start, part.stop, device=device), self.stride)
            # One in each cell of a grid on every pixel; always the same
            positions = pixel_positions(camera.width, row_major, per, Stream(SEED, index, begin, device=device))
            rays = camera_rays(camera, positions.view(-1, 2))
            hits = self._hits.get((index, begin))
            if hits is None:
                hit = self.tracer.closest(rays)
                hits = hit.prim.int(), hit.u, hit.v
                if _HIT_BYTES * len(hit.prim) <= self._room:
                    self._room -= _HIT_BYTES * len(hit.prim)
                    self._hits[index, begin] = hits
            lanes = self._few(part, device) if few else slice(None)
            prim, u, v = (x[lanes] for x in hits)
            yield part, self.geometry.interact_at(prim.long(), u, v, -rays.d[lanes], prim >= 0)

    def _few(self, part: slice, device: torch.device) -> Tensor:
        """Lanes of a chunk that stand for the others: one in each quarter of a pixel, their mean in its middle."""
        pixels = torch.arange(part.stop - part.start, device=device)
        half, last = self.grid // 2, self.grid - 1
        corners = [(half - 1, 0), (last, half - 1), (0, half), (half, last)]
        cells = [y * self.grid + x for x, y in corners] if self.grid % 2 == 0 else range(self.grid**2)
        return (pixels[:, None] * self.grid**2 + torch.tensor(list(cells), device=device)).view(-1)

    @staticmethod
    def _pixels(part: slice, lanes: Tensor) -> Tensor:
        """Lanes of a chunk [pixels * positions, ...] as [pixels, positions, ...]."""
        return lanes.view(part.stop - part.start, -1, *lanes.shape[1:])

    # --- masks

    def counted(self, index: int) -> BoolArray:
        """Pixels [h, w] that count for albedo and roughness: no sub-sample sees an emitter, a smooth surface, of
        which nothing is recovered, or nothing, and :meth:`kept`.
        """
        if index not in self._counted:
            smooth = torch.tensor(
                [m.model.is_delta for m in self.scene.materials], device=self.geometry.material.device
            )
            known = (self.geometry.emission > 0).any(-1) | smooth[self.geometry.material]
            parts = []
            for part, si in self.sub_samples(index):
                good = si.valid & ~known[si.prim.clamp_min(0)]
                parts.append(self._pixels(part, good).all(-1))
            self._counted[index] = self._image(index, torch.cat(parts)) & self.kept(index)
        return self._counted[index]

    @torch.no_grad()
    def seen(self, index: int) -> BoolArray:
        """Pixels [h, w] whose every sub-sample, of a few, lies on a surface that some training view sees."""
        if index not in self._seen:
            chunks = self.sub_samples(index, few=True)
            parts = [self._pixels(part, self.training.any(si)).all(-1) for part, si in chunks]
            self._seen[index] = self._image(index, torch.cat(parts))
        return self._seen[index]

    def shows(self, index: int) -> BoolArray:
        """Pixels [h, w] of which some sub-sample sees a surface; the others show the environment, or black."""
        if index not in self._shows:
            parts = [self._pixels(part, si.valid).any(-1) for part, si in self.sub_samples(index)]
            self._shows[index] = self._image(index, torch.cat(parts))
        return self._shows[index]

    @torch.no_grad()
    def emitted(self, index: int, light: Callable[[SurfaceInteraction], Tensor], changes: bool = False) -> Tensor:
        """What the camera sees without any reflection [h, w, 3], the mean over all sub-samples.

        Args:
            light: gives it for their interactions.
            changes: ``light`` may be another the next time.
        """
        found = self._emitted.get(index)
        if found is None or changes:
            parts = [self._pixels(part, light(si)).mean(1) for part, si in self.sub_samples(index)]
            found = torch.cat(parts).view(*self.size(index), 3)
            if not changes:
                self._emitted[index] = found
        return found

    def kept(self, index: int) -> BoolArray:
        """Pixels [h, w] that count for anything: those that no mask leaves out, and that the photograph's file has."""
        if index not in self._kept:
            whole = kept_pixels(self.views[index])
            self._kept[index] = (
                np.ones(self.size(index), np.bool_)
                if whole is None
                else np.ascontiguousarray(whole[:: self.stride, :: self.stride])
            )
        return self._kept[index]

    def _image(self, index: int, pixels: Tensor) -> np.ndarray:
        """Row-major pixels [h * w, ...] as an array [h, w, ...]."""
        return pixels.view(*self.size(index), *pixels.shape[1:]).cpu().numpy()

    def size(self, index: int) -> tuple[int, int]:
        """Height and width in pixels of what counts of view ``index``."""
        camera = self.views[index].camera
        return -(-camera.height // self.stride), -(-camera.width // self.stride)

    # --- maps

    @property
    def _parameters(self) -> tuple[SurfaceParameter, ...]:
        """What its surfaces may have: those of a room without metal, too, if a fit finds some."""
        own = self.scene.parameters
        return own if METALLIC in own or ROUGHNESS not in own else (*own, METALLIC)

    @torch.no_grad()
    def predict(self, materials: Materials) -> list[dict[str, FloatArray]]:
        """Box-filtered surface parameters [h, w, channels] of every view, by name; 0 where nothing is hit."""
        maps = []
        for index in counted(range(len(self.views)), "evaluating", len(self.views), "materials"):
            parts: dict[str, list[Tensor]] = {}
            for part, si in self.sub_samples(index):
                valid = si.valid[:, None]
                values = materials(si).parameters
                for name in (parameter.name for parameter in self._parameters if parameter.name in values):
                    shown = torch.where(valid, values[name], 0.0)
                    parts.setdefault(name, []).append(self._pixels(part, shown).mean(1))
            maps.append({name: self._image(index, torch.cat(pixels)) for name, pixels in parts.items()})
        return maps

    def truth(self, index: int) -> dict[str, FloatArray]:
        """``photograph`` [h, w, 3], ``photograph_relit`` [h, w, 3] under another environment, and of every surface
        parameter that the scene has its true map, such as ``albedo_true`` [h, w, 3]: those that have a file.

        Raises:
            InputError: a file cannot be read, has another size than the camera or too few channels, or a surface
                parameter is outside of 0 to 1 where a pixel counts.
        """
        if index not in self._truth:
            view = self.views[index]
            files = {f"{p.name}_true": (view.maps.get(p.name), p.channels) for p in self._parameters}
            files["photograph_relit"] = (view.relight, 3)
            found = {
                name: _fitting(path, read_exr(path, raw=channels == 1), view, channels, self.stride)
                for name, (path, channels) in files.items()
                if path is not None
            }
            for name in (p.name for p in self._parameters if f"{p.name}_true" in found):
                where = f"{view.maps[name]}: the true {name} of surfaces"
                within(found[f"{name}_true"][self.counted(index)], where, 0.0, UNIT)
            if view.image is not None:
                found["photograph"] = _fitting(view.image, read_view(view), view, 3, self.stride)
            self._truth[index] = found
        return self._truth[index]


def _fitting(path: str, pixels: FloatArray, view: View, channels: int, stride: int) -> FloatArray:
    """The first ``channels`` channels of a picture that has to fit the view's camera; of a stride's square one."""
    expected = (view.camera.height, view.camera.width)
    if pixels.shape[:2] != expected:
        size, camera = (f"{shape[1]} x {shape[0]}" for shape in (pixels.shape, expected))
        raise InputError(f"{path}: it has {size} pixels, but its camera has {camera}")
    if pixels.shape[2] < channels:
        raise InputError(f"{path}: it has {pixels.shape[2]} channels where {channels} are needed")
    within(pixels, str(path), -PIXEL, PIXEL)
    return np.ascontiguousarray(pixels[::stride, ::stride, :channels])
