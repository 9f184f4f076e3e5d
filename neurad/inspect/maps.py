"""What each mode of the viewer shows along camera rays, and how that becomes a picture.

Photographs among it, laid onto the surfaces that they show, so that they can be looked at from anywhere.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from neurad.core.camera import project, to_camera
from neurad.core.frame import dot
from neurad.core.parameters import METALLIC, SurfaceParameter
from neurad.core.protocols import Integrator
from neurad.core.records import Bytes, FloatArray, Rays, SurfaceInteraction
from neurad.core.scene_records import Development, View
from neurad.images.photographs import read_photograph
from neurad.integrators.renderer import MaterialMap
from neurad.integrators.world import World
from neurad.metrics.seen import SeenBy
from neurad.pages.colours import BARS as BAR_COLOURS
from neurad.pages.colours import NUMBERS, encode, encode_parameter, false_colour, without_specks
from neurad.runs.load import LoadedRun
from neurad.scene.geometry import Geometry

RENDER, PHOTOGRAPH = "render", "photograph"
BARS = " error bars"
"""Ends the names of modes."""
HATCHED = (0.85, 0.1, 0.1)
"""Colour of the stripes over what no photograph shows."""
STRIPE, GAP = 2, 8
"""Pixels of a stripe, and from stripe to stripe."""
NEAREST = 12
"""Photographs that are looked at for one picture."""
MAX_PHOTOGRAPHS = 32
"""Photographs in memory."""
TOGETHER = (2, 8)
"""Lanes in a row of which one stands for those that lie on the same mesh."""
ALIKE = 0.98
"""Cosine between normals from which they count as one surface."""

OfLanes = Callable[[SurfaceInteraction], Tensor]
"""Values [n] of lanes, each of which has its own."""


@dataclass(frozen=True)
class Scale:
    """What the colours of a map mean."""

    title: str
    colours: Callable[[FloatArray], Bytes]
    """Colours [h, w, 3] of values [h, w, 1]."""
    high: float
    """Value at the bright end; the other end is 0."""


@dataclass(frozen=True)
class Mode:
    """A way to look at the room, other than lit."""

    says: str
    """What the picture is, in a sentence."""
    integrator: Integrator
    show: Callable[[FloatArray, float], Bytes]
    """The picture [h, w, 3] of values [h, w, c] and an exposure."""
    scale: Scale | None = None
    hatches: bool = True
    """Whether what no photograph shows can be hatched."""
    quick: Integrator | None = None
    """What takes the integrator's place while the camera moves."""


@lru_cache(MAX_PHOTOGRAPHS)
def _read(path: str, development: Development) -> Tensor:
    """The colours of a photograph [1, 3, h, w]."""
    colours = read_photograph(path, development)[..., :3]
    return torch.from_numpy(np.ascontiguousarray(colours)).permute(2, 0, 1)[None]


class PhotographMap:
    """What photographs show of the surfaces along camera rays.

    Every surface point gets the colour that it has in the photograph, among the :data:`NEAREST` to the camera, that
    shows it from the most similar direction. Highlights therefore stay where the photograph saw them.
    """

    def __init__(self, world: World, views: Sequence[View]) -> None:
        self.world = world
        self.views = [view for view in views if view.image is not None]
        self.seen = SeenBy.of(world.geometry, world.tracer, self.views)

    def __call__(self, rays: Rays, seed: int) -> Tensor:
        """Radiance, and 1 where a photograph shows the surface or there is none, else 0: [n, 4]; without noise."""
        return self._colours(rays, lambda si, choose: choose(si))

    def quick(self, rays: Rays, seed: int) -> Tensor:
        """The same while the camera moves: neighbours take their colours from one photograph."""
        return self._colours(rays, partial(by_neighbours, self.world.geometry))

    @torch.no_grad()
    def _colours(self, rays: Rays, at: Callable[[SurfaceInteraction, OfLanes], Tensor]) -> Tensor:
        si = self.world.intersect(rays)
        nearest = self._nearest(rays)
        chosen = at(si, lambda points: self._chosen(points, nearest)).cpu()
        p = si.p.cpu()
        out = torch.zeros(len(si), 4)
        out[:, 3] = ((chosen >= 0) | ~si.valid.cpu()).float()
        for index in nearest:
            camera, image = self.views[index].camera, self.views[index].image
            assert image is not None
            lanes = (chosen == index).nonzero().squeeze(-1)
            if len(lanes) == 0:
                continue
            xy = project(camera, to_camera(camera, p[lanes])).float()
            size = torch.tensor([camera.width, camera.height])
            photograph = _read(image, self.views[index].development)
            colours = grid_sample(
                photograph, (2 * xy / size - 1)[None, None], padding_mode="border", align_corners=False
            )
            out[lanes, :3] = colours[0, :, 0].T
        return out.to(si.p.device)

    def _chosen(self, si: SurfaceInteraction, nearest: Sequence[int]) -> Tensor:
        """The photograph, of some, that shows each lane of ``si`` from the most similar direction [n]; -1 for none."""
        best = torch.where(si.valid, -2.0, 2.0)
        found = torch.full((len(si),), -1, device=si.p.device)
        for index in nearest:
            eye = torch.as_tensor(self.views[index].camera.to_world, dtype=si.p.dtype, device=si.p.device)[:3, 3]
            likeness = dot(normalize(eye - si.p, dim=-1), si.wo)
            better = (likeness > best).nonzero().squeeze(-1)  # only there it matters whether something is in between
            lanes = better[self.seen.at(index, si.p[better])]
            best[lanes], found[lanes] = likeness[lanes], index
        return found

    def _nearest(self, rays: Rays) -> list[int]:
        """Indices of the photographs taken nearest to a camera and in the most similar direction."""
        eye, ahead = rays.o[0].cpu().numpy(), rays.d.mean(0).cpu().numpy()
        poses = np.stack([view.camera.to_world for view in self.views])
        away = np.linalg.norm(poses[:, :3, 3] - eye, axis=-1) / max(self.world.geometry.scale, 1e-30)
        turned = 1.0 + poses[:, :3, 2] @ (ahead / max(float(np.linalg.norm(ahead)), 1e-30))
        return [int(index) for index in np.argsort(away + turned, kind="stable")[:NEAREST]]


def by_neighbours(geometry: Geometry, si: SurfaceInteraction, values: OfLanes) -> Tensor:
    """``values`` of the lanes of ``si`` [n], asked for at few of them.

    Of :data:`TOGETHER` lanes in a row the first stands for those that hit the same mesh where it faces the same way.
    """
    lane = torch.arange(len(si), device=si.p.device)
    mesh = torch.where(si.valid, geometry.mesh_index[si.prim.clamp_min(0)], -1)
    stands = lane
    for together in TOGETHER:
        first = lane - lane % together
        alike = (mesh == mesh[first]) & (dot(si.n, si.n[first]) > ALIKE)
        stands = torch.where(alike, first, stands)
    own, place = torch.unique(stands, return_inverse=True)
    return values(si[own])[place]


@dataclass(frozen=True)
class BarMap:
    """Error bars of a recovered parameter at the first hit over those without photographs [n, 1]; 0 without a hit."""

    run: LoadedRun
    name: str

    @torch.no_grad()
    def __call__(self, rays: Rays, seed: int) -> Tensor:
        """Values along camera rays [n, c]; without noise."""
        si = self.run.world.intersect(rays)
        assert self.run.bars is not None
        share = self.run.bars.shares({self.name: self.run.map_std(self.name, si)})[self.name]
        return torch.from_numpy(share).to(si.p.device) * si.valid.unsqueeze(-1)


@dataclass(frozen=True)
class SeenMap:
    """By how many training views the first hit is seen; -1 where nothing is hit: [n, 1]."""

    world: World
    seen: SeenBy

    @torch.no_grad()
    def __call__(self, rays: Rays, seed: int) -> Tensor:
        """Counts along camera rays; without noise."""
        si = self.world.intersect(rays)
        return torch.where(si.valid, self.count(si), -1.0).unsqueeze(-1)

    @torch.no_grad()
    def quick(self, rays: Rays, seed: int) -> Tensor:
        """The same while the camera moves: neighbours have one count."""
        si = self.world.intersect(rays)
        return torch.where(si.valid, by_neighbours(self.world.geometry, si, self.count), -1.0).unsqueeze(-1)

    @torch.no_grad()
    def unseen(self, rays: Rays, seed: int) -> Tensor:
        """1 where the first hit is a surface that no training view sees, else 0: [n, 1]; without noise."""
        si = self.world.intersect(rays)
        return (si.valid & ~self.seen.any(si)).float().unsqueeze(-1)

    def count(self, si: SurfaceInteraction) -> Tensor:
        """Training views that see the lanes of ``si`` [n]."""
        count = torch.zeros(len(si), device=si.p.device)
        for index in range(len(self.seen.cameras)):
            count[self.seen.at(index, si.p)] += 1
        return count

    def views(self, si: SurfaceInteraction) -> list[int]:
        """Training views that see some lane of ``si``."""
        return [index for index in range(len(self.seen.cameras)) if len(self.seen.at(index, si.p))]


def hatch(picture: Bytes, marked: FloatArray) -> Bytes:
    """Stripes over the pixels where ``marked`` [h, w, 1] is above a half."""
    rows, columns = np.indices(picture.shape[:2])
    stripes = (np.mod(rows + columns, GAP) < STRIPE) & without_specks(marked[..., 0] > 0.5, GAP // 2)
    return np.where(stripes[..., None], np.round(np.array(HATCHED) * 255).astype(np.uint8), picture)


def counted(values: FloatArray, views: int) -> Bytes:
    """Counts of photographs as colours, dark to bright over a root, so that one and two differ; none is black."""
    share = np.sqrt(np.clip(values, 0, None) / max(views, 1))
    return np.where(values > 0, false_colour(share, 1.0, NUMBERS), np.uint8(0))


def legend(scale: Scale) -> Bytes:
    """The colours of a scale from 0 to its end, left to right [18, 320, 3]."""
    return scale.colours(np.tile(np.linspace(0.0, scale.high, 320, dtype=np.float32)[:, None], (18, 1, 1)))


def _map(parameter: SurfaceParameter, values: FloatArray, exposure: float) -> Bytes:
    """A map of a surface parameter; no light, so the exposure plays no part."""
    return encode_parameter(parameter, values)


def modes_of(run: LoadedRun, seen: SeenMap, photographs: PhotographMap) -> Mapping[str, Mode]:
    """The modes that a run has something for, by name, but for the lit one; error bars if its folder has them."""
    views = len(seen.seen.cameras)
    found = {}
    if photographs.views:
        found[PHOTOGRAPH] = Mode(
            "The photographs, laid onto the surfaces that they show; each point is taken from the one that saw it from "
            "the most similar direction.",
            photographs, lambda x, exposure: hatch(encode(x[..., :3] * exposure), 1.0 - x[..., 3:]), hatches=False,
            quick=photographs.quick,
        )  # fmt: skip
    for parameter in run.assembly.parameters:
        is_given = parameter is METALLIC and run.assembly.metalness is None
        found[parameter.name] = Mode(
            f"The {parameter.name} that the scene's files give." if is_given else f"The recovered {parameter.name}.",
            MaterialMap(run.world, run.materials, (parameter,)), partial(_map, parameter),
            None if parameter.ends is None else Scale(parameter.name, lambda x: false_colour(x, 1.0, NUMBERS), 1.0),
        )  # fmt: skip
    bars = Scale("error bar over that without photographs", lambda x: false_colour(x, 1.0, BAR_COLOURS), 1.0)
    known = "" if run.bars is None else run.bars.sentence
    for name in run.uncertain:
        found[name + BARS] = Mode(
            f"How sure the recovered {name} is: bright where next to nothing is known. {known}",
            BarMap(run, name), lambda x, _: false_colour(x, 1.0, BAR_COLOURS), bars,
        )  # fmt: skip
    if views:
        found["seen"] = Mode(
            "How many training photographs show each point; hatched where none does: what is there is a guess.",
            seen, lambda x, _: hatch(counted(x, views), (np.abs(x) < 0.5).astype(np.float32)),
            Scale("photographs", lambda x: counted(x, views), views), hatches=False, quick=seen.quick,
        )  # fmt: skip
    return found
