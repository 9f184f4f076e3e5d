"""How bright the photographs are, and whether they belong to these lights: a factor would end up in the materials."""

from collections.abc import Callable, Sequence
from functools import partial

import torch

from neurad.core.records import PixelBatch, Rays, Surface
from neurad.core.rng import Stream
from neurad.integrators.bounce import bounce
from neurad.integrators.estimator import Estimator
from neurad.integrators.path import PathTracing
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.vertex import DIMENSIONS
from neurad.metrics.seen import SeenBy
from neurad.runtime.reading import listed
from neurad.scene.description import Scene
from neurad.scene.textures import ConstantMaterials

MAX_BRIGHTNESS_RATIO = 50.0
"""Ratio from which on no material explains the photographs; a white closed room may be some tens of times brighter."""
_PIXELS = 4096
_WHITE_PIXELS, _WHITE_SPP, _MAX_DEPTH = 512, 2, 1000
_RAYS, _AWAY = 256, 0.05  # from each side of a lamp, and how many of those from its back may as well be from its front
MAX_WHITE_RATIO = 2.0
"""Times the brightness of a white scene up to which materials may explain photographs."""


@torch.no_grad()
def brightness(primary: PrimaryHits, sample: PixelBatch, seed: int) -> float:
    """How many times as bright as expected the photographs are.

    Expected is what the lights give surfaces of albedo 0.5 directly, times 2 for the light that bounces on.

    Args:
        sample: random photographed pixels that show no emitter; of more than 4096 some are drawn.
    """
    world, device = primary.world, primary.origin.device
    stream = Stream(seed, 18, device=device)
    with world.tracer.uncounted():
        si, color = primary.some(sample, _PIXELS, stream)
        half = Surface(torch.full_like(si.p, 0.5), torch.ones_like(si.p[:, :1]))
        direct = bounce(world, si, half, stream.uniform(len(si), DIMENSIONS)).direct
    expected = 2.0 * float(direct[si.valid].mean()) if bool(si.valid.any()) else 0.0
    return float(color[si.valid].mean()) / expected if expected > 0 else 1.0


@torch.no_grad()
def white_brightness(primary: PrimaryHits, sample: PixelBatch, seed: int, max_depth: int) -> float:
    """How many times as bright the photographs are as the scene would be if it were all but white (albedo 0.999).

    Args:
        max_depth: of the paths, as in the scene, but at most 1000; none of them ends at random.
    """
    world, device = primary.world, primary.origin.device
    stream = Stream(seed, 19, device=device)
    with world.tracer.uncounted():
        si, color = primary.some(sample, _WHITE_PIXELS, stream)
        depth, white = min(max_depth, _MAX_DEPTH), ConstantMaterials(0.999)
        method = PathTracing(max_depth=depth, rr_depth=depth)
        estimate = Estimator(world, white, None, method).image(si, white(si), _WHITE_SPP, stream).value
    expected = float(estimate.view(len(si), _WHITE_SPP, 3).mean(1)[si.valid].mean()) if bool(si.valid.any()) else 0.0
    return float(color[si.valid].mean()) / expected if expected > 0 else 1.0


@torch.no_grad()
def lamps_facing_away(primary: PrimaryHits, names: Sequence[str], seed: int) -> list[str]:
    """Names of lamps whose shining side lights nothing that a camera sees, while something is behind their back."""
    world, found = primary.world, []
    geometry, device = world.geometry, world.geometry.vertices.device
    seen_by = SeenBy(geometry, world.tracer, primary.cameras)
    shines = geometry.emission.amax(-1) > 0
    with world.tracer.uncounted():
        for mesh in torch.unique(geometry.mesh_index[shines]).tolist():
            faces = (shines & (geometry.mesh_index == mesh)).nonzero().squeeze(-1)
            stream = Stream(seed, mesh, 55, device=device)
            face = faces[stream.integers(len(faces), _RAYS)]
            normal = geometry.face_normal[face]
            lit = []
            for side in (normal, -normal):
                towards = torch.nn.functional.normalize(stream.uniform(_RAYS, 3) * 2.0 - 1.0, dim=-1)
                d = torch.nn.functional.normalize(side + 0.999 * towards, dim=-1)
                p = geometry.vertices[geometry.faces[face]].mean(1)
                end = world.intersect(Rays(p + 1e-4 * geometry.scale * side, d))
                lit.append(int((seen_by.any(end) & end.valid).sum()))
            if lit[0] < _AWAY * lit[1]:
                found.append(names[mesh])
    return found


def brightness_warning(scene: Scene, primary: PrimaryHits, sample: PixelBatch, seed: int) -> str:
    """A warning if photographs of the scene may be out of reach of its lights, otherwise nothing; as
    :func:`brightness`.
    """
    white = partial(white_brightness, primary, sample, seed, scene.max_depth)
    away = partial(lamps_facing_away, primary, [mesh.name for mesh in scene.meshes], seed)
    return sentence_if_far(brightness(primary, sample, seed), white, away)


def sentence_if_far(factor: float, white: Callable[[], float], away: Callable[[], list[str]]) -> str:
    """:func:`brightness_warning` by the ``factor`` of :func:`brightness`; what takes a while is only called for
    photographs that are far brighter.
    """
    if 1.0 / MAX_BRIGHTNESS_RATIO < factor < MAX_BRIGHTNESS_RATIO:
        return ""
    said = f"the photographs are about {factor:.3g} times as bright as the scene's lights make surfaces of albedo 0.5"
    if factor < 1.0:
        return f"{said}; only a scene that is nearly black explains that, so see whether lights and photographs agree"
    if backs := away():
        names = f"lamp{'s' * (len(backs) > 1)} {listed(backs)}"
        faces = "faces" if len(backs) == 1 else "face"
        return f"{said}: {names} {faces} away from the room, so turn the winding of the triangles there"
    if white() > MAX_WHITE_RATIO:
        return f"{said}; materials cannot explain that, so scale the lights or the photographs"
    albedo = factor / (1.0 + factor)  # of a closed room: direct light / (1 - albedo)
    return f"{said}; only a mean albedo of about {albedo:.2f} in a closed room explains that, see whether it is so"
