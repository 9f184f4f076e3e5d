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
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch

from neurad.assembly.build import build_world
from neurad.assembly.gains import shared_development
from neurad.core.colour import luminance
from neurad.core.errors import InputError
from neurad.core.protocols import PhotoSource
from neurad.core.scene_records import Constant
from neurad.emitters.lights import NullEmitter
from neurad.integrators.method import SceneModel
from neurad.lamps.candidates import (
    MARGIN,
    MIN_LAMP_PIXELS,
    Candidate,
    candidate_of,
    one_radiance,
    over,
    reflectance,
)
from neurad.lamps.clipped import brighten, sentence
from neurad.lamps.lit_surfaces import POINTS, UNEXPLAINED, WHITE, LitSurfaces
from neurad.lamps.named import named_lamps, take_named
from neurad.lamps.patches import Patches
from neurad.runtime.progress import phase
from neurad.scene.description import Scene
from neurad.scene.hints import PlaceHint
from neurad.scene.shining import Shining, lamp_names, without_lamps

MIN_SURROUNDED = 0.5
"""Fraction of what arrives at a patch that photographs have to show, where there is light that they do not."""
_ALIKE = 0.5  # of the brightest candidate's radiance: what is found together with it
_MEASURED = 4096  # pixels of a lamp that say what it reflects


@dataclass
class Found:
    """What was found."""

    lamps: list[Shining] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)
    """What there is to say."""


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
        tracer: 'embree', 'open3d' or 'warp'.
        unknown_sky: the environment is not known either, so nothing is taken from it.
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
        lit = LitSurfaces(scene, world, photographs, seed, unknown_sky, develop)
        return Search(lit, hints, shining).run()


class Search:
    """One search for lamps among surfaces, none of which is taken for a lamp yet."""

    def __init__(self, lit: LitSurfaces, hints: Sequence[PlaceHint] = (), declared: Sequence[int] = ()) -> None:
        self.lit, self.named = lit, named_lamps(lit, hints, declared)

    def run(self) -> Found:
        """Find the meshes that shine, then the patches of the others that do."""
        lit = self.lit
        patches = Patches(lit.geometry, lit.pixels)
        if (bool(lit.shown.clipped.any()) or self.named) and not lit.unknown_sky:
            brighten(lit, self.named, patches)
            patches = Patches(lit.geometry, lit.pixels)
        self._take(self._candidates(patches))
        if self._part(patches) or self.named:
            take_named(lit, self.named, patches)
            self._refine(patches, self._candidates(patches))
            self._take(self._candidates(patches))
            self._refine(patches, lit.lamps)
            self._measure()
        return found_lamps(lit, lit.level([]))

    def _take(self, candidates: list[Candidate]) -> None:
        """Take lamp after lamp, the brightest first, until nothing is brighter than it could be otherwise."""
        lit = self.lit
        while True:
            for candidate, (shown, sheet) in zip(candidates, lit.sheets([c.pixels for c in candidates]), strict=True):
                candidate.ratio = over(shown, sheet)
                # what is not clipped of the border of one that is known by what it lights is not that bright
                by_light = candidate.clipped and math.isfinite(lit.doubt_of(candidate))
                candidate.even = by_light or one_radiance(luminance(shown), luminance(sheet), candidate.ratio)
            even = [c for c in candidates if c.even]
            known = [c for c in even if not c.clipped or not math.isnan(lit.doubt_of(c))]
            shining = self._brighter(known)
            if not shining and len(known) < len(even):  # lit, maybe, by lamps brighter than they were taken for: last
                shining = self._brighter(even)
            if not shining:
                return
            bright = _ALIKE * max(c.brightness for c in shining)
            lit.lamps += [c for c in shining if c.brightness >= bright]
            candidates = [c for c in candidates if c not in lit.lamps]
            lit.relight()

    def _brighter(self, even: list[Candidate]) -> list[Candidate]:
        """Those of some candidates of one radiance that are brighter than what arrives there explains."""
        lit = self.lit
        level = max(lit.level(even), 1.0)
        # patches are many: where a tenth of surfaces exceed the level, one in 200 exceeds its square (lognormal)
        least = [MARGIN * level ** (1 if c.piece < len(lit.scene.meshes) else 2) for c in even]
        shining = [c for c, r in zip(even, least, strict=True) if c.ratio > r and not self._is_part(c, even)]
        return [c for c in shining if self._is_surrounded(c)] if level > UNEXPLAINED else shining

    def _is_part(self, candidate: Candidate, even: Sequence[Candidate]) -> bool:
        """Whether most of what photographs show of a mesh is its other side, which does not shine: it is no lamp then,
        but may have one within.
        """
        other = candidate.side ^ 1
        counts = [int((self.lit.pixels.side == side).sum()) for side in (candidate.side, other)]
        is_mesh = candidate.piece < len(self.lit.scene.meshes)
        return is_mesh and counts[1] > counts[0] and all(c.side != other for c in even)

    def _is_surrounded(self, candidate: Candidate) -> bool:
        """Whether photographs show most of what arrives at a patch. Where they do not, and there is light from nowhere,
        a patch that is brighter than what they show may just be lit by the rest.
        """
        lit = self.lit
        if candidate.piece < len(lit.scene.meshes):
            return True
        dark = lit.world.under(NullEmitter().to(lit.geometry.vertices.device))
        points = candidate.pixels.evenly(POINTS)
        covered = lit.reflected(points, SceneModel(dark, WHITE, lit.photographed.covered))
        return float(covered.mean()) > MIN_SURROUNDED

    def _part(self, patches: Patches) -> bool:
        """Let each patch of a mesh that is no lamp be a piece of surface by itself; False where there is none."""
        lit = self.lit
        taken = torch.tensor([lamp.piece for lamp in lit.lamps] + sorted(lit.scene.smooth_meshes))
        of = lit.geometry.mesh_index
        patch = patches.find(~torch.isin(of, taken.to(of)), MIN_LAMP_PIXELS)
        count = int(patch.max()) + 1
        first = torch.zeros(count, dtype=torch.int64, device=of.device)
        first[patch[patch >= 0]] = of[patch >= 0]
        lit.geometry.mesh_index = torch.where(patch >= 0, len(lit.mesh_of) + patch, of)
        lit.mesh_of += first.tolist()
        lit.relabel()
        return count > 0

    def _candidates(self, patches: Patches) -> list[Candidate]:
        """Sides of meshes and patches that are brighter than what arrives there explains by the lamps so far. Smooth
        surfaces are none: they show other things. A patch that ends where photographs say, and not where the surface
        does, has to be shown by two views: one alone may show a highlight.
        """
        lit = self.lit
        taken = lit.scene.smooth_meshes | {lamp.piece for lamp in lit.lamps}
        sides = [side for side in torch.unique(lit.pixels.side).tolist() if side // 2 not in taken]
        groups = [lit.pixels[(lit.pixels.side == side).nonzero().squeeze(-1)] for side in sides]
        pairs = zip(sides, groups, lit.sheets(groups), strict=True)
        # without shadow rays to lamps it is noisier
        bright = [(side, group) for side, group, pair in pairs if over(*pair) > MARGIN / 1.5]
        found = []
        for (side, _), pixels in zip(bright, lit.verified([group for _, group in bright]), strict=True):
            is_whole = side // 2 < len(lit.scene.meshes) or patches.is_whole(lit.geometry.mesh_index == side // 2)
            if len(pixels) >= MIN_LAMP_PIXELS and (is_whole or len(torch.unique(pixels.view)) > 1):
                found.append(candidate_of(side, pixels))
        return found

    def _refine(self, patches: Patches, lamps: Sequence[Candidate]) -> None:
        """Let patches end halfway between their radiance and that of what is around them. Those that touch and are
        alike become one.
        """
        lit = self.lit
        of, mesh_of = lit.geometry.mesh_index, torch.tensor(lit.mesh_of, device=lit.geometry.mesh_index.device)
        for lamp in lamps:
            mesh = lit.mesh_of[lamp.piece]
            if lamp.piece != mesh and not lamp.named_by and (of == lamp.piece).any():
                unlike = torch.tensor([other.piece for other in (*lamps, *lit.lamps) if not other.is_like(lamp)])
                free = (mesh_of[of] == mesh) & ~torch.isin(of, unlike.to(of))
                inside = patches.refined(of == lamp.piece, free, lamp.turned, lamp.brightness)
                of = torch.where(of == lamp.piece, mesh, of)
                of[inside] = lamp.piece
        lit.geometry.mesh_index = of
        lit.lamps = [lamp for lamp in lit.lamps if (of == lamp.piece).any()]
        lit.relabel()

    def _measure(self) -> None:
        """Find what lamps that are patches reflect: the material of their mesh is that of other things, too."""
        lit = self.lit
        for lamp in lit.lamps:
            mesh = lit.mesh_of[lamp.piece]
            if lamp.piece == mesh or lamp.clipped or len(lamp.pixels) == 0:
                continue
            pixels = lit.verified([lit.pixels[lit.pixels.side == lamp.side]], _MEASURED)[0]
            pixels = pixels[~pixels.clipped]
            sheets = luminance(lit.white(pixels.repeat(2)).double()).view(-1, 2).T
            paint = lit.scene.materials[lit.scene.meshes[mesh].material].albedo
            thought = float(paint.value.mean()) if isinstance(paint, Constant) else 0.5
            lamp.albedo = reflectance(luminance(pixels.color.double()), sheets, thought)


def found_lamps(lit: LitSurfaces, level: float) -> Found:
    """The result, and what there is to say of it."""
    by_piece = lit.by_piece()
    lamps = [_shining(lit, by_piece[piece]) for piece in sorted(by_piece)]
    names = lamp_names(lit.scene, lamps)
    lines = []
    for name, (piece, lamp) in zip(names, sorted(by_piece.items()), strict=True):
        times = f"{lamp.ratio:.3g} times as bright as a white sheet in its place"
        doubt = lit.doubt_of(lamp) if lamp.clipped else 0.0
        least = "" if math.isfinite(doubt) else "at least "
        said = f"as {lamp.named_by} says" if lamp.named_by else f"it is {least}{times}"
        lines.append(f"{name} shines: {said}")
        if lamp.clipped and math.isfinite(doubt):
            lines.append(sentence(name, lamp.radiance, doubt, is_shown=len(lamp.pixels) > 0))
        if sum(other.piece == piece for other in lit.lamps) > 1:
            lines.append(
                f"warning: {name} shines to both sides of its triangles; only the light of the brighter side is "
                "taken, so give each side a mesh of its own"
            )
    if level > UNEXPLAINED and not lit.unknown_sky and all(map(lit.is_measured, lit.lamps)):
        lines.append(
            f"warning: a tenth of the surfaces are more than {level:.2g} times as bright as all light that the "
            "photographs show can make them: some lamp is in no photograph, and its light will be missing; "
            "photograph it, or give it an emitter in the scene and take --model.lighting.emitters fit"
        )
    if not lamps and not lit.scene.features.has_light:
        raise InputError(
            f"scene {lit.scene.name}: model.lighting.emitters is find, but no mesh shines in the photographs: "
            "none, and no patch of one, is alike all over and brighter than what arrives there; say where lamps "
            "are that photographs show (model.lighting.lamps: points on them, or boxes around them), give lamps "
            "that none shows an area emitter in the scene, and take fit; light that comes in by windows needs a "
            "constant emitter in the scene, and model.lighting.environment fit"
        )
    return Found(lamps, lines or ["no mesh shines in the photographs"])


def _shining(lit: LitSurfaces, lamp: Candidate) -> Shining:
    """What shines, in the scene's terms."""
    mesh, radiance = lit.mesh_of[lamp.piece], None
    if lamp.clipped and math.isfinite(lit.doubt_of(lamp)):
        found = lamp.radiance.tolist()
        radiance = tuple(max(x, 1e-3 * max(found)) for x in found)
    if lamp.piece == mesh:
        return Shining(mesh, lamp.turned, radiance=radiance)
    first = sum(len(other.faces) for other in lit.scene.meshes[:mesh])
    triangles = (lit.geometry.mesh_index == lamp.piece).nonzero().squeeze(-1) - first
    whole = len(triangles) == len(lit.scene.meshes[mesh].faces)
    return Shining(mesh, lamp.turned, None if whole else tuple(triangles.tolist()), lamp.albedo, radiance)
