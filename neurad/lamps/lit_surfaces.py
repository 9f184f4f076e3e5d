"""The surfaces of a scene as photographs show them, and in the light of the lamps that were found so far."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from neurad.bsdf.diffuse import Diffuse
from neurad.core.colour import luminance
from neurad.core.protocols import PhotoSource
from neurad.core.records import PixelBatch
from neurad.core.rng import Stream, mix
from neurad.emitters.area import AreaLights
from neurad.emitters.lights import NullEmitter, make_lights
from neurad.integrators.emitter_pixels import POSITIONS
from neurad.integrators.method import SceneModel
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.stratified import stratified_samples
from neurad.integrators.world import World
from neurad.lamps.candidates import Candidate
from neurad.lamps.surfaces import PhotographedRadiance, SurfacePixels, showing_one_side, surface_pixels
from neurad.scene.description import Scene
from neurad.scene.textures import ConstantMaterials

WHITE = ConstantMaterials(1.0)
"""A white sheet."""
UNEXPLAINED = 1.5
"""How much brighter than a white sheet a tenth of all surfaces may be before something is said."""
POINTS = 48
"""Of each side of a mesh, at which it is compared with a white sheet."""
_SPP = 64  # directions at each
_OTHERS = 768  # points of all surfaces, to compare with
_VERIFIED = 512  # pixels of each candidate that are looked at closely
_CHUNK = 1 << 17  # samples


class LitSurfaces:
    """The surfaces in pieces, any of which may shine: meshes, then patches of them.

    Args:
        scene: without lamps.
        world: of the scene, dark.
        unknown_sky: the environment is not known either.
        develop: corrects the photographs where their exposures are not known: what shines has one radiance in all.
    """

    def __init__(
        self,
        scene: Scene,
        world: World,
        photographs: PhotoSource,
        seed: int,
        unknown_sky: bool = False,
        develop: Callable[[PixelBatch], PixelBatch] | None = None,
    ) -> None:
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
        self.relight()

    def relabel(self) -> None:
        """Let pixels show the pieces of surface that there are by now."""
        piece = self.geometry.mesh_index[self.shown.prims]
        alone = (piece == piece[:, :1]).all(-1)
        self.pixels = replace(self.shown, side=2 * piece[:, 0] + self.shown.side % 2)[alone]
        self.photographed = PhotographedRadiance(self.geometry, self.pixels)
        self.relight()

    def relight(self) -> None:
        """Let the lamps so far be emitters, and all else that shines in the photographs be what comes back from it."""
        emission, turned = torch.zeros_like(self.geometry.emission), torch.zeros_like(self.doubt, dtype=torch.bool)
        for piece, lamp in self.by_piece().items():
            inside = self.geometry.mesh_index == piece
            emission[inside], turned[inside] = lamp.radiance, lamp.turned
            self.photographed.left_out[lamp.side] = True
        area = AreaLights(self.geometry, emission, turned) if bool(emission.any()) else None
        is_lit = area is not None or self.known.features.has_light
        lights = make_lights(self.known, self.geometry, lamps=area) if is_lit else NullEmitter()
        self.world = self.world.under(lights.to(emission.device))

    def by_piece(self) -> dict[int, Candidate]:
        """The lamp that each piece is: of one that shines to both sides the brighter."""
        return {lamp.piece: lamp for lamp in sorted(self.lamps, key=lambda lamp: lamp.brightness)}

    def doubt_of(self, candidate: Candidate) -> float:
        """Standard error of the logarithm of a clipped surface's radiance, as of :attr:`doubt`; NaN where what it
        lights does not show that it shines: what only reflects is clipped as well.
        """
        known = self.doubt[self.geometry.mesh_index == candidate.piece]
        return float(known[~known.isnan()].max()) if not bool(known.isnan().all()) else math.nan

    def is_measured(self, lamp: Candidate) -> bool:
        """Whether it is known how bright a lamp is: not of those that may be brighter than they are taken for."""
        return math.isfinite(self.doubt_of(lamp)) if lamp.clipped else len(lamp.pixels) > 0

    def shining_side(self, inside: Tensor) -> tuple[bool, SurfacePixels, float]:
        """The side from which triangles [f], bool, are brighter: whether it is their backs, its pixels and their mean
        luminance, 0 where there are none.
        """
        pixels = self.shown[inside[self.shown.prims].all(-1)]
        sides = [pixels[pixels.side % 2 == back] for back in (0, 1)]
        light = [float(luminance(group.color).mean()) if len(group) else 0.0 for group in sides]
        turned = light[1] > light[0]
        return turned, sides[turned], light[turned]

    def verified(self, groups: Sequence[SurfacePixels], most: int = _VERIFIED) -> list[SurfacePixels]:
        """Those of some of the pixels of each side that show nothing else at more positions, too."""
        if not groups:
            return []
        some = [group.evenly(most) for group in groups]
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

    def sheets(self, groups: Sequence[SurfacePixels]) -> list[tuple[Tensor, Tensor]]:
        """Photographed radiance at some pixels of each group [k, 3], and that of white sheets in their place [k, 3]."""
        if not groups:
            return []
        some = [group.evenly(POINTS) for group in groups]
        sheets = torch.split(self.white(SurfacePixels.cat(*some)), [len(group) for group in some])
        return [(group.color.double(), sheet.double()) for group, sheet in zip(some, sheets, strict=True)]

    def level(self, candidates: Sequence[Candidate]) -> float:
        """How bright a tenth of all surfaces are at least, lamps and those that look like some left out, over white
        sheets in their place: above 1 where light arrives that no photograph shows to come from anywhere. All surfaces
        are too bright then, so a lamp has to stand out among them.
        """
        known = torch.zeros_like(self.photographed.left_out)
        known[[c.side for c in (*candidates, *self.lamps)]] = True
        others = self.pixels[(~known[self.pixels.side] & ~self.pixels.clipped).nonzero().squeeze(-1)]
        if len(others) == 0:
            return 1.0
        others = others.evenly(_OTHERS)
        ratio = luminance(others.color) / luminance(self.white(others)).clamp_min(1e-30)
        return float(ratio.double().quantile(0.9))

    def white(self, pixels: SurfacePixels) -> Tensor:
        """Radiance [n, 3] of a white diffuse sheet in the place of each pixel's point, in the light of the scene."""
        return self.reflected(pixels, SceneModel(self.world, WHITE, self.photographed))

    @torch.no_grad()
    def reflected(self, pixels: SurfacePixels, model: SceneModel) -> Tensor:
        """Radiance [n, 3] of surfaces of a model's materials in the place of each pixel's point."""
        parts = []
        for begin in range(0, len(pixels), max(1, _CHUNK // _SPP)):
            si = pixels.si[begin : begin + _CHUNK // _SPP]
            stream = Stream(mix(self.seed, len(self.lamps)), begin, 43, device=si.p.device)
            u = stratified_samples(len(si), _SPP, stream)
            lanes = si.repeat(_SPP)
            surface = model.materials(lanes)
            value = Radiometric(control_variate=False).reflected(model, lanes, surface, u, stream).value
            parts.append(value.view(len(si), _SPP, 3).mean(1))
        return torch.cat(parts) if parts else pixels.color
