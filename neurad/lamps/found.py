"""What a search for lamps says."""

import math
from dataclasses import dataclass, field

from neurad.core.errors import InputError
from neurad.lamps.candidates import Candidate
from neurad.lamps.clipped import sentence
from neurad.lamps.lit_surfaces import UNEXPLAINED, LitSurfaces
from neurad.scene.shining import Shining, lamp_names


@dataclass
class Found:
    """What was found."""

    lamps: list[Shining] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)
    """What there is to say."""


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
    mesh, of = lit.mesh_of[lamp.piece], lit.geometry.mesh_index
    found = lamp.radiance.tolist() if lamp.clipped and math.isfinite(lit.doubt_of(lamp)) else None
    radiance = None if found is None else tuple(max(x, 1e-3 * max(found)) for x in found)
    if lamp.piece == mesh:
        return Shining(mesh, lamp.turned, radiance=radiance)
    first = sum(len(other.faces) for other in lit.scene.meshes[:mesh])
    triangles = (of == lamp.piece).nonzero().squeeze(-1) - first
    whole = len(triangles) == len(lit.scene.meshes[mesh].faces)
    return Shining(mesh, lamp.turned, None if whole else tuple(triangles.tolist()), lamp.albedo, radiance)
