"""Which meshes shine, or patches of meshes, where nobody says so: those that photographs show brighter than a white
sheet in their place, if one radiance and what can be reflected besides explain every pixel of them.

What arrives is gathered from the photographs themselves: rays leave a surface by the cosine, and where they end the
photographs say what comes back (:class:`neurad.lamps.surfaces.PhotographedRadiance`). No material
enters. A white diffuse sheet would show the mean of it, so the photographed radiance over that mean is the albedo of a
surface that does not shine, and at most about 1.

The brightest thing that is photographed shines, since nothing reflects more than arrives. From then on its light is
that of an emitter: shadow rays find it however small it is, and the parts of it that no photograph shows shine as well.
What is brighter than all light so far explains is next, and so on, until nothing is.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor, nn

from neurad.assembly.build import build_world
from neurad.assembly.gains import shared_development
from neurad.bsdf.diffuse import Diffuse
from neurad.core.colour import luminance
from neurad.core.errors import InputError
from neurad.core.protocols import BSDF, Materials, PhotoSource
from neurad.core.records import Constant, EmitterSample, PixelBatch, SurfaceInteraction
from neurad.core.rng import Stream, mix
from neurad.emitters.area import AreaLights
from neurad.emitters.lights import AnyLights, make_lights
from neurad.integrators.emitter_pixels import POSITIONS
from neurad.integrators.method import SceneModel
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.stratified import stratified_samples
from neurad.integrators.world import World
from neurad.lamps.candidates import Candidate, candidate_of, evenly, one_radiance, over, reflectance
from neurad.lamps.clipped import MAX_CLIPPED, WHITE, Glaring, brightened, clipped_surfaces
from neurad.lamps.clipped import POINTS as BALANCE_POINTS
from neurad.lamps.patches import Patches
from neurad.lamps.surfaces import PhotographedRadiance, SurfacePixels, showing_one_side, surface_pixels
from neurad.runtime.progress import phase
from neurad.scene.description import Scene
from neurad.scene.hints import PlaceHint
from neurad.scene.shining import Shining, lamp_names, without_lamps

MARGIN = 1.3
"""How much brighter than a white sheet in its place a mesh has to be to be taken for a lamp."""
MIN_LAMP_PIXELS = 3
"""Pixels that have to show nothing but a lamp: fewer do not tell whether it is alike all over."""
UNEXPLAINED = 1.5
"""How much brighter than a white sheet a tenth of all surfaces may be before something is said."""
MIN_SURROUNDED = 0.5
"""Fraction of what arrives at a patch that photographs have to show, where there is light that they do not."""
_POINTS, _SPP = 48, 64  # of each side of a mesh: points, and directions at each
_OTHERS = 768  # points of all surfaces, to compare with
_VERIFIED = 512  # pixels of each candidate that are looked at closely
_ALIKE = 0.5  # of the brightest candidate's radiance: what is found together with it
_MEASURED = 4096  # pixels of a lamp that say what it reflects
_CHUNK = 1 << 17  # samples


@dataclass
class Found:
    """What was found."""

    lamps: list[Shining] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)
    """What there is to say."""


class NullEmitter(nn.Module):
    """An :class:`~neurad.core.protocols.Emitter` that sends nothing."""

    def sample(self, p: Tensor, u: Tensor) -> EmitterSample:
        """Any direction, with density 0."""
        wi = torch.zeros_like(p)
        wi[:, 2] = 1.0
        return EmitterSample(wi, torch.ones_like(p[:, 0]), torch.zeros_like(p), torch.zeros_like(p[:, 0]))

    def eval(self, si: SurfaceInteraction) -> Tensor:  # type: ignore[override]
        """Zeros [n, 3]."""
        return torch.zeros_like(si.p)

    def pdf(self, p: Tensor, si: SurfaceInteraction) -> Tensor:
        """Zeros [n]."""
        return torch.zeros_like(p[:, 0])


def find_lamps(
    scene: Scene,
    photographs: PhotoSource,
    tracer: str,
    unknown_sky: bool,
    seed: int,
    device: torch.device | str = "cpu",
    hints: Sequence[PlaceHint] = (),
    declared: bool = False,
) -> Found:
    """Find the meshes that shine. What the scene's file says of them is not looked at unless it is ``declared``.

    Args:
        scene: geometry, cameras, and the light of other kinds.
        photographs: of the training views.
        tracer: 'embree', 'open3d' or 'warp'.
        unknown_sky: the environment is not known either, so nothing is taken from it.
        seed: of all draws.
        device: where it is computed.
        hints: points on lamps and boxes around them that the user gives.
        declared: take what the scene's file says to shine for lamps, too, of whatever radiance.

    Raises:
        InputError: there are no photographs, nothing is where the user says, or no mesh shines and there is no other
            light.
    """
    shining = [i for i, mesh in enumerate(scene.meshes) if mesh.radiance is not None] if declared else []
    scene = without_lamps(scene)
    with phase("finding lamps"):
        world = build_world(scene, tracer, photographs.has_alpha, lights=NullEmitter()).to(device)
        develop = shared_development(scene, world, photographs, seed)
        return Search(scene, world, photographs, seed, unknown_sky, develop, hints, shining).run()


class Search:
    """One search for lamps.

    Args:
        scene: without lamps.
        world: of the scene, dark.
        photographs: of its training views.
        seed: of all draws.
        unknown_sky: the environment is not known either.
        develop: corrects the photographs where their exposures are not known: what shines has one radiance in all.
        hints: as of :func:`find_lamps`.
        declared: meshes that the scene's file says to shine.
    """

    def __init__(
        self,
        scene: Scene,
        world: World,
        photographs: PhotoSource,
        seed: int,
        unknown_sky: bool = False,
        develop: Callable[[PixelBatch], PixelBatch] | None = None,
        hints: Sequence[PlaceHint] = (),
        declared: Sequence[int] = (),
    ) -> None:
        self.hints, self.declared = hints, declared
        self.scene, self.seed, self.unknown_sky = scene, seed, unknown_sky
        self.known = replace(scene, environment=None) if unknown_sky else scene
        self.geometry, self.bsdf = world.geometry, world.bsdf
        self.world = world.reflecting_by(Diffuse())
        self.shown = surface_pixels(world, [view.camera for view in scene.train], photographs, seed, develop)
        """Pixels that show one mesh alone."""
        self.pixels = self.shown
        """Those of them that show one piece of surface alone."""
        self.photographed = PhotographedRadiance(self.geometry, self.pixels)
        self.mesh_of = list(range(len(scene.meshes)))
        """Mesh of each piece of surface that may shine: the meshes themselves, then patches of them."""
        self.doubt = torch.full_like(world.geometry.face_area, torch.inf)
        """Standard error of the logarithm of the radiance, by what they light, of triangles [f] that are brighter than
        clipped photographs show them; NaN for those that are not, infinite while that is not known."""
        self.needed = torch.zeros_like(world.geometry.emission)
        """Radiance of triangles [f, 3] that is known by what they light alone; 0 of others."""
        self.lamps: list[Candidate] = []
        self._relight()

    def run(self) -> Found:
        """Find the meshes that shine, then the patches of the others that do."""
        patches = Patches(self.geometry, self.pixels)
        if (bool(self.shown.clipped.any()) or self.hints or self.declared) and not self.unknown_sky:
            self._brighten(patches)
            patches = Patches(self.geometry, self.pixels)
        self._take(self._candidates(patches))
        if self._part(patches) or self.hints or self.declared:
            self._tell(patches)
            self._refine(patches, self._candidates(patches))
            self._take(self._candidates(patches))
            self._refine(patches, self.lamps)
            self._measure()
        return self._found(self._level([]))

    def _brighten(self, patches: Patches) -> None:
        """Let surfaces that all views clip, and lamps that somebody tells of, be as bright as what they light says."""
        of, count = self.geometry.mesh_index, len(self.mesh_of)
        smooth = np.isin(of.cpu().numpy(), sorted(self.scene.smooth_meshes))
        number, backs = clipped_surfaces(patches, self.shown, smooth)
        surface, named = torch.from_numpy(number).to(of.device), set[int]()
        for inside, turned in self._dim(surface):
            surface = torch.where(inside, len(backs), surface)
            named.add(2 * (count + len(backs)) + turned)
            backs.append(int(turned))
        sides = [2 * (count + k) + back for k, back in enumerate(backs)]
        self.geometry.mesh_index = torch.where(surface >= 0, count + surface, of)
        self.mesh_of += [0] * len(sides)
        self._relabel()
        pixels = torch.bincount(self.pixels.side, minlength=max(sides, default=0) + 1)
        area = torch.bincount(self.geometry.mesh_index, self.geometry.face_area, count + len(sides))
        self.doubt = torch.full_like(self.doubt, torch.nan)
        taken = [side for side in sides if int(pixels[side]) >= MIN_LAMP_PIXELS or side in named]
        taken = [side for side in taken if float(area[side // 2]) > 0.0]
        taken = sorted(taken, key=lambda side: (side not in named, -float(area[side // 2])))[: len(named) + MAX_CLIPPED]
        own = torch.tensor(taken, dtype=torch.int64, device=of.device)
        open_ = self.pixels[(~self.pixels.clipped & ~torch.isin(self.pixels.side, own)).nonzero().squeeze(-1)]
        if taken and len(open_):
            self.photographed.left_out[own] = True
            points = evenly(open_, BALANCE_POINTS)
            surfaces = []
            for side in taken:
                shown = self.pixels[(self.pixels.side == side).nonzero().squeeze(-1)]
                color = (shown if len(shown) else points).color.mean(0)
                full = torch.ones_like(color, dtype=torch.bool) if side in named else shown.full.float().mean(0) >= 0.5
                inside = self.geometry.mesh_index == side // 2
                surfaces.append(Glaring(inside, bool(side % 2), color, full, side in named))
            color = self.shown.color.clone()

            def others(bsdf: BSDF, materials: Materials) -> Tensor:
                return self._reflected(points, SceneModel(self.world.reflecting_by(bsdf), materials, self.photographed))

            found = brightened(self.world, self.bsdf, surfaces, points, others, MARGIN, self.seed)
            for row, (factor, errors) in found.items():
                one, times = surfaces[row], torch.from_numpy(factor).to(color)
                mine = one.inside[self.shown.prim] & (self.shown.side % 2 == one.back)
                color[mine] *= times
                color[mine & self.shown.clipped] = one.shown * times  # ceilings of photographs differ
                self.doubt[one.inside], self.needed[one.inside] = float(errors.max()), one.shown * times
            self.shown = replace(self.shown, color=color)
        self.geometry.mesh_index = of
        del self.mesh_of[count:]
        self._relabel()

    def _dim(self, clipped: Tensor) -> list[tuple[Tensor, bool]]:
        """Triangles [f], bool, of each lamp that somebody tells of and that no photograph shows as bright as it is, and
        whether their backs shine.

        Args:
            clipped: surface of each triangle that all views clip [f], -1 for none.
        """
        found = []
        for _, inside, point, _ in self._named:
            if point:
                inside = (clipped >= 0) & (clipped == clipped[inside])
            turned, shown, _ = self._shining_side(inside)
            if bool(inside.any()) and (len(shown) == 0 or candidate_of(0, shown).clipped):
                found.append((inside, turned))
        return found

    def _shining_side(self, inside: Tensor) -> tuple[bool, SurfacePixels, float]:
        """The side from which triangles [f], bool, are brighter: whether it is their backs, its pixels and their mean
        luminance, 0 where there are none.
        """
        pixels = self.shown[inside[self.shown.prims].all(-1)]
        sides = [pixels[pixels.side % 2 == back] for back in (0, 1)]
        light = [float(luminance(group.color).mean()) if len(group) else 0.0 for group in sides]
        turned = light[1] > light[0]
        return turned, sides[turned], light[turned]

    def _take(self, candidates: list[Candidate]) -> None:
        """Take lamp after lamp, the brightest first, until nothing is brighter than it could be otherwise."""
        while True:
            for candidate, (shown, sheet) in zip(candidates, self._sheets([c.pixels for c in candidates]), strict=True):
                candidate.ratio = over(shown, sheet)
                candidate.even = one_radiance(luminance(shown), luminance(sheet), candidate.ratio)
            even = [c for c in candidates if c.even and (not c.clipped or not math.isnan(self._doubt(c)))]
            level = max(self._level(even), 1.0)
            # patches are many: where a tenth of surfaces exceed the level, one in 200 exceeds its square (lognormal)
            least = [MARGIN * level ** (1 if c.piece < len(self.scene.meshes) else 2) for c in even]
            shining = [c for c, r in zip(even, least, strict=True) if c.ratio > r and not self._is_part(c, even)]
            if level > UNEXPLAINED:
                shining = [c for c in shining if self._is_surrounded(c)]
            if not shining:
                return
            bright = _ALIKE * max(c.brightness for c in shining)
            self.lamps += [c for c in shining if c.brightness >= bright]
            candidates = [c for c in candidates if c not in self.lamps]
            self._relight()

    def _doubt(self, candidate: Candidate) -> float:
        """Standard error of the logarithm of a clipped surface's radiance, as of :attr:`doubt`; NaN where what it
        lights does not show that it shines: what only reflects is clipped as well.
        """
        known = self.doubt[self.geometry.mesh_index == candidate.piece]
        return float(known[~known.isnan()].max()) if not bool(known.isnan().all()) else math.nan

    def _is_measured(self, lamp: Candidate) -> bool:
        """Whether it is known how bright a lamp is: not of those that may be brighter than they are taken for."""
        return math.isfinite(self._doubt(lamp)) if lamp.clipped else len(lamp.pixels) > 0

    def _is_part(self, candidate: Candidate, even: Sequence[Candidate]) -> bool:
        """Whether most of what photographs show of a mesh is its other side, which does not shine: it is no lamp then,
        but may have one within.
        """
        other = candidate.side ^ 1
        counts = [int((self.pixels.side == side).sum()) for side in (candidate.side, other)]
        is_mesh = candidate.piece < len(self.scene.meshes)
        return is_mesh and counts[1] > counts[0] and all(c.side != other for c in even)

    def _is_surrounded(self, candidate: Candidate) -> bool:
        """Whether photographs show most of what arrives at a patch. Where they do not, and there is light from nowhere,
        a patch that is brighter than what they show may just be lit by the rest.
        """
        if candidate.piece < len(self.scene.meshes):
            return True
        dark = self.world.under(NullEmitter().to(self.geometry.vertices.device))
        points = evenly(candidate.pixels, _POINTS)
        covered = self._reflected(points, SceneModel(dark, WHITE, self.photographed.covered))
        return float(covered.mean()) > MIN_SURROUNDED

    def _part(self, patches: Patches) -> bool:
        """Let each patch of a mesh that is no lamp be a piece of surface by itself; False where there is none."""
        taken = torch.tensor([lamp.piece for lamp in self.lamps] + sorted(self.scene.smooth_meshes))
        of = self.geometry.mesh_index
        patch = patches.find(~torch.isin(of, taken.to(of)), MIN_LAMP_PIXELS)
        count = int(patch.max()) + 1
        first = torch.zeros(count, dtype=torch.int64, device=of.device)
        first[patch[patch >= 0]] = of[patch >= 0]
        self.geometry.mesh_index = torch.where(patch >= 0, len(self.mesh_of) + patch, of)
        self.mesh_of += first.tolist()
        self._relabel()
        return count > 0

    def _relabel(self) -> None:
        """Let pixels show the pieces of surface that there are by now."""
        piece = self.geometry.mesh_index[self.shown.prims]
        alone = (piece == piece[:, :1]).all(-1)
        self.pixels = replace(self.shown, side=2 * piece[:, 0] + self.shown.side % 2)[alone]
        self.photographed = PhotographedRadiance(self.geometry, self.pixels)
        self._relight()

    def _candidates(self, patches: Patches) -> list[Candidate]:
        """Sides of meshes and patches that are brighter than what arrives there explains by the lamps so far. Smooth
        surfaces are none: they show other things. A patch that ends where photographs say, and not where the surface
        does, has to be shown by two views: one alone may show a highlight.
        """
        taken = self.scene.smooth_meshes | {lamp.piece for lamp in self.lamps}
        sides = [side for side in torch.unique(self.pixels.side).tolist() if side // 2 not in taken]
        groups = [self.pixels[(self.pixels.side == side).nonzero().squeeze(-1)] for side in sides]
        pairs = zip(sides, groups, self._sheets(groups), strict=True)
        # without shadow rays to lamps it is noisier
        bright = [(side, group) for side, group, pair in pairs if over(*pair) > MARGIN / 1.5]
        found = []
        for (side, _), pixels in zip(bright, self._verified([group for _, group in bright]), strict=True):
            is_whole = side // 2 < len(self.scene.meshes) or patches.is_whole(self.geometry.mesh_index == side // 2)
            if len(pixels) >= MIN_LAMP_PIXELS and (is_whole or len(torch.unique(pixels.view)) > 1):
                found.append(candidate_of(side, pixels))
        return found

    @cached_property
    def _named(self) -> list[tuple[int, Tensor, tuple[float, ...], str]]:
        """What the scene's file and the user say shines: meshes, triangles of them [f], bool, the point where it is all
        that is said, and who says it.
        """
        vertices, faces = (x.cpu().numpy() for x in (self.geometry.vertices, self.geometry.faces))
        mesh = torch.tensor(self.mesh_of).to(self.geometry.mesh_index)[self.geometry.mesh_index]
        named: list[tuple[int, Tensor, tuple[float, ...], str]]
        named = [(index, mesh == index, (), "the scene's file") for index in self.declared]
        for hint in self.hints:
            inside = torch.from_numpy(hint.triangles(vertices, faces, self.scene.origin)).to(mesh.device)
            point, meshes = () if hint.is_box else hint.place, torch.unique(mesh[inside]).tolist()
            named += [(index, inside & (mesh == index), point, hint.source) for index in meshes]
        return named

    def _tell(self, patches: Patches) -> None:
        """Take what the scene's file and the user say."""
        for mesh, inside, point, source in self._named:
            if point:
                piece = int(self.geometry.mesh_index[inside])
                inside = self.geometry.mesh_index == piece
                if piece < len(self.scene.meshes) and all(lamp.piece != piece for lamp in self.lamps):
                    raise InputError(
                        f"{source}: {', '.join(f'{x:g}' for x in point)}: photographs show no patch of like brightness "
                        "there; give a box around it"
                    )
            self._add(patches, inside, mesh, bool(point), source)

    def _add(self, patches: Patches, inside: Tensor, mesh: int, refine: bool, source: str) -> None:
        """Take triangles [f], bool, of a mesh for a lamp, to the side from which they are brighter."""
        of = self.geometry.mesh_index
        taken = torch.tensor([lamp.piece for lamp in self.lamps]).to(of)
        free = (torch.tensor(self.mesh_of).to(of)[of] == mesh) & ~torch.isin(of, taken)
        inside = inside & free
        if not bool(inside.any()):  # found already
            return
        turned, shown, light = self._shining_side(inside)
        if refine:
            inside = patches.refined(inside, free, turned, light)
        radiance = self.needed[inside].amax(0)
        side = 2 * len(self.mesh_of) + turned
        self.mesh_of.append(mesh)
        self.geometry.mesh_index = torch.where(inside, side // 2, of)
        hidden = Candidate(side, shown, radiance, bool(radiance.any()))
        self.lamps.append(replace(candidate_of(side, shown) if len(shown) else hidden, named_by=source))
        self._relabel()

    def _refine(self, patches: Patches, lamps: Sequence[Candidate]) -> None:
        """Let patches end halfway between their radiance and that of what is around them. Those that touch and are
        alike become one.
        """
        of, mesh_of = self.geometry.mesh_index, torch.tensor(self.mesh_of, device=self.geometry.mesh_index.device)
        for lamp in lamps:
            mesh = self.mesh_of[lamp.piece]
            if lamp.piece != mesh and not lamp.named_by and (of == lamp.piece).any():
                unlike = torch.tensor([other.piece for other in (*lamps, *self.lamps) if not other.is_like(lamp)])
                free = (mesh_of[of] == mesh) & ~torch.isin(of, unlike.to(of))
                inside = patches.refined(of == lamp.piece, free, lamp.turned, lamp.brightness)
                of = torch.where(of == lamp.piece, mesh, of)
                of[inside] = lamp.piece
        self.geometry.mesh_index = of
        self.lamps = [lamp for lamp in self.lamps if (of == lamp.piece).any()]
        self._relabel()

    def _measure(self) -> None:
        """Find what lamps that are patches reflect: the material of their mesh is that of other things, too."""
        for lamp in self.lamps:
            mesh = self.mesh_of[lamp.piece]
            if lamp.piece == mesh or lamp.clipped or len(lamp.pixels) == 0:
                continue
            pixels = self._verified([self.pixels[self.pixels.side == lamp.side]], _MEASURED)[0]
            pixels = pixels[~pixels.clipped]
            sheets = luminance(self._white(pixels.repeat(2)).double()).view(-1, 2).T
            paint = self.scene.materials[self.scene.meshes[mesh].material].albedo
            thought = float(paint.value.mean()) if isinstance(paint, Constant) else 0.5
            lamp.albedo = reflectance(luminance(pixels.color.double()), sheets, thought)

    def _verified(self, groups: Sequence[SurfacePixels], most: int = _VERIFIED) -> list[SurfacePixels]:
        """Those of some of the pixels of each side that show nothing else at more positions, too."""
        if not groups:
            return []
        some = [evenly(group, most) for group in groups]
        pixels = SurfacePixels.cat(*some)
        whole = torch.zeros_like(pixels.clipped)
        for view in torch.unique(pixels.view).tolist():
            mine = (pixels.view == view).nonzero().squeeze(-1)
            stream = Stream(self.seed, len(self.lamps), view, 42, device=mine.device)
            camera = self.scene.train[view].camera
            good, seen, _, _ = showing_one_side(self.world, camera, pixels.pixel[mine], POSITIONS, stream)
            whole[mine[good]] = seen == pixels.side[mine[good]]
        kept = torch.split(whole, [len(group) for group in some])
        return [group[alone] for group, alone in zip(some, kept, strict=True)]

    def _sheets(self, groups: Sequence[SurfacePixels]) -> list[tuple[Tensor, Tensor]]:
        """Photographed radiance at some pixels of each group [k, 3], and that of white sheets in their place [k, 3]."""
        if not groups:
            return []
        some = [evenly(group, _POINTS) for group in groups]
        sheets = torch.split(self._white(SurfacePixels.cat(*some)), [len(group) for group in some])
        return [(group.color.double(), sheet.double()) for group, sheet in zip(some, sheets, strict=True)]

    def _level(self, candidates: Sequence[Candidate]) -> float:
        """How bright a tenth of all surfaces are at least, lamps and those that look like some left out, over white
        sheets in their place: above 1 where light arrives that no photograph shows to come from anywhere. All surfaces
        are too bright then, so a lamp has to stand out among them.
        """
        known = torch.zeros_like(self.photographed.left_out)
        known[[c.side for c in (*candidates, *self.lamps)]] = True
        others = self.pixels[(~known[self.pixels.side] & ~self.pixels.clipped).nonzero().squeeze(-1)]
        if len(others) == 0:
            return 1.0
        others = evenly(others, _OTHERS)
        ratio = luminance(others.color) / luminance(self._white(others)).clamp_min(1e-30)
        return float(ratio.double().quantile(0.9))

    def _white(self, pixels: SurfacePixels) -> Tensor:
        """Radiance [n, 3] of a white diffuse sheet in the place of each pixel's point, in the light of the scene."""
        return self._reflected(pixels, SceneModel(self.world, WHITE, self.photographed))

    @torch.no_grad()
    def _reflected(self, pixels: SurfacePixels, model: SceneModel) -> Tensor:
        """Radiance [n, 3] of surfaces of a model's materials in the place of each pixel's point."""
        parts = []
        for begin in range(0, len(pixels), max(1, _CHUNK // _SPP)):
            si = pixels[begin : begin + _CHUNK // _SPP].points(self.geometry)
            stream = Stream(mix(self.seed, len(self.lamps)), begin, 43, device=si.p.device)
            u = stratified_samples(len(si), _SPP, stream)
            lanes = si.repeat(_SPP)
            surface = model.materials(lanes)
            value = Radiometric(control_variate=False).reflected(model, lanes, surface, u, stream).value
            parts.append(value.view(len(si), _SPP, 3).mean(1))
        return torch.cat(parts) if parts else pixels.color

    def _relight(self) -> None:
        """Let the lamps so far be emitters, and all else that shines in the photographs be what comes back from it."""
        emission, turned = torch.zeros_like(self.geometry.emission), torch.zeros_like(self.doubt, dtype=torch.bool)
        for piece, lamp in self._by_piece().items():
            inside = self.geometry.mesh_index == piece
            emission[inside], turned[inside] = lamp.radiance, lamp.turned
            self.photographed.left_out[lamp.side] = True
        area = AreaLights(self.geometry, emission, turned) if bool(emission.any()) else None
        lights: AnyLights | NullEmitter = NullEmitter()
        if area is not None or self.known.features.has_light:
            lights = make_lights(self.known, self.geometry, lamps=area)
        self.world = self.world.under(lights.to(emission.device))

    def _by_piece(self) -> dict[int, Candidate]:
        """The lamp that each piece is: of one that shines to both sides the brighter."""
        return {lamp.piece: lamp for lamp in sorted(self.lamps, key=lambda lamp: lamp.brightness)}

    def _found(self, level: float) -> Found:
        """The result, and what there is to say of it."""
        by_piece = self._by_piece()
        lamps = [self._shining(by_piece[piece]) for piece in sorted(by_piece)]
        names = lamp_names(self.scene, lamps)
        lines = []
        for name, (piece, lamp) in zip(names, sorted(by_piece.items()), strict=True):
            times = f"{lamp.ratio:.3g} times as bright as a white sheet in its place"
            doubt = self._doubt(lamp) if lamp.clipped else 0.0
            least = "" if math.isfinite(doubt) else "at least "
            said = f"as {lamp.named_by} says" if lamp.named_by else f"it is {least}{times}"
            lines.append(f"{name} shines: {said}")
            if lamp.clipped and math.isfinite(doubt):
                shown = ", ".join(f"{x:.3g}" for x in lamp.radiance.tolist())
                why = "is clipped in every photograph" if len(lamp.pixels) else "fills no pixel of a photograph"
                lines.append(
                    f"{name} {why}: its radiance {shown} is by what it lights; surfaces differ on it, so its standard "
                    f"error is {doubt:.0%} at least"
                )
            if sum(other.piece == piece for other in self.lamps) > 1:
                lines.append(
                    f"warning: {name} shines to both sides of its triangles; only the light of the brighter side is "
                    "taken, so give each side a mesh of its own"
                )
        if level > UNEXPLAINED and not self.unknown_sky and all(map(self._is_measured, self.lamps)):
            lines.append(
                f"warning: a tenth of the surfaces are more than {level:.2g} times as bright as all light that the "
                "photographs show can make them: some lamp is in no photograph, and its light will be missing; "
                "photograph it, or give it an emitter in the scene and take --model.lighting.emitters fit"
            )
        if not lamps and not self.scene.features.has_light:
            raise InputError(
                f"scene {self.scene.name}: model.lighting.emitters is find, but no mesh shines in the photographs: "
                "none, and no patch of one, is alike all over and brighter than what arrives there; say where lamps "
                "are that photographs show (model.lighting.lamps: points on them, or boxes around them), give lamps "
                "that none shows an area emitter in the scene, and take fit; light that comes in by windows needs a "
                "constant emitter in the scene, and model.lighting.environment fit"
            )
        return Found(lamps, lines or ["no mesh shines in the photographs"])

    def _shining(self, lamp: Candidate) -> Shining:
        """What shines, in the scene's terms."""
        mesh, of = self.mesh_of[lamp.piece], self.geometry.mesh_index
        found = lamp.radiance.tolist() if lamp.clipped and math.isfinite(self._doubt(lamp)) else None
        radiance = None if found is None else tuple(max(x, 1e-3 * max(found)) for x in found)
        if lamp.piece == mesh:
            return Shining(mesh, lamp.turned, radiance=radiance)
        first = sum(len(other.faces) for other in self.scene.meshes[:mesh])
        triangles = (of == lamp.piece).nonzero().squeeze(-1) - first
        whole = len(triangles) == len(self.scene.meshes[mesh].faces)
        return Shining(mesh, lamp.turned, None if whole else tuple(triangles.tolist()), lamp.albedo, radiance)
